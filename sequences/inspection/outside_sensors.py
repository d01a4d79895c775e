"""Findings about a recording's barometer and satellite positions.

A receiver measures its velocity from Doppler shifts, apart from its position. So the positions must
move with it: if they do only with latitude and longitude exchanged, these are; if they move 1.67
times as far, minutes stand where decimals of a degree belong.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_closing, median_filter

from stario.sequences.arrays import even_grid, runs
from stario.sequences.findings import Finding
from stario.sequences.geodesy import east_north
from stario.sequences.sequence import Barometer, FloatArray, Satellites
from stario.sequences.units import HIGHEST_HPA, LOWEST_HPA, METRES_PER_HPA, pressure_unit_of

_THINNED_S = 0.2
"""Step [s] over which the noise is measured: some phones interpolate or repeat samples in less."""

_GRID_S, _MEDIAN_S, _SIDE_S = 0.25, 1.0, 3.0
_STEP_M, _LEVEL, _WITHIN = 0.35, 0.5, 0.7
"""A step, as at a door, changes the height by this much [m], mostly within a second, between two
sides of 3 s that are level to a share of it: no stairs, lift or noise."""

_JUMP_M = 5.0
"""Change [m] within a second that neither a lift nor a door makes."""

_NOISY_M, _SLOW_HZ, _HELD_SHARE = 0.3, 0.5, 0.5
"""Noise, rate and share of repeated samples from which each is told."""


Changes = tuple[tuple[float, float], ...]
"""Time [s] and rise in height [m] of each sudden change of the pressure."""

_STALE_S, _STALE_ROWS = 8.0, 4
"""Time [s] and reports from which an equal position is repeated rather than measured."""

_FAST_M_S, _RADII = 6.0, 2.0
"""Speed of a step, and its length relative to the sum of the radii at both ends, that no pedestrian
takes."""

_WALKING_M_S, _LONGEST_STEP_S, _FEWEST = 0.7, 3.0, 15
"""Doppler speed and step between reports that are compared, and how many are needed."""

_AGREES, _CONTRADICTS = 0.6, 0.2
_SCALED, _SURE = 1.35, 4.0
"""Correlations of positions' and Doppler velocities, and the factor between them and its standard
deviations from one, that are told."""

_COARSE_M = 30.0


@dataclass(frozen=True)
class PressureFindings:
    """Findings about a barometer, named as in `as_dict`.

    Attributes:
        samples: number of samples.
        rate_hz: median rate [Hz].
        pressure_median_hPa: median pressure [hPa].
        noise_m: standard deviation of a sample over fifths of a second, as a height [m].
        repeated_share: share of the samples that equal the one before.
        height_range_m: 98 % of the heights by the pressure lie within so many metres.
        steps: sudden steps, as at doors.
        jumps: sudden changes that no door makes, nor a lift.
    """

    samples: int
    rate_hz: float
    pressure_median_hPa: float
    noise_m: float
    repeated_share: float
    height_range_m: float
    steps: Changes
    jumps: Changes

    def as_dict(self) -> dict[str, object]:
        """Return the findings as plain values, with units in their names."""
        steps, jumps = (
            [{"time_s": time, "rise_m": rise} for time, rise in found]
            for found in (self.steps, self.jumps)
        )
        return vars(self) | {"steps": steps, "jumps": jumps}

    def lines(self) -> list[str]:
        """Return the findings as lines to print."""
        held = f", {self.repeated_share:.0%} repeated" if self.repeated_share > 0.0 else ""
        line = (
            f"barometer: {self.samples} samples, {self.rate_hz:.1f} Hz{held}, "
            f"{self.pressure_median_hPa:.1f} hPa; as heights: noise {self.noise_m:.2f} m, "
            f"within {self.height_range_m:.1f} m"
        )
        if self.steps:
            largest = max(self.steps, key=lambda step: abs(step[1]))
            line += f", sudden steps: {len(self.steps)} (largest {largest[1]:+.1f} m)"
        return [line]

    def findings(self) -> list[Finding]:
        """Return what stands out."""
        if not LOWEST_HPA <= self.pressure_median_hPa <= HIGHEST_HPA:
            value = self.pressure_median_hPa
            text = f"barometer: found {value:.6g}, expected {LOWEST_HPA:g} to {HIGHEST_HPA:g} hPa"
            unit = pressure_unit_of(value)
            fix = f"it seems to be in {unit}" if unit else "is it an altitude?"
            return [Finding("pressure_size", text, fix, values={"pressure": value})]
        found = list[Finding]()
        if self.jumps:
            time, rise = max(self.jumps, key=lambda jump: abs(jump[1]))
            text = f"barometer: jumps by {rise:+.0f} m at {time:.0f} s, as no height does"
            fix = "was the sensor pressed, or blown on? Or is it an altitude?"
            values = {"count": len(self.jumps), "time_s": time, "rise_m": rise}
            found.append(Finding("pressure_jump", text, fix, values=values))
        if self.noise_m > _NOISY_M:
            text = f"barometer: a noise of {self.noise_m:.1f} m, as of wind or in a tight pocket"
            values = {"noise_m": self.noise_m}
            found.append(Finding("pressure_noise", text, level="note", values=values))
        if self.rate_hz < _SLOW_HZ or self.repeated_share > _HELD_SHARE:
            text = (
                f"barometer: {self.rate_hz:.2g} samples per second, of which "
                f"{self.repeated_share:.0%} repeat the last: lifts and stairs are seen late"
            )
            values = {"rate_hz": self.rate_hz, "repeated_share": self.repeated_share}
            found.append(Finding("pressure_held", text, level="note", values=values))
        return found


def assess_barometer(barometer: Barometer | None) -> PressureFindings | None:
    """Return the findings about a barometer; None without one or with fewer than three samples."""
    if barometer is None or len(barometer) < 3:
        return None
    time, hPa = barometer.time, barometer.pressure_hPa
    height = METRES_PER_HPA * (hPa[0] - hPa)
    steps, jumps = _sudden_changes(time, height)
    low, high = np.percentile(height, [1.0, 99.0])
    return PressureFindings(
        samples=len(barometer),
        rate_hz=barometer.rate,
        pressure_median_hPa=float(np.median(hPa)),
        noise_m=_noise(time, height),
        repeated_share=float((np.diff(hPa) == 0.0).mean()),
        height_range_m=float(high - low),
        steps=steps,
        jumps=jumps,
    )


def _noise(time: FloatArray, height: FloatArray) -> float:
    """Return the noise of a sample [m], from second differences, which leave out a steady climb."""
    fresh = np.flatnonzero(np.diff(height, prepend=np.nan) != 0.0)
    slots = np.floor((time[fresh] - time[fresh[0]]) / _THINNED_S)
    kept = fresh[np.diff(slots, prepend=-1.0) > 0.0]
    bend = np.diff(height[kept], n=2)
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6.0)) if len(bend) else 0.0


def _sudden_changes(time: FloatArray, height: FloatArray) -> tuple[Changes, Changes]:
    """Return the steps and the jumps."""
    grid = even_grid(time[0], time[-1], _GRID_S)
    side, gap = round(_SIDE_S / _GRID_S), round(_MEDIAN_S / _GRID_S)
    if len(grid) < 2 * side + gap or np.median(np.diff(time)) > 0.5 * _MEDIAN_S:
        return (), ()
    level = median_filter(np.interp(grid, time, height), gap + 1)
    sides = sliding_window_view(level, side)
    before, after = sides[: -side - gap], sides[side + gap :]
    rise = np.median(after, axis=1) - np.median(before, axis=1)
    level_to = np.maximum(np.ptp(before, axis=1), np.ptp(after, axis=1))
    size = np.abs(rise)
    within = np.sign(rise) * (after[:, 0] - before[:, -1])
    sudden = (size > _STEP_M) & (level_to < _LEVEL * size) & (within > _WITHIN * size)
    found = [a + int(np.argmax(size[a:b])) for a, b in runs(binary_closing(sudden, np.ones(gap)))]
    middle = grid[0] + _SIDE_S + 0.5 * _MEDIAN_S
    told = [(float(middle + _GRID_S * k), float(rise[k])) for k in found]
    return (
        tuple(change for change in told if abs(change[1]) <= _JUMP_M),
        tuple(change for change in told if abs(change[1]) > _JUMP_M),
    )


@dataclass(frozen=True)
class Doppler:
    """Comparison of the positions' velocity with the one measured from Doppler shifts.

    Attributes:
        correlation: correlation of both.
        exchanged_correlation: the same with latitude and longitude exchanged.
        scale: size of the positions' velocity relative to Doppler's.
        scale_sigma: its standard deviation.
    """

    correlation: float
    exchanged_correlation: float
    scale: float
    scale_sigma: float

    def findings(self) -> list[Finding]:
        """Return what stands out."""
        if self.correlation < _CONTRADICTS and self.exchanged_correlation > _AGREES:
            text = "satellites: positions move as their speed says only the other way round"
            fix = "exchange latitude and longitude in the file"
            return [Finding("satellites_exchanged", text, fix, values=vars(self))]
        sure = abs(self.scale - 1.0) > _SURE * self.scale_sigma and self.correlation > _AGREES
        if sure and not 1.0 / _SCALED < self.scale < _SCALED:
            text = f"satellites: positions move {self.scale:.2f} times as far as their speed says"
            fix = "are minutes written as decimals of a degree, or the speed in another unit?"
            return [Finding("satellites_scale", text, fix, values=vars(self))]
        return []


@dataclass(frozen=True)
class SatelliteFindings:
    """Findings about a receiver's positions, named as in `as_dict`.

    Attributes:
        positions: number of reports.
        rate_hz: median rate [Hz].
        radius_median_m: median of the radius [m] stated of positions that are not repeated; None
            if there is none.
        stale: start and length [s] of each stretch in which the same position is repeated.
        jumps_m: lengths [m] of steps that no pedestrian takes.
        doppler: comparison with the Doppler velocity; None unless the person walks with both known.
    """

    positions: int
    rate_hz: float
    radius_median_m: float | None
    stale: tuple[tuple[float, float], ...]
    jumps_m: tuple[float, ...]
    doppler: Doppler | None

    def as_dict(self) -> dict[str, object]:
        """Return the findings as plain values, with units in their names."""
        stale = [{"start_s": start, "length_s": length} for start, length in self.stale]
        return vars(self) | {"stale": stale, "doppler": self.doppler and asdict(self.doppler)}

    def lines(self) -> list[str]:
        """Return the findings as lines to print."""
        parts = [f"satellites: {self.positions} positions, {self.rate_hz:.1f} Hz"]
        if self.radius_median_m is not None:
            parts.append(f"radius {self.radius_median_m:.1f} m")
        if self.stale:
            parts.append(f"repeated for {sum(length for _, length in self.stale):.0f} s")
        if self.doppler is not None:
            parts.append(
                f"move {self.doppler.scale:.2f} +- {self.doppler.scale_sigma:.2f} times as far as "
                f"their speed says (correlation {self.doppler.correlation:.2f})"
            )
        return [", ".join(parts)]

    def findings(self) -> list[Finding]:
        """Return what stands out."""
        found = self.doppler.findings() if self.doppler else []
        if self.stale:
            start, length = max(self.stale, key=lambda part: part[1])
            text = f"satellites: one position for {length:.0f} s from {start:.0f} s, as indoors"
            values = {"stale_s": sum(seconds for _, seconds in self.stale)}
            found.append(Finding("satellites_stale", text, level="note", values=values))
        if self.jumps_m:
            longest = max(self.jumps_m)
            text = f"satellites: {len(self.jumps_m)} jumps of up to {longest:.0f} m"
            values = {"count": len(self.jumps_m), "longest_m": longest}
            found.append(Finding("satellites_jump", text, level="note", values=values))
        if self.radius_median_m is not None and self.radius_median_m > _COARSE_M:
            text = f"satellites: a radius of {self.radius_median_m:.0f} m, as of Wi-Fi or cells"
            values = {"radius_m": self.radius_median_m}
            found.append(Finding("satellites_coarse", text, level="note", values=values))
        return found


def assess_satellites(reported: Satellites | None) -> SatelliteFindings | None:
    """Return the findings about a receiver's positions; None without at least two."""
    if reported is None or len(reported) < 2:
        return None
    new = np.append(True, np.diff(reported.latlon_deg, axis=0).any(axis=1))
    radius = np.empty(0) if reported.radius_m is None else reported.radius_m[new]
    radius = radius[np.isfinite(radius)]
    return SatelliteFindings(
        positions=len(reported),
        rate_hz=reported.rate,
        radius_median_m=float(np.median(radius)) if len(radius) else None,
        stale=stale_stretches(reported),
        jumps_m=_jumps(reported),
        doppler=_against_doppler(reported),
    )


def stale_stretches(reported: Satellites) -> tuple[tuple[float, float], ...]:
    """Return start and length [s] of the stretches in which the same position is repeated."""
    same = (np.diff(reported.latlon_deg, axis=0) == 0.0).all(axis=1)
    time = reported.time
    parts = ((float(time[a]), float(time[b] - time[a]), b - a) for a, b in runs(same))
    return tuple(
        (start, length)
        for start, length, rows in parts
        if length >= _STALE_S and rows >= _STALE_ROWS
    )


def _jumps(reported: Satellites) -> tuple[float, ...]:
    length = np.linalg.norm(np.diff(east_north(reported.latlon_deg), axis=0), axis=1)
    radius = np.zeros(len(reported)) if reported.radius_m is None else reported.radius_m
    reach = _RADII * (np.nan_to_num(radius[1:]) + np.nan_to_num(radius[:-1]))
    far = (length > _FAST_M_S * np.diff(reported.time)) & (length > reach)
    return tuple(length[far].tolist())


def _against_doppler(reported: Satellites) -> Doppler | None:
    if reported.speed_m_s is None or reported.bearing_deg is None:
        return None
    bearing = np.radians(reported.bearing_deg)
    doppler = reported.speed_m_s[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    doppler = 0.5 * (doppler[1:] + doppler[:-1])
    step = np.diff(reported.time)
    moved = np.diff(reported.latlon_deg, axis=0).any(axis=1)
    walking = np.nan_to_num(np.linalg.norm(doppler, axis=1)) > _WALKING_M_S
    used = walking & moved & (step < _LONGEST_STEP_S)
    if used.sum() < _FEWEST:
        return None
    doppler = doppler[used]

    def velocity(latlon_deg: FloatArray) -> FloatArray:
        return np.asarray(np.diff(east_north(latlon_deg), axis=0)[used] / step[used, None])

    exchanged = reported.latlon_deg[:, ::-1]
    straight, crossed = velocity(reported.latlon_deg), np.zeros_like(doppler)
    if (np.abs(exchanged[:, 0]) <= 90.0).all():  # else they are no latitudes
        crossed = velocity(exchanged)
    size = float(np.sum(doppler**2))
    scale = float(np.sum(straight * doppler)) / size
    error = float(np.sum((straight - scale * doppler) ** 2)) / (doppler.size - 1.0)
    return Doppler(
        correlation=_correlation(straight, doppler),
        exchanged_correlation=_correlation(crossed, doppler),
        scale=scale,
        scale_sigma=float(np.sqrt(error / size)),
    )


def _correlation(velocity: FloatArray, doppler: FloatArray) -> float:
    sizes = float(np.linalg.norm(velocity) * np.linalg.norm(doppler))
    return float(np.sum(velocity * doppler)) / max(sizes, 1e-12)
