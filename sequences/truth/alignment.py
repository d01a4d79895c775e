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
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import correlation, interpolated, peak_offset, samples_in
from stario.sequences.attitude.levelling import MIN_GRAVITY_FORCE
from stario.sequences.attitude.rotations import GyroIntegral, tilt_aligning
from stario.sequences.attitude.stacks import composed
from stario.sequences.errors import InputError
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.truth.mount_heading import heading_turn
from stario.sequences.truth.mounts import (
    MIN_FIT_S,
    disagreeing,
    fitted_mounts,
    pieces_between_jumps,
)

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
    attitude_B = gyro_B.attitude(time)
    valid = valid & ~disagreeing(time, attitude_WV, attitude_B)
    pieces = pieces_between_jumps(time, attitude_WV, attitude_B, valid)
    start, stop = max(pieces, key=lambda piece: piece[1] - piece[0], default=(0, 0))
    _check_length("capture that agrees with the gyroscope", time[start:stop])
    mounts = fitted_mounts(time, attitude_WV, gyro_B, pieces)
    kept = np.zeros_like(valid)
    for start, stop in pieces:
        kept[start:stop] = valid[start:stop]
    # From magnitudes alone, the capture's noise costs up to 12 ms on a trolley, which hardly turns.
    rates = _agreement(gyro_B, time, _mounted(attitude_WV, pieces, mounts), kept, 0.06)
    lag += _best_lag(rates, _REMAINING_LAG_S)
    time = truth_time + lag
    mounts = fitted_mounts(time, attitude_WV, gyro_B, pieces)
    force_B, rate_B = interpolated(time, imu_time, accel), interpolated(time, imu_time, gyro)
    attitude_WB, leveling = _level(_mounted(attitude_WV, pieces, mounts), force_B, kept)
    if position_WV is not None:
        inside = kept & (time >= imu_time[0]) & (time <= imu_time[-1])
        turn = heading_turn(time, rate_B, force_B, leveling.apply(position_WV), attitude_WB, inside)
        mounts = [mount * turn for mount in mounts]
        attitude_WB, leveling = _level(_mounted(attitude_WV, pieces, mounts), force_B, kept)
    # With the mount known, glitches about another axis than the motion's are detected as well.
    drift = composed(attitude_WB, gyro_B.attitude(time).inv())
    kept &= ~disagreeing(time, drift, Rotation.identity(len(drift)))
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


def _mounted(
    attitude_WV: Rotation, pieces: list[tuple[int, int]], mounts: list[Rotation]
) -> Rotation:
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
    good = valid[:-stride] & valid[stride:] & (np.linalg.norm(rates, axis=1) < 12.0)
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
