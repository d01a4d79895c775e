"""Rotation of a mount about the vertical, from the accelerometer where the gyroscope fails.

On a trolley a device rotates about the vertical only, and rotation vectors along one axis do not
determine the mount's rotation about that axis. The accelerometer does: the horizontal acceleration
must be the second derivative of the captured path. With the second difference over h, which is the
mean of the acceleration under a triangle,

    (p(t + h) - 2 p(t) + p(t - h)) / h^2  =  mean of  R_WB (f - b_a) + g + R_WB ([w']x + [w]x^2) s

is linear in a small rotation about the vertical, in the accelerometer bias b_a and in the lever arm
s from the sensor to the tracked point (0.1 m in OxIOD), so that neither is mistaken for a rotation.
The estimates of gyroscope and accelerometer are weighted by their information.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import integral, samples_in
from stario.sequences.sequence import BoolArray, FloatArray

_H_S = 0.3
_TURN_S = 0.1
"""Interval over which gyroscope and attitude are compared [s]."""

_LEVER_M = 0.3
_BIAS_M_S2 = 0.3
"""Prior sigmas of lever arm and bias, which bound them where a track determines them poorly."""

_CAUTION = 2.5
"""Factor by which the accelerometer's deviation is taken to exceed that of its residuals: results
of recordings of one session, and of halves of one recording, differ by that much."""

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
    """Return a mount correction R_BB' about the vertical; corrected attitudes are R_WB R_BB'.

    Args:
        time: (N,) times of the capture [s], evenly sampled, on the IMU's clock.
        gyro: (N, 3) angular rate in B [rad/s] at those times.
        force: (N, 3) specific force in B [m/s^2] at those times.
        position_W: (N, 3) positions of the tracked point in a level world [m].
        attitude_WB: N rotations, correct except for a few degrees about the vertical.
        valid: (N,) bool, whether a sample may be used.

    Returns:
        The rotation; identity if there are too few samples.
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
    """Return the inverse variance [1/rad^2] of the gyroscope's fit for rotation about `up_B`."""
    stride = samples_in(_TURN_S, time)
    angle = integral(time, gyro)
    use = valid[:-stride] & valid[stride:]
    use &= np.arange(len(use)) % stride == 0
    phi_B = (angle[stride:] - angle[:-stride])[use]
    starts = np.flatnonzero(use)
    phi_attitude = (attitude_WB[starts].inv() * attitude_WB[starts + stride]).as_rotvec()
    deviation = _deviation(phi_attitude - phi_B)
    return float(np.square(np.cross(phi_B, up_B)).sum() / deviation**2)


def _deviation(residual: FloatArray) -> float:
    """Return the standard deviation from the median, robust to outliers."""
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
    """Return rows (M, 10), two for each instant, whose columns are means in W.

    Lever arm (3), bias (3), the force along `up_B`, the force perpendicular to it, the latter
    rotated by 90 degrees, and the second difference of the position.
    """
    dt = float(np.median(np.diff(time)))
    k = samples_in(_H_S, time)
    whole = minimum_filter1d(valid.astype(np.int8), 2 * k + 1, mode="constant") > 0
    moments = np.flatnonzero(whole)[:: max(1, k // 2)]
    if not len(moments):
        return np.empty((0, 10))
    spin = np.gradient(uniform_filter1d(gyro, 5, axis=0), dt, axis=0)
    along = np.outer(force @ up_B, up_B)
    columns = [np.cross(gyro, np.cross(gyro, axis)) + np.cross(spin, axis) for axis in np.eye(3)]
    columns += [np.tile(axis, (len(time), 1)) for axis in np.eye(3)]
    columns += [along, force - along, np.cross(up_B, force)]
    matrices = attitude_WB.as_matrix()[:, :2]  # only horizontal components are used
    level = np.matmul(matrices, np.stack(columns, axis=2)).reshape(len(time), 18)
    means = _triangle(level, k)[moments].reshape(-1, 9)
    second = position_W[moments + k] - 2.0 * position_W[moments] + position_W[moments - k]
    return np.column_stack([means, second[:, :2].reshape(-1) / (k * dt) ** 2])


def _turned(rows: FloatArray, turn: float) -> FloatArray:
    """Return the linear system (M, 8) at `turn`: further turn, lever, bias; right-hand side."""
    along, across, turned, second = rows[:, 6:].T
    sine, cosine = np.sin(turn), np.cos(turn)
    missing = second - along - cosine * across - sine * turned
    return np.column_stack([cosine * turned - sine * across, rows[:, :6], missing])


def _triangle(values: FloatArray, k: int) -> FloatArray:
    """Return the centred mean under a triangle of half width `k` rows."""
    once = uniform_filter1d(values, k, axis=0)
    return np.asarray(uniform_filter1d(once, k, axis=0, origin=-1 if k % 2 == 0 else 0))


def _robust_turn(rows: FloatArray) -> tuple[float, float]:
    """Return the turn [rad] and its inverse variance, estimated jointly with lever and bias."""
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
    # Rows are half a window apart: only every second one adds information.
    variance = 2.0 * np.linalg.inv(normal)[0, 0]
    return float(x[0]), float(1.0 / variance)
