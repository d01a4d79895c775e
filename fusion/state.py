"""Results of a navigator: states, tracks, innovations and the health report."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import BoolArray, FloatArray, Trajectory

T = TypeVar("T")


def changed(state: T, **attributes: Any) -> T:
    """Return a copy of a frozen dataclass with some attributes replaced, the others shared.

    Like `dataclasses.replace` in a quarter of its time, as the filter makes dozens per interval:
    attributes are neither looked up nor checked again, so it is only for states without
    `__post_init__`.
    """
    new = object.__new__(type(state))
    vars(new).update(vars(state))
    vars(new).update(attributes)
    return new


@dataclass(frozen=True, eq=False)
class NavState:
    """Estimated state at one time.

    Attributes:
        time: [s].
        R_WB: (3, 3) attitude, body to world.
        v_W: (3,) velocity [m/s].
        p_W: (3,) position [m]; zero at the start unless a prior or a fix places the track.
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        covariance: (15, 15) of rotation about W's axes [rad], velocity, position, b_g, b_a; each
            error is true minus estimate. The properties below give its blocks.
        in_gap: whether the interval that ends here is a gap without samples.
        map_frame: number of frame transforms so far (`filter.map_frame`); states with different
            numbers must not be compared.
    """

    time: float
    R_WB: FloatArray
    v_W: FloatArray
    p_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    covariance: FloatArray
    in_gap: bool = False
    map_frame: int = 0

    @property
    def quat_xyzw(self) -> FloatArray:
        """Attitude as a unit quaternion (4,), xyzw."""
        return np.asarray(Rotation.from_matrix(self.R_WB).as_quat())

    @property
    def attitude_WB(self) -> Rotation:
        """Attitude, body to world."""
        return Rotation.from_matrix(self.R_WB)

    @property
    def attitude_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the rotation about W's axes [rad^2]."""
        return self.covariance[0:3, 0:3]

    @property
    def velocity_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the velocity [m^2/s^2]."""
        return self.covariance[3:6, 3:6]

    @property
    def position_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the position [m^2]."""
        return self.covariance[6:9, 6:9]

    @property
    def gyro_bias_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the gyroscope bias [rad^2/s^2]."""
        return self.covariance[9:12, 9:12]

    @property
    def accel_bias_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the accelerometer bias [m^2/s^4]."""
        return self.covariance[12:15, 12:15]

    def shifted(self, by: FloatArray) -> NavState:
        """Express the state in a frame whose origin lies at -`by` (3,) [m]."""
        return changed(self, p_W=self.p_W + by)


@dataclass(frozen=True, eq=False)
class SmoothedPose:
    """A pose estimated one window later, using the measurements made since.

    Attributes:
        time: of the pose [s].
        R_WB: (3, 3) attitude, body to world.
        p_W: (3,) position [m].
        covariance: (6, 6) of rotation about W's axes [rad] and position [m].
        map_frame: as in `NavState`.
    """

    time: float
    R_WB: FloatArray
    p_W: FloatArray
    covariance: FloatArray
    map_frame: int = 0


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations (measured minus predicted displacement) of all updates.

    Attributes:
        time: (M,) end of the window [s].
        residual_W: (M, 3) innovation [m] (or [m/s] if mean velocities are measured).
        sigma: (M, 3) predicted standard deviations.
        nis: (M,) normalised innovation squared, before any inflation.
        gated: (M,) whether the covariance was inflated.
    """

    time: FloatArray
    residual_W: FloatArray
    sigma: FloatArray
    nis: FloatArray
    gated: BoolArray


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
        zero_velocity: numbers of zero-velocity updates (one per state) applied, and refused by
            reason.
        bearings: numbers of magnetic bearings, likewise; 1 under "north" if they determined it.
        accel_noise_factor: final factor on the accelerometer's configured noise density, estimated
            from the innovations.
        network_error_level: final variance of the network's errors that change within seconds, as a
            fraction of what it predicts, estimated from the innovations; 1 if not estimated.
        final_sigma: final standard deviations, the largest in any direction (the semi-axis of the
            ellipse): tilt and yaw [rad], velocity [m/s], horizontal position and height [m], biases
            [rad/s], [m/s^2].
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
    zero_velocity: dict[str, int] = field(default_factory=dict)
    bearings: dict[str, int] = field(default_factory=dict)
    accel_noise_factor: float = 1.0
    network_error_level: float = 1.0
    final_sigma: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Format the counts as text; `stario.fusion.report.health` interprets them."""
        dropped = {k: v for k, v in self.samples.items() if k != "used" and v}
        text = [f"samples used {self.samples.get('used', 0)}, dropped {_counted(dropped)}"]
        if any(self.flagged.values()):
            text.append(f"samples flagged: {_counted(self.flagged)}")
        text.append(f"gaps {self.gap_count}, longest {self.longest_gap:.2f} s")
        if self.updates:
            text.append(
                f"updates {self.updates}, gated {self.gated / self.updates:.1%}, "
                f"refused {_counted(self.refused)}, "
                f"mean NIS {self.mean_nis:.2f} (expected {self.nis_expected})"
            )
        else:
            text.append("updates none: no window was complete, or the device was stationary")
        if self.fixes:
            text.append(f"fixes {_counted(self.fixes)}")
        if self.zero_velocity:
            text.append(f"zero-velocity updates {_counted(self.zero_velocity)}")
        if self.bearings:
            text.append(f"bearings of the magnetic field {_counted(self.bearings)}")
        if self.accel_noise_factor > 1.0:
            text.append(
                f"accelerometer noise {self.accel_noise_factor:.1f} times the configured one"
            )
        if self.network_error_level != 1.0:
            level = math.sqrt(self.network_error_level)
            text.append(f"network's errors within seconds {level:.1f} times their predicted sigma")
        sigma = ", ".join(f"{k} {v:.3g}" for k, v in self.final_sigma.items())
        return [*text, f"final sigma: {sigma}"]


def _counted(counts: dict[str, int]) -> str:
    """Format counts by reason; `none` if there are none."""
    return ", ".join(f"{reason} {n}" for reason, n in counts.items()) or "none"


@dataclass(frozen=True, eq=False)
class Track:
    """An estimated track.

    Attributes:
        trajectory: poses, velocities and position covariances at the output times.
        b_g: (N, 3) gyroscope bias [rad/s], None if not estimated.
        b_a: (N, 3) accelerometer bias [m/s^2], None if not estimated.
        covariance: (N, 15, 15) as in `NavState`, None if not estimated.
        innovations: innovations of the network's measurements, None without a filter.
        health: report of the run, None without a filter.
        smoothed: poses at the times of the filter's clones, each estimated one window later; None
            if there are none.
        seconds_network: computing time of the network [s].
        seconds_filter: computing time of everything else [s].
    """

    trajectory: Trajectory
    b_g: FloatArray | None = None
    b_a: FloatArray | None = None
    covariance: FloatArray | None = None
    innovations: Innovations | None = None
    health: Health | None = None
    smoothed: Trajectory | None = None
    seconds_network: float = 0.0
    seconds_filter: float = 0.0

    @property
    def time(self) -> FloatArray:
        """Times (N,) [s]."""
        return self.trajectory.time

    @property
    def nis(self) -> float | None:
        """Mean NIS, None without a filter."""
        return None if self.health is None else self.health.mean_nis

    def arrays(self) -> dict[str, Any]:
        """Return all arrays by name, for an npz file."""
        arrays = {
            "time": self.time,
            "position_W": self.trajectory.position_W,
            "quat_xyzw_WB": self.trajectory.quat_xyzw,
            "velocity_W": self.trajectory.velocity_W,
            "valid": self.trajectory.valid,
            "gyro_bias_B": self.b_g,
            "accel_bias_B": self.b_a,
            "covariance": self.covariance,
        }
        return {name: value for name, value in arrays.items() if value is not None}


def track_from_states(
    states: list[NavState],
    innovations: Innovations,
    health: Health,
    smoothed: Trajectory | None = None,
    seconds_network: float = 0.0,
    seconds_filter: float = 0.0,
) -> Track:
    """Stack states into a track; the first state after a gap is marked invalid."""
    covariance = np.array([s.covariance for s in states])
    trajectory = Trajectory(
        time=np.array([s.time for s in states]),
        position_W=np.array([s.p_W for s in states]),
        attitude_WB=Rotation.from_matrix(np.array([s.R_WB for s in states])),
        velocity_W=np.array([s.v_W for s in states]),
        position_covariance_W=covariance[:, 6:9, 6:9],
        valid=np.array([not s.in_gap for s in states]),
    )
    return Track(
        trajectory=trajectory,
        b_g=np.array([s.b_g for s in states]),
        b_a=np.array([s.b_a for s in states]),
        covariance=covariance,
        innovations=innovations,
        health=health,
        smoothed=smoothed,
        seconds_network=seconds_network,
        seconds_filter=seconds_filter,
    )
