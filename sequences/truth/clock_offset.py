"""Offset between two clocks whose sensors measured the same rotation."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.spatial.transform import Rotation

from stario.sequences.errors import InputError
from stario.sequences.sequence import BoolArray, FloatArray

_GRID_HZ = 50.0
_NEAR_CLOCKS_S = 5.0
_FASTEST_RAD_S = 12.0
"""Faster rotation is a glitch of the capture [rad/s]."""


def clock_offset(
    imu_time: FloatArray,
    gyro: FloatArray,
    truth_time: FloatArray,
    attitude_WV: Rotation,
    valid: BoolArray,
) -> float:
    """Return the offset [s] to add to the truth's clock, from the rotation that both measured.

    If both stretches overlap in time, offsets of up to 5 s are searched, otherwise all of them. The
    result is accurate to a few hundredths of a second; `align_tracked_body` refines it.

    Args:
        imu_time: (N,) [s].
        gyro: (N, 3) angular rate in B [rad/s].
        truth_time: (M,) [s], strictly increasing.
        attitude_WV: M rotations of the tracked body.
        valid: (M,) bool, whether a sample may be used at all.

    Raises:
        InputError: there are fewer than two valid samples, or a clock jumps by days.
    """
    known = np.flatnonzero(valid)
    if min(len(known), len(imu_time)) < 2:
        raise InputError("clocks", f"{len(known)} valid poses", "at least 2, and 2 IMU samples")
    turned = (attitude_WV[known[:-1]].inv() * attitude_WV[known[1:]]).magnitude()
    steps = np.diff(truth_time[known])
    speed_V = np.where(steps < 0.1, turned / steps, np.nan)
    start_B, start_V = float(imu_time[0]), float(truth_time[known[0]])
    rates_B = _on_grid(imu_time - start_B, np.linalg.norm(gyro, axis=1))
    rates_V = _on_grid(truth_time[known[1:]] - start_V, speed_V)
    start_offset = start_B - start_V
    lags, scores = _correlations(rates_B, rates_V)
    overlapping = start_V < imu_time[-1] and start_B < truth_time[known[-1]]
    near = np.abs(lags / _GRID_HZ + start_offset) <= _NEAR_CLOCKS_S
    if overlapping and near.any():
        lags, scores = lags[near], scores[near]
    return float(lags[int(np.argmax(scores))]) / _GRID_HZ + start_offset


_LONGEST_S = 2.0 * 86_400.0
"""Longest plausible recording [s]: a single time off by decades must not cost memory."""


def _on_grid(time: FloatArray, speed: FloatArray) -> FloatArray:
    """Average the angular speed over each step of a 50 Hz grid; NaN where there is none."""
    use = np.isfinite(speed) & (speed < _FASTEST_RAD_S)
    if not use.any() or float(time[use].max()) > _LONGEST_S:
        raise InputError("truth's clock", "times that jump by days", "times of one recording")
    cells = np.rint(time[use] * _GRID_HZ).astype(np.int64)
    count = np.bincount(cells)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(cells, weights=speed[use]) / count, dtype=np.float64)


def _correlations(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Correlate a(k + lag) with b(k) at every lag at which half the shorter one overlaps."""
    masks = [np.isfinite(x).astype(np.float64) for x in (a, b)]
    values = [np.nan_to_num(x - np.nanmean(x)) for x in (a, b)]
    lags = np.arange(-(len(b) - 1), len(a)).astype(np.float64)
    common = convolved(masks[0], masks[1][::-1])
    products = convolved(values[0], values[1][::-1])
    power_a = convolved(values[0] ** 2, masks[1][::-1])
    power_b = convolved(masks[0], values[1][::-1] ** 2)
    enough = common >= 0.5 * min(masks[0].sum(), masks[1].sum())
    # An even gait resembles itself some steps later: of equal correlations the longest counts.
    longest = np.sqrt(np.maximum(common, 0.0) / max(float(common.max()), 1.0))
    scores = longest * products / np.sqrt(np.maximum(power_a * power_b, 1e-12))
    return lags[enough], np.asarray(scores[enough], dtype=np.float64)


def convolved(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the full convolution of two rows; importing `scipy.signal` for it takes a second."""
    count = len(x) + len(y) - 1
    size = next_fast_len(count, real=True)
    return np.asarray(irfft(rfft(x, size) * rfft(y, size), size)[:count], dtype=np.float64)
