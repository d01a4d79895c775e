"""Time offset and mount between an IMU and the body that a motion-capture system tracks.

Frames: V is the tracked body (markers), B the IMU, W the capture system's world. The IMU is
fixed to the tracked body with a constant rotation R_VB (the mount), and its clock is off by a
constant lag. Over any short interval both measure the same rotation, in their own axes:

    R_VB  dR_B  =  dR_V  R_VB      so that      phi_V = R_VB phi_B

for the rotation vectors phi. If the system mistakes the tracked body for its mirror image (a flip
by 170-180 degrees), dR_V jumps but the gyroscope measures no such rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import correlation, interpolated, peak_offset, samples_in
from stario.sequences.attitude.levelling import MIN_GRAVITY_FORCE
from stario.sequences.attitude.mounts import (
    MIN_FIT_S,
    Piece,
    Rotations,
    disagreeing,
    fitted_mounts,
    heading_turn,
    pieces_between_jumps,
)
from stario.sequences.attitude.rotations import GyroIntegral, tilt_aligning
from stario.sequences.attitude.stacks import composed
from stario.sequences.errors import InputError
from stario.sequences.sequence import BoolArray, FloatArray

_LAG_STEP_S = 0.0025
_MAX_LAG_S, _REMAINING_LAG_S = 0.15, 0.04
_CORRELATED_S = 0.1


@dataclass(frozen=True)
class BodyAlignment:
    """Result of `align_tracked_body`.

    Attributes:
        lag: offset to be added to the truth's time [s].
        correlation: correlation of gyroscope and attitude rate, both over 0.1 s, in B.
        attitude_WB: attitudes of the IMU at the truth's samples, with levelling and mount applied.
        leveling_WW: rotation that levels the world, to be applied to positions.
        valid: (M,) bool, whether a truth sample's attitude agrees with the gyroscope.
        mounts: first and last time [s] and R_VB of each piece between flips.
    """

    lag: float
    correlation: float
    attitude_WB: Rotation
    leveling_WW: Rotation
    valid: BoolArray
    mounts: tuple[tuple[float, float, Rotation], ...]


def align_tracked_body(
    imu_time: FloatArray,
    gyro: FloatArray,
    accel: FloatArray,
    truth_time: FloatArray,
    attitude_WV: Rotation,
    valid: BoolArray,
    position_WV: FloatArray | None = None,
) -> BodyAlignment:
    """Estimate the lag, the mount (separately after every flip) and the tilt of the world.

    Args:
        imu_time: (N,) [s].
        gyro: (N, 3) angular rate in B [rad/s].
        accel: (N, 3) specific force in B [m/s^2].
        truth_time: (M,) [s], evenly sampled, on the IMU's clock except for the lag.
        attitude_WV: M rotations of the tracked body.
        valid: (M,) bool, whether a sample may be used at all.
        position_WV: (M, 3) positions of the tracked body [m]; with them the accelerometer helps to
            find the mount's rotation about the vertical, which the gyroscope misses on wheels.

    Raises:
        InputError: less than 10 s without a break in which both measured the same rotations, or
            no gravity in the accelerometer.
    """
    _check_length("recording", imu_time)
    _check_length("capture", truth_time[valid])
    gyro_B = GyroIntegral(imu_time, gyro)
    sizes = _agreement(gyro_B, truth_time, attitude_WV, valid, 0.04, sizes_only=True)
    lag = _best_lag(sizes, _MAX_LAG_S)
    time = truth_time + lag
    both = Rotations(time, attitude_WV, gyro_B.attitude(time))
    valid = valid & ~disagreeing(both)
    pieces = pieces_between_jumps(both, valid)
    start, stop = max(pieces, key=lambda piece: piece[1] - piece[0], default=(0, 0))
    _check_length("capture that agrees with the gyroscope", time[start:stop])
    mounts = fitted_mounts(both, gyro_B, pieces)
    kept = np.zeros_like(valid)
    for start, stop in pieces:
        kept[start:stop] = valid[start:stop]
    # From magnitudes alone, the capture's noise costs up to 12 ms on a trolley, which hardly turns.
    rates = _agreement(gyro_B, time, _mounted(attitude_WV, pieces, mounts), kept, 0.06)
    lag += _best_lag(rates, _REMAINING_LAG_S)
    time = truth_time + lag
    both = Rotations(time, attitude_WV, gyro_B.attitude(time))
    mounts = fitted_mounts(both, gyro_B, pieces)
    force_B, rate_B = interpolated(time, imu_time, accel), interpolated(time, imu_time, gyro)
    attitude_WB, leveling = _level(_mounted(attitude_WV, pieces, mounts), force_B, kept)
    if position_WV is not None:
        inside = kept & (time >= imu_time[0]) & (time <= imu_time[-1])
        turn = heading_turn(time, rate_B, force_B, leveling.apply(position_WV), attitude_WB, inside)
        mounts = [mount * turn for mount in mounts]
        attitude_WB, leveling = _level(_mounted(attitude_WV, pieces, mounts), force_B, kept)
    # With the mount known, glitches about another axis than the motion's are detected as well.
    drift = composed(attitude_WB, both.attitude_B.inv())
    kept &= ~disagreeing(Rotations(time, drift, Rotation.identity(len(drift))))
    return BodyAlignment(
        lag=lag,
        # Over a shorter span, the capture's noise hides a trolley's turns.
        correlation=_agreement(gyro_B, time, attitude_WB, kept, _CORRELATED_S)(0.0),
        attitude_WB=attitude_WB,
        leveling_WW=leveling,
        valid=kept,
        mounts=tuple(
            (float(time[start]), float(time[stop - 1]), mount)
            for (start, stop), mount in zip(pieces, mounts, strict=True)
        ),
    )


def _mounted(attitude_WV: Rotation, pieces: list[Piece], mounts: list[Rotation]) -> Rotation:
    """Return the IMU's attitude in the capture system's world, each piece with its mount."""
    quat_WB = attitude_WV.as_quat()
    for (start, stop), mount in zip(pieces, mounts, strict=True):
        quat_WB[start:stop] = composed(attitude_WV[start:stop], mount).as_quat()
    return Rotation.from_quat(quat_WB)


def _level(
    attitude_WB: Rotation, force_B: FloatArray, kept: BoolArray
) -> tuple[Rotation, Rotation]:
    """Return the attitude in a world whose mean force points up, and the rotation to it."""
    up = attitude_WB[kept].apply(force_B[kept]).mean(axis=0)
    if not np.linalg.norm(up) > MIN_GRAVITY_FORCE:
        found = f"a mean force of {np.linalg.norm(up):.3g} m/s^2"
        raise InputError("accelerometer", found, "gravity, to level the truth with")
    leveling = tilt_aligning(up)
    return composed(leveling, attitude_WB), leveling


def _check_length(what: str, time: FloatArray) -> None:
    length = float(time[-1] - time[0]) if len(time) else 0.0
    if length < MIN_FIT_S:
        raise InputError(what, f"{length:.4g} s", f"at least {MIN_FIT_S:.0f} s to find the mount")


def _agreement(
    gyro_B: GyroIntegral,
    time: FloatArray,
    attitude: Rotation,
    valid: BoolArray,
    span: float,
    sizes_only: bool = False,
) -> Callable[[float], float]:
    """Return the correlation of both rates over `span` [s] as a function of the lag [s].

    Magnitudes alone (`sizes_only`) need no mount. Glitches are rare but huge: only rates that do
    not differ grossly are compared.
    """
    stride = samples_in(span, time)
    rates = composed(attitude[:-stride].inv(), attitude[stride:]).as_rotvec()
    rates = rates / (time[stride:] - time[:-stride])[:, None]
    good = valid[:-stride] & valid[stride:] & (np.linalg.norm(rates, axis=1) < _FASTEST_RAD_S)
    if sizes_only:
        rates = np.linalg.norm(rates, axis=1, keepdims=True)

    def score(lag: float) -> float:
        measured = gyro_B.mean_rate(time + lag, stride)
        if sizes_only:
            measured = np.linalg.norm(measured, axis=1, keepdims=True)
        use = good & (np.linalg.norm(rates - measured, axis=1) < 3.0)
        return correlation(rates[use], measured[use])

    return score


def _best_lag(score: Callable[[float], float], reach: float) -> float:
    """Return the lag of the highest score within reach: coarse, then fine, then by a parabola."""
    coarse = np.arange(-reach, reach + 1e-9, 4 * _LAG_STEP_S)
    centre = coarse[int(np.argmax([score(lag) for lag in coarse]))]
    lags = centre + _LAG_STEP_S * np.arange(-4, 5)
    scores = [score(lag) for lag in lags]
    best = int(np.clip(np.argmax(scores), 1, len(lags) - 2))
    offset = np.clip(peak_offset(*scores[best - 1 : best + 2]), -1.0, 1.0)
    return float(lags[best] + offset * _LAG_STEP_S)


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
