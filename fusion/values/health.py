"""Health report of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from stario.fusion.values.floors import FloorChange


@dataclass
class Health:
    """Report of a run: counts by reason, and final uncertainty.

    Attributes:
        samples: number used, and numbers dropped by reason.
        flagged: of those used, replaced spikes and samples at the sensor's limit.
        gap_count: number of stretches without samples.
        longest_gap: length of the longest gap [s].
        gaps: start and length [s] of the latest gaps, at most a hundred.
        updates: number of network measurements offered.
        gated: of these, number whose covariance was inflated.
        refused: of these, numbers refused by reason.
        mean_nis: mean normalised innovation squared; its expectation is `nis_expected`.
        nis_expected: degrees of freedom of a measurement.
        fixes: numbers of fixes applied (of these gated), and refused by reason.
        fix_kinds: numbers of fixes given, by kind.
        zero_velocity: numbers of zero-velocity updates (one per state) applied, and refused by
            reason.
        bearings: numbers of magnetic bearings, likewise; 1 under "north" if they determined it.
        corrections: time [s], distance [m], turn [rad] and cause of the latest updates, other than
            by fixes, that moved a filter's track by more than 1 m or 10 degrees at once.
        jumps: where positions in a row contradicted the track and moved it: time of the last one
            that agreed and of the first that did not [s], distance [m], and whether the device
            was carried in between, as in a vehicle.
        rides: start and stop of each stretch in which the network saw the device stand while it was
            accelerated as no walk does, as in a vehicle [s], at most a hundred.
        fields_dropped: number of magnetometer samples dropped: their value or time is wrong, or
            repeats an earlier one.
        pressures: numbers of heights by the pressure applied (of these gated), of steps of the
            air's pressure, and of refused ones by reason.
        floors: changes of floor found in the heights of a recording with a barometer.
        pressures_dropped: number of pressures dropped: their value or time is wrong, or a sensor
            that has stopped repeats the last one.
        pressure_silence: start and length of the longest time without a usable pressure from a
            barometer that there is [s].
        accel_noise_factor: final factor on the accelerometer's configured noise density, estimated
            from the innovations.
        network_error_level: final variance of the network's errors that change within seconds, as a
            fraction of what it predicts, estimated from the innovations; 1 if not estimated.
        final_sigma: final standard deviations, the largest in any direction (the semi-axis of the
            ellipse): tilt and yaw [rad], velocity [m/s], horizontal position and height [m], biases
            [rad/s], [m/s^2].
        set_back: amount by which a recording's clock was set back where its track ends [s].
        longest_late: longest duration of consecutive samples out of order [s].
        stopped: number of samples dropped because one sensor alone had stopped, by sensor.
        network_turn: yaw from the network's direction to the accelerometer's [rad], of a recording.
        network_turn_sigma: its standard deviation [rad]; pi if it is unknown.
        north_contradiction: angle from magnetic north, by the declination given, to the north of a
            track that fixes or a prior have oriented [rad]; 0 within three sigma.
        notes: further remarks, one line each, such as a graph that fell back to the filter.
    """

    samples: dict[str, int] = field(default_factory=dict)
    flagged: dict[str, int] = field(default_factory=dict)
    gap_count: int = 0
    longest_gap: float = 0.0
    gaps: list[tuple[float, float]] = field(default_factory=list)
    updates: int = 0
    gated: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    mean_nis: float = float("nan")
    nis_expected: int = 3
    fixes: dict[str, int] = field(default_factory=dict)
    fix_kinds: dict[str, int] = field(default_factory=dict)
    zero_velocity: dict[str, int] = field(default_factory=dict)
    bearings: dict[str, int] = field(default_factory=dict)
    corrections: list[tuple[float, float, float, str]] = field(default_factory=list)
    jumps: list[tuple[float, float, float, bool]] = field(default_factory=list)
    rides: list[tuple[float, float]] = field(default_factory=list)
    fields_dropped: int = 0
    pressures: dict[str, int] = field(default_factory=dict)
    floors: list[FloorChange] = field(default_factory=list)
    pressures_dropped: int = 0
    pressure_silence: tuple[float, float] = (0.0, 0.0)
    accel_noise_factor: float = 1.0
    network_error_level: float = 1.0
    final_sigma: dict[str, float] = field(default_factory=dict)
    set_back: float = 0.0
    longest_late: float = 0.0
    stopped: dict[str, int] = field(default_factory=dict)
    network_turn: float = 0.0
    network_turn_sigma: float = math.pi
    north_contradiction: float = 0.0
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """Format the counts as text; `stario.fusion.report.health` interprets them."""
        dropped = {k: v for k, v in self.samples.items() if k != "used" and v}
        text = [f"samples used {self.samples.get('used', 0)}, dropped {_counted(dropped)}"]
        if any(self.flagged.values()):
            text.append(f"samples flagged: {_counted(self.flagged)}")
        text.append(f"gaps {self.gap_count}, longest {self.longest_gap:.2f} s")
        if self.updates:
            nis = f"mean NIS {self.mean_nis:.2f} (expected {self.nis_expected})"
            outliers = {"outliers": self.gated, **self.refused}
            found = _counted({name: n for name, n in outliers.items() if n})
            refused = [] if found == "none" else [found]
            text.append(", ".join([f"updates {self.updates}", nis, *refused]))
        else:
            text.append("updates none: no window was complete, or the device was stationary")
        for title, counts in (
            ("fixes", self.fixes),
            ("zero-velocity updates", self.zero_velocity),
            ("bearings of the magnetic field", self.bearings),
            ("heights by the pressure", self.pressures),
        ):
            if counts:
                text.append(f"{title} {_counted(counts)}")
        text += [str(change) for change in self.floors]
        if self.fields_dropped:
            text.append(f"magnetometer samples dropped: {self.fields_dropped}")
        if self.pressures_dropped:
            text.append(f"pressures dropped: {self.pressures_dropped}")
        if self.accel_noise_factor > 1.0:
            text.append(
                f"accelerometer noise {self.accel_noise_factor:.1f} times the configured one"
            )
        if self.network_error_level != 1.0:
            level = math.sqrt(self.network_error_level)
            text.append(f"short-term errors of the network: {level:.1f} times the predicted sigma")
        sigma = ", ".join(_sigma_words(k, v) for k, v in self.final_sigma.items())
        return [*text, f"final sigma: {sigma}"]


_UNITS = {"m": "m", "m_s": "m/s", "m_s2": "m/s^2", "rad": "deg", "rad_s": "deg/s"}
"""Units in which sigmas are printed, by the ends of their names."""


def _sigma_words(name: str, sigma: float) -> str:
    """Return a sigma by name, unit and value; angles are in degrees."""
    end = next(end for end in ("m_s2", "rad_s", "m_s", "rad", "m") if name.endswith(f"_{end}"))
    value = math.degrees(sigma) if end.startswith("rad") else sigma
    return f"{name.removesuffix(f'_{end}').replace('_', ' ')} {value:.3g} {_UNITS[end]}"


def _counted(counts: dict[str, int]) -> str:
    """Format counts by reason; `none` if there are none."""
    return ", ".join(f"{reason} {n}" for reason, n in counts.items()) or "none"
