"""Findings about a recording's barometer and satellite positions.

A receiver measures its velocity from Doppler shifts, apart from its position. So the positions must
move with it: if they do only with latitude and longitude exchanged, these are; if they move 1.67
times as far, minutes stand where decimals of a degree belong.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_closing, median_filter

from stario.sequences.arrays import even_grid, runs
from stario.sequences.findings import Assessment, Finding
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


def assess_barometer(barometer: Barometer | None) -> Assessment | None:
    """Assess a barometer; None without one or with fewer than three samples.

    The figure "noise_m" is the standard deviation of a sample over fifths of a second,
    "height_range_m" holds 98 % of the heights by the pressure. "steps" are sudden, as at doors,
    "jumps" what neither a door nor a lift makes.
    """
    if barometer is None or len(barometer) < 3:
        return None
    time, hPa = barometer.time, barometer.pressure_hPa
    height = METRES_PER_HPA * (hPa[0] - hPa)
    low, high = np.percentile(height, [1.0, 99.0])
    changes = _sudden_changes(time, height)
    figures = {
        "samples": len(barometer),
        "rate_hz": barometer.rate,
        "pressure_median_hPa": float(np.median(hPa)),
        "noise_m": _noise(time, height),
        "repeated_share": float((np.diff(hPa) == 0.0).mean()),
        "height_range_m": float(high - low),
        "steps": [change for change in changes if abs(change["rise_m"]) <= _JUMP_M],
        "jumps": [change for change in changes if abs(change["rise_m"]) > _JUMP_M],
    }
    return Assessment(figures, [_pressure_line(figures)], _pressure_findings(figures))


def _pressure_line(figures: Mapping[str, Any]) -> str:
    held = figures["repeated_share"]
    line = (
        f"barometer: {figures['samples']} samples, {figures['rate_hz']:.1f} Hz"
        f"{f', {held:.0%} repeated' if held > 0.0 else ''}, "
        f"{figures['pressure_median_hPa']:.1f} hPa; as heights: noise {figures['noise_m']:.2f} m, "
        f"within {figures['height_range_m']:.1f} m"
    )
    if steps := figures["steps"]:
        largest = max(steps, key=_size)["rise_m"]
        line += f", sudden steps: {len(steps)} (largest {largest:+.1f} m)"
    return line


def _pressure_findings(figures: Mapping[str, Any]) -> list[Finding]:
    value = figures["pressure_median_hPa"]
    if not LOWEST_HPA <= value <= HIGHEST_HPA:
        text = f"barometer: found {value:.6g}, expected {LOWEST_HPA:g} to {HIGHEST_HPA:g} hPa"
        unit = pressure_unit_of(value)
        fix = f"it seems to be in {unit}" if unit else "is it an altitude?"
        return [Finding("pressure_size", text, fix, values={"pressure": value})]
    found = list[Finding]()
    if jumps := figures["jumps"]:
        jump = max(jumps, key=_size)
        text = (
            f"barometer: jumps by {jump['rise_m']:+.0f} m at {jump['time_s']:.0f} s, as no height "
            "does"
        )
        fix = "was the sensor pressed, or blown on? Or is it an altitude?"
        found.append(Finding("pressure_jump", text, fix, values={"count": len(jumps), **jump}))
    noise, rate, held = (figures[name] for name in ("noise_m", "rate_hz", "repeated_share"))
    if noise > _NOISY_M:
        text = f"barometer: a noise of {noise:.1f} m, as of wind or in a tight pocket"
        found.append(Finding("pressure_noise", text, level="note", values={"noise_m": noise}))
    if held == 1.0:
        text = (
            "barometer: all pressures are equal: it has stopped, or is rounded to metres of height"
        )
        fix = "log it with two decimals of hPa; the height of this track is the network's"
        found.append(Finding("pressure_constant", text, fix, values={"pressure": value}))
    elif rate < _SLOW_HZ or held > _HELD_SHARE:
        text = (
            f"barometer: {rate:.3g} samples per second, of which {held:.0%} repeat the last: "
            "lifts and stairs are seen late"
        )
        values = {"rate_hz": rate, "repeated_share": held}
        found.append(Finding("pressure_held", text, level="note", values=values))
    return found


def _size(change: Mapping[str, float]) -> float:
    return abs(change["rise_m"])


def _noise(time: FloatArray, height: FloatArray) -> float:
    """Return the noise of a sample [m], from second differences, which leave out a steady climb."""
    fresh = np.flatnonzero(np.diff(height, prepend=np.nan) != 0.0)
    slots = np.floor((time[fresh] - time[fresh[0]]) / _THINNED_S)
    kept = fresh[np.diff(slots, prepend=-1.0) > 0.0]
    bend = np.diff(height[kept], n=2)
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6.0)) if len(bend) else 0.0


def _sudden_changes(time: FloatArray, height: FloatArray) -> list[dict[str, float]]:
    """Return time and rise in height of each sudden change of the pressure."""
    grid = even_grid(time[0], time[-1], _GRID_S)
    side, gap = round(_SIDE_S / _GRID_S), round(_MEDIAN_S / _GRID_S)
    if len(grid) < 2 * side + gap or np.median(np.diff(time)) > 0.5 * _MEDIAN_S:
        return []
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
    return [{"time_s": float(middle + _GRID_S * k), "rise_m": float(rise[k])} for k in found]


def assess_satellites(reported: Satellites | None) -> Assessment | None:
    """Assess a receiver's positions; None without at least two.

    The figure "radius_median_m" is of positions that are not repeated; "stale" are the stretches in
    which one is, "jumps_m" the steps that no pedestrian takes. "doppler" compares the positions'
    velocity with the one from Doppler shifts, also with latitude and longitude exchanged; None
    unless the person walks with both known.
    """
    if reported is None or len(reported) < 2:
        return None
    new = np.append(True, np.diff(reported.latlon_deg, axis=0).any(axis=1))
    radius = np.empty(0) if reported.radius_m is None else reported.radius_m[new]
    radius = radius[np.isfinite(radius)]
    figures = {
        "positions": len(reported),
        "rate_hz": reported.rate,
        "radius_median_m": float(np.median(radius)) if len(radius) else None,
        "stale": _stale_stretches(reported),
        "jumps_m": _jumps(reported),
        "doppler": _against_doppler(reported),
    }
    return Assessment(figures, [_satellite_line(figures)], _satellite_findings(figures))


def _satellite_line(figures: Mapping[str, Any]) -> str:
    parts = [f"satellites: {figures['positions']} positions, {figures['rate_hz']:.1f} Hz"]
    if figures["radius_median_m"] is not None:
        parts.append(f"radius {figures['radius_median_m']:.1f} m")
    if stale := figures["stale"]:
        parts.append(f"repeated for {sum(part['length_s'] for part in stale):.0f} s")
    if doppler := figures["doppler"]:
        parts.append(
            f"move {doppler['scale']:.2f} +- {doppler['scale_sigma']:.2f} times as far as "
            f"their speed says (correlation {doppler['correlation']:.2f})"
        )
    return ", ".join(parts)


def _satellite_findings(figures: Mapping[str, Any]) -> list[Finding]:
    found = _doppler_findings(figures["doppler"]) if figures["doppler"] else []
    if stale := figures["stale"]:
        longest = max(stale, key=lambda part: part["length_s"])
        start, length = longest["start_s"], longest["length_s"]
        text = f"satellites: one position for {length:.0f} s from {start:.0f} s, as indoors"
        values = {"stale_s": sum(part["length_s"] for part in stale)}
        found.append(Finding("satellites_stale", text, level="note", values=values))
    if jumps := figures["jumps_m"]:
        text = f"satellites: {len(jumps)} jumps of up to {max(jumps):.0f} m"
        values = {"count": len(jumps), "longest_m": max(jumps)}
        found.append(Finding("satellites_jump", text, level="note", values=values))
    radius = figures["radius_median_m"]
    if radius is not None and radius > _COARSE_M:
        text = f"satellites: a radius of {radius:.0f} m, as of Wi-Fi or cells"
        found.append(Finding("satellites_coarse", text, level="note", values={"radius_m": radius}))
    return found


def _doppler_findings(doppler: Mapping[str, float]) -> list[Finding]:
    agreement, scale = doppler["correlation"], doppler["scale"]
    if agreement < _CONTRADICTS and doppler["exchanged_correlation"] > _AGREES:
        text = "satellites: positions move as their speed says only the other way round"
        fix = "exchange latitude and longitude in the file"
        return [Finding("satellites_exchanged", text, fix, values=doppler)]
    sure = abs(scale - 1.0) > _SURE * doppler["scale_sigma"] and agreement > _AGREES
    if sure and not 1.0 / _SCALED < scale < _SCALED:
        text = f"satellites: positions move {scale:.2f} times as far as their speed says"
        fix = "are minutes written as decimals of a degree, or the speed in another unit?"
        return [Finding("satellites_scale", text, fix, values=doppler)]
    return []


def _stale_stretches(reported: Satellites) -> list[dict[str, float]]:
    """Return the stretches in which the same position is repeated."""
    same = (np.diff(reported.latlon_deg, axis=0) == 0.0).all(axis=1)
    time = reported.time
    return [
        {"start_s": float(time[a]), "length_s": float(time[b] - time[a])}
        for a, b in runs(same)
        if time[b] - time[a] >= _STALE_S and b - a >= _STALE_ROWS
    ]


def _jumps(reported: Satellites) -> list[float]:
    length = np.linalg.norm(np.diff(east_north(reported.latlon_deg), axis=0), axis=1)
    radius = np.zeros(len(reported)) if reported.radius_m is None else reported.radius_m
    reach = _RADII * (np.nan_to_num(radius[1:]) + np.nan_to_num(radius[:-1]))
    far = (length > _FAST_M_S * np.diff(reported.time)) & (length > reach)
    return list(length[far].tolist())


def _against_doppler(reported: Satellites) -> dict[str, float] | None:
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
    return {
        "correlation": _correlation(straight, doppler),
        "exchanged_correlation": _correlation(crossed, doppler),
        "scale": scale,
        "scale_sigma": float(np.sqrt(error / size)),
    }


def _correlation(velocity: FloatArray, doppler: FloatArray) -> float:
    sizes = float(np.linalg.norm(velocity) * np.linalg.norm(doppler))
    return float(np.sum(velocity * doppler)) / max(sizes, 1e-12)
