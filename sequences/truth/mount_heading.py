"""What the accelerometer knows of a mount's turn about the vertical, where the gyroscope does not.

On a trolley a device turns about the vertical alone, and rotation vectors along one axis leave the
mount's turn about that axis open. The accelerometer closes it: what it feels sideways must be the
second derivative of the captured path. With the second difference over h, which is the mean of the
acceleration under a triangle,

    (p(t + h) - 2 p(t) + p(t - h)) / h^2  =  mean of  R_WB (f - b_a) + g + R_WB ([w']x + [w]x^2) s

is linear in a small turn about the vertical, in the accelerometer's bias b_a and in the lever s
from the sensor to the point that is tracked (0.1 m in OxIOD), so that neither is taken for a turn.
Both estimates are weighed by what they know.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import BoolArray, FloatArray

_H_S = 0.3
_TURN_S = 0.1
"""Interval over which the gyroscope is held against the attitude."""

_LEVER_M = 0.3
_BIAS_M_S2 = 0.3
"""What lever and bias are at most about: they stay bounded where a track says little of them."""

_CAUTION = 2.5
"""The force's deviation is taken to be this many times what its residuals say: recordings of one
session, and halves of one recording, differ by that much."""

_MIN_ROWS = 100
_PASSES = 5


def heading_turn(
    time: FloatArray,
    gyro: FloatArray,
    force: FloatArray,
    position_W: FloatArray,
    attitude_WB: Rotation,
    valid: BoolArray,
) -> Rotation:
    """A correction R_BB' of the mount about the vertical: the better attitude is R_WB R_BB'.

    Args:
        time: (N,) [s] of the capture, evenly sampled, on the IMU's clock.
        gyro: (N, 3) angular rate in B [rad/s] at those times.
        force: (N, 3) specific force in B [m/s^2] at those times.
        position_W: (N, 3) of the tracked point in a level world [m].
        attitude_WB: N rotations, right but for a few degrees about the vertical.
        valid: (N,) samples to be trusted.

    Returns:
        The rotation; identity where there is too little to tell.
    """
    up_B = attitude_WB[valid].apply([0.0, 0.0, 1.0], inverse=True).mean(axis=0)
    up_B /= np.linalg.norm(up_B)
    rows = _rows(time, gyro, force, position_W, attitude_WB, valid, up_B)
    if len(rows) < _MIN_ROWS:
        return Rotation.identity()
    known = _gyro_information(time, gyro, attitude_WB, valid, up_B)
    turn = 0.0
    for _ in range(_PASSES):
        step, information = _robust_turn(_turned(rows, turn))
        information /= _CAUTION**2
        step = (information * step - known * turn) / (information + known)
        turn += step
        if abs(step) < 1e-5:
            break
    return Rotation.from_rotvec(turn * up_B)


def _gyro_information(
    time: FloatArray, gyro: FloatArray, attitude_WB: Rotation, valid: BoolArray, up_B: FloatArray
) -> float:
    """Inverse variance [1/rad^2] of the turn about `up_B` that the gyroscope's fit leaves."""
    stride = max(1, round(_TURN_S / float(np.median(np.diff(time)))))
    angle = np.vstack([np.zeros(3), np.cumsum(_trapezia(time, gyro), axis=0)])
    use = valid[:-stride] & valid[stride:]
    use &= np.arange(len(use)) % stride == 0
    phi_B = (angle[stride:] - angle[:-stride])[use]
    starts = np.flatnonzero(use)
    seen = (attitude_WB[starts].inv() * attitude_WB[starts + stride]).as_rotvec()
    deviation = _deviation(seen - phi_B)
    return float(np.square(np.cross(phi_B, up_B)).sum() / deviation**2)


def _trapezia(time: FloatArray, rate: FloatArray) -> FloatArray:
    return np.asarray(0.5 * np.diff(time)[:, None] * (rate[1:] + rate[:-1]), dtype=np.float64)


def _deviation(residual: FloatArray) -> float:
    """Standard deviation by the median, deaf to outliers."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-9)


def _rows(
    time: FloatArray,
    gyro: FloatArray,
    force: FloatArray,
    position_W: FloatArray,
    attitude_WB: Rotation,
    valid: BoolArray,
    up_B: FloatArray,
) -> FloatArray:
    """Rows (M, 10), two for each of the moments, of which each column is a mean in W.

    Lever (3), bias (3), the force's part along `up_B`, its part across, that part turned by 90
    degrees, and the second difference of the position.
    """
    dt = float(np.median(np.diff(time)))
    k = max(1, round(_H_S / dt))
    whole = minimum_filter1d(valid.astype(np.int8), 2 * k + 1, mode="constant") > 0
    moments = np.flatnonzero(whole)[:: max(1, k // 2)]
    if not len(moments):
        return np.empty((0, 10))
    spin = np.gradient(uniform_filter1d(gyro, 5, axis=0), dt, axis=0)
    along = np.outer(force @ up_B, up_B)
    columns = [np.cross(gyro, np.cross(gyro, axis)) + np.cross(spin, axis) for axis in np.eye(3)]
    columns += [np.tile(axis, (len(time), 1)) for axis in np.eye(3)]
    columns += [along, force - along, np.cross(up_B, force)]
    matrices = attitude_WB.as_matrix()[:, :2]  # only what is level counts
    level = np.matmul(matrices, np.stack(columns, axis=2)).reshape(len(time), 18)
    means = _triangle(level, k)[moments].reshape(-1, 9)
    second = position_W[moments + k] - 2.0 * position_W[moments] + position_W[moments - k]
    return np.column_stack([means, second[:, :2].reshape(-1) / (k * dt) ** 2])


def _turned(rows: FloatArray, turn: float) -> FloatArray:
    """The linear system (M, 8) about a turn: for a further turn, lever, bias; what they explain."""
    along, across, turned, second = rows[:, 6:].T
    sine, cosine = np.sin(turn), np.cos(turn)
    missing = second - along - cosine * across - sine * turned
    return np.column_stack([cosine * turned - sine * across, rows[:, :6], missing])


def _triangle(values: FloatArray, k: int) -> FloatArray:
    """Mean under a triangle of half width `k` rows, centred."""
    once = uniform_filter1d(values, k, axis=0)
    return np.asarray(uniform_filter1d(once, k, axis=0, origin=-1 if k % 2 == 0 else 0))


def _robust_turn(rows: FloatArray) -> tuple[float, float]:
    """The turn [rad] and its inverse variance, lever and bias estimated beside it."""
    A, b = rows[:, :7], rows[:, 7]
    weights = np.ones(len(rows))
    prior = np.array([0.0, *[1 / _LEVER_M**2] * 3, *[1 / _BIAS_M_S2**2] * 3])
    deviation = _deviation(b)
    for _ in range(_PASSES):
        normal = (A * weights[:, None]).T @ A / deviation**2 + np.diag(prior)
        x = np.linalg.solve(normal, (A * weights[:, None]).T @ b / deviation**2)
        residual = b - A @ x
        deviation = _deviation(residual)
        weights = 1.0 / (1.0 + np.square(residual / (2.0 * deviation))) ** 2
    # Rows half a window apart: every second one says something new.
    variance = 2.0 * np.linalg.inv(normal)[0, 0]
    return float(x[0]), float(1.0 / variance)
