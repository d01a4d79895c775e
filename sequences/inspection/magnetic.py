"""Quality of a recording's magnetometer: magnitude, dip, lag, hard iron, bearing.

When a device turns in a constant field, its magnetometer measures a field that turns the other way:

    dm/dt = -w x (m - b)

with the rate w and a constant offset b that the device adds (its hard iron). This needs no
attitude: the quality of the fit indicates whether axes and units are right, the time shift of the
best fit is the lag of the time stamps, and b follows by least squares.

The bearing of the field, levelled by the IMU alone, is constant relative to the gyroscope's yaw
except for the gyroscope's drift. Its steadiness within a minute is what a filter can gain from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from stario.sequences.arrays import (
    correlation,
    even_grid,
    integral,
    interpolated,
    peak_offset,
    rms,
    samples_in,
)
from stario.sequences.attitude.levelling import levelled_attitudes
from stario.sequences.clean_samples import clean_samples, longest_unbroken
from stario.sequences.findings import Assessment, Finding
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.units import magnetic_advice

_LAGS_S = np.arange(-0.05, 0.151, 0.01)
"""Lags of the time stamps that are tried [s]."""

_SIZES_UT = (15.0, 90.0)
_LEVEL_UT = 6.0
_VERDICTS = (("good", math.radians(12.0), 0.75), ("coarse", math.radians(25.0), 0.5))
"""Maximum RMS of the bearing [rad] and minimum correlation of each verdict."""

_WINDOW_S, _TOLD_S = 60.0, 40.0
"""Span within which the bearing's steadiness is stated, and below which there is no verdict [s]:
a line absorbs most of what happens in a shorter one."""

_REPORTED_SHARE = 0.5
"""Share of half seconds with rotation above which an extrapolated field is reported."""

_UP_RAD = math.radians(20.0)
_IRON_UT = 10.0
_SURE = 5.0
"""Upward dip and hard iron above which a problem is reported; components of hard iron count if they
exceed this many of their standard deviations."""

_LONGEST_S = 600.0
_SHORTEST_S = 10.0
_STEP_S = 0.05
_SPAN_S = 0.1
_TURNING_RAD_S = 0.1
"""Rate (root mean square) below which neither hard iron nor lag can be determined."""

HELD_CHANGE = 2e-3
"""Minimum relative change in magnitude of a measured field within half a second. Some phones report
a calibrated field that they extrapolate with their own gyroscope: its magnitude stays constant to
1e-4 for seconds, while that of a measured field changes by 1e-2."""

_NO_FIELD_UT = 1e-9
"""Smallest magnitude to divide by [uT], for a sensor that reports zeros."""

_HALF_SECOND, _TURNED_RAD = 0.5, 0.05
"""Half seconds in which the field turns by more than this in the sensor's axes are examined."""

_COVERED = 0.9
"""Share of the IMU's seconds with a field below which the summary says how many there are."""


def assess_magnetometer(sequence: ImuSequence) -> Assessment | None:
    """Assess up to ten minutes of the magnetometer; None if there is none or too little.

    The figure "lag_s" is by how much the samples are stamped late, "held_share" the share of the
    half seconds with rotation in which the device extrapolated the field instead of measuring it.
    The bearing's deviation and its drift are about a line over a minute. What the gyroscope tells
    is None if the device hardly turns; lag and hard iron are also if the lag is out of range.

    Raises:
        InputError: as for `clean_samples`.
    """
    if sequence.magnetometer is None:
        return None
    time, gyro, accel = clean_samples(sequence)
    first, seconds = time[0], np.unique(np.floor(time[:-1] - time[0]))  # without those of gaps
    part = longest_unbroken(time)
    count = int(np.searchsorted(time[part], time[part.start] + _LONGEST_S))
    time, gyro, accel = (values[part][:count] for values in (time, gyro, accel))
    field = sequence.magnetometer
    inside = slice(*np.searchsorted(field.time, time[[0, -1]]))
    stamps, values = field.time[inside], field.field[inside]
    if len(stamps) < 20 or stamps[-1] - stamps[0] < _SHORTEST_S:
        return None
    agreement = lag = iron = sigma = None
    if rms(gyro) > _TURNING_RAD_S:
        agreement, lag, iron, sigma = _against_gyro(time, gyro, stamps, values)
    following = np.clip(np.searchsorted(time, stamps), 0, len(time) - 1)
    R_NB = levelled_attitudes(time, gyro, accel)[following]
    certain = None  # hard iron that must be removed before the field is assessed
    if iron is not None and sigma is not None:
        sure = np.abs(iron) > _SURE * sigma
        certain = iron if np.linalg.norm(iron[sure]) > _IRON_UT else None
    field_N = np.einsum("nij,nj->ni", R_NB, values if certain is None else values - certain)
    level = np.hypot(field_N[:, 0], field_N[:, 1])
    spread, drift = _steadiness(stamps, field_N[:, :2])
    low, median, high = np.percentile(np.linalg.norm(values, axis=1), [10.0, 50.0, 90.0]).tolist()
    figures = {
        "samples": len(field),
        "rate_hz": field.rate,
        "size_median_uT": median,
        "size_p10_p90_uT": (low, high),
        "dip_rad": float(np.median(np.arctan2(-field_N[:, 2], level))),
        "correlation_with_gyroscope": agreement,
        "lag_s": lag,
        "hard_iron_uT": iron,
        "hard_iron_sigma_uT": sigma,
        "assessed_s": float(stamps[-1] - stamps[0]),
        "levelled_bearing_rms_rad": spread,
        "gyroscope_drift_rad_s": drift,
        "held_share": _held(stamps, values),
        "covered_s": float(np.isin(seconds, np.floor(field.time - first)).sum()),
        "recording_s": float(len(seconds)),
    }
    figures["verdict"] = _verdict(figures)
    earth = (
        median if certain is None else float(np.median(np.linalg.norm(values - certain, axis=1)))
    )
    return Assessment(figures, _lines(figures), _findings(figures, certain, earth))


def _verdict(figures: Mapping[str, Any]) -> str:
    """Return the quality of the levelled bearing as a yaw reference."""
    if figures["assessed_s"] < _TOLD_S:
        return "too short to tell"
    level = figures["size_median_uT"] * math.cos(figures["dip_rad"])
    agreement = figures["correlation_with_gyroscope"]
    for word, steady, follows in _VERDICTS:
        agrees = agreement is None or agreement > follows
        if figures["levelled_bearing_rms_rad"] < steady and level > _LEVEL_UT and agrees:
            return word
    return "not usable"


def _lines(figures: Mapping[str, Any]) -> list[str]:
    low, high = figures["size_p10_p90_uT"]
    lines = [
        f"magnetometer: {figures['samples']} samples, {figures['rate_hz']:.1f} Hz, "
        f"{figures['size_median_uT']:.1f} uT (80 % within {low:.1f} to {high:.1f}), "
        f"dip {math.degrees(figures['dip_rad']):.0f} deg"
    ]
    if figures["covered_s"] < _COVERED * figures["recording_s"]:
        known, whole = figures["covered_s"], figures["recording_s"]
        lines.append(f"magnetometer: samples in {known:.0f} of {whole:.0f} s only")
    agreement, lag = figures["correlation_with_gyroscope"], figures["lag_s"]
    if agreement is not None:
        first, last = (1e3 * limit for limit in (_LAGS_S[0], _LAGS_S[-1]))
        words = f"lag outside {first:+.0f} to {last:+.0f} ms; lag and hard iron unknown"
        if lag is not None:
            pairs = zip(figures["hard_iron_uT"], figures["hard_iron_sigma_uT"], strict=True)
            iron = ", ".join(f"{b:+.1f} +- {s:.1f}" for b, s in pairs)
            words = f"lag {1e3 * lag:+.0f} ms, hard iron {iron} uT"
        lines.append(f"  against the gyroscope: correlation {agreement:.3f}, {words}")
    within = " within a minute" if figures["assessed_s"] > _WINDOW_S else ""
    lines.append(
        f"  levelled bearing over {figures['assessed_s']:.0f} s: steady to "
        f"{math.degrees(figures['levelled_bearing_rms_rad']):.1f} deg{within}, drifts by "
        f"{math.degrees(60.0 * figures['gyroscope_drift_rad_s']):+.1f} deg/min against the "
        f"gyroscope; as a yaw reference: {figures['verdict']}"
    )
    if figures["held_share"] > _REPORTED_SHARE:
        lines.append(
            f"  constant in magnitude: extrapolated by the device's own gyroscope "
            f"{figures['held_share']:.0%} of the time that it turns, and given little weight then"
        )
    return lines


def _findings(figures: Mapping[str, Any], iron: FloatArray | None, size: float) -> list[Finding]:
    """Return what stands out; hard iron, if certain, is not part of the field's `size` [uT]."""
    result, agreement = list[Finding](), figures["correlation_with_gyroscope"]
    if not _SIZES_UT[0] < size < _SIZES_UT[1]:
        text = f"magnetometer: found {size:.3g} uT, expected the earth's 25 to 65"
        fix = magnetic_advice(size) or "is it uncalibrated, in another unit or near a magnet?"
        result.append(Finding("field_size", text, fix, values={"size_uT": size}))
    if agreement is not None and agreement < _VERDICTS[-1][2]:
        text = f"magnetometer: does not follow the gyroscope (correlation {agreement:.2f})"
        fix = "a disturbed field, stale readings or different axes"
        result.append(Finding("field_axes", text, fix, values={"correlation": agreement}))
    if iron is not None:
        offset = ", ".join(f"{b:+.0f}" for b in iron)
        text = f"magnetometer: the device adds a constant field of {offset} uT (hard iron)"
        values = {"iron_uT": iron.tolist()}
        result.append(Finding("hard_iron", text, level="note", values=values))
    if figures["dip_rad"] < -_UP_RAD:
        up = math.degrees(-figures["dip_rad"])
        text = f"magnetometer: points up by {up:.0f} degrees, as south of the magnetic equator"
        fix = "elsewhere, the accelerometer has Apple's sign: pass `--accel-sign apple`"
        result.append(Finding("field_up", text, fix, values={"up_deg": up}))
    return result


def _against_gyro(
    time: FloatArray, gyro: FloatArray, stamps: FloatArray, values: FloatArray
) -> tuple[float | None, float | None, FloatArray | None, FloatArray | None]:
    """Return correlation, lag [s], hard iron and its sigma [uT], from dm/dt = -w x (m - b).

    A lag at the edge of the search is not the best one and corrupts the hard iron: both are None.
    """
    edge = _SPAN_S + float(np.abs(_LAGS_S).max())
    grid = even_grid(max(time[0], stamps[0]) + edge, min(time[-1], stamps[-1]) - edge, _STEP_S)
    if len(grid) < 20:
        return None, None, None, None
    angle = integral(time, gyro)
    half = 0.5 * _SPAN_S
    before, after = (interpolated(grid + d, time, angle) for d in (-half, half))
    rate = (after - before) / _SPAN_S

    def fit(lag: float) -> tuple[float, FloatArray, FloatArray]:
        before, after = (interpolated(grid + lag + d, stamps, values) for d in (-half, half))
        change, mean = (after - before) / _SPAN_S, 0.5 * (after + before)
        # dm/dt + w x m = w x b, linear in b
        cross = np.cross(rate[:, None, :], np.eye(3)[None]).transpose(0, 2, 1).reshape(-1, 3)
        target = (change + np.cross(rate, mean)).ravel()
        normal = cross.T @ cross + 1e-9 * np.eye(3)
        iron = np.asarray(np.linalg.solve(normal, cross.T @ target), dtype=np.float64)
        residual = target - cross @ iron
        # Neighbours share half their span and disturbances last: a tenth of the rows counts.
        spread = np.sqrt(10.0 * float(residual.var()) * np.diag(np.linalg.inv(normal)))
        expected = -np.cross(rate, mean - iron).ravel()
        return correlation(change.ravel(), expected), iron, np.asarray(spread, dtype=np.float64)

    scores = np.array([fit(lag)[0] for lag in _LAGS_S])
    best = int(np.argmax(scores))
    if best in (0, len(scores) - 1):
        return float(scores[best]), None, None, None
    step = float(_LAGS_S[1] - _LAGS_S[0])
    lag = float(_LAGS_S[best]) + peak_offset(*scores[best - 1 : best + 2]) * step
    agreement, iron, spread = fit(lag)
    return agreement, lag, iron, spread


def _held(time: FloatArray, field: FloatArray) -> float:
    """Return the share of half seconds with rotation in which a field's (n, 3) size is constant."""
    later = np.searchsorted(time, time + _HALF_SECOND)
    first = np.flatnonzero(later < len(time))
    size = np.maximum(np.linalg.norm(field, axis=1), _NO_FIELD_UT)
    before, after = (field[k] / size[k, None] for k in (first, later[first]))
    turned = np.linalg.norm(after - before, axis=1) > _TURNED_RAD
    same = np.abs(size[later[first]] / size[first] - 1.0) < HELD_CHANGE
    return float(same[turned].mean()) if turned.any() else 0.0


def _steadiness(time: FloatArray, level: FloatArray) -> tuple[float, float]:
    """Return the RMS deviation of a bearing from a line [rad] and the line's slope [rad/s].

    Both are medians over windows of a minute of the level field (N, 2). The line is fitted to means
    over a second, so that a sample near a magnet does not add a full turn.
    """
    count = samples_in(1.0, time)
    field = level[:, 0] + 1j * level[:, 1]
    smooth = np.convolve(field, np.ones(count) / count, mode="same")
    spreads, slopes = [], []
    last = max(float(time[-1]) - 0.5 * _WINDOW_S, float(time[0]) + 1e-9)
    for edge in even_grid(time[0], last, _WINDOW_S):
        part = (time >= edge) & (time < edge + _WINDOW_S)
        if part.sum() > count:
            clock = time[part] - edge
            line = np.polyfit(clock, np.unwrap(np.angle(smooth[part])), 1)
            residual = np.angle(field[part] * np.exp(-1j * np.polyval(line, clock)))
            spreads.append(float(np.sqrt(np.square(residual).mean())))
            slopes.append(float(line[0]))
    if not slopes:
        return math.inf, 0.0
    return float(np.median(spreads)), float(np.median(slopes))
