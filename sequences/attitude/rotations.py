"""Rotations, as readers, windows, metrics and estimators need them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import integral, interpolated, trapezoids
from stario.sequences.attitude.stacks import composed
from stario.sequences.sequence import FloatArray

NORM_TOLERANCE = 1e-2
"""Largest deviation of a quaternion's norm from 1 that rounding in a file explains."""

_MAX_GYRO_GAP_S = 0.5
"""Longest step of the gyroscope that is integrated across [s]."""


def yaw_of(attitude_WB: Rotation) -> FloatArray:
    """Return the yaw [rad], in (-pi, pi], of the twist about world z (singular only upside down).

    The twist is the rotation that remains when the smallest tilt is removed; unlike an Euler angle
    its yaw stays defined when a device stands upright.
    """
    quat_xyzw = np.atleast_2d(attitude_WB.as_quat())
    angle = 2.0 * np.arctan2(quat_xyzw[:, 2], quat_xyzw[:, 3])
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi), dtype=np.float64)


def about_z(yaw: FloatArray | float) -> Rotation:
    """Return the rotation by `yaw` [rad] about the world's vertical."""
    return Rotation.from_rotvec(np.multiply.outer(np.asarray(yaw, dtype=np.float64), [0.0, 0, 1]))


def tilt_aligning(up_B: FloatArray) -> Rotation:
    """Return the smallest rotation R_WB that takes direction `up_B` (3,) to world z (zero yaw)."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], np.atleast_2d(up_B))[0]


def cumulative_rotations(steps: Rotation) -> FloatArray:
    """Return the products 1, q_0, q_0 q_1, ... (N + 1, 4), xyzw, in about 2 sqrt(N) array steps."""
    count = len(steps) + 1
    width = int(np.ceil(np.sqrt(count)))
    padded = np.tile([0.0, 0.0, 0.0, 1.0], (width * width, 1))
    padded[1:count] = steps.as_quat()
    blocks = padded.reshape(width, width, 4)
    for k in range(1, width):
        blocks[:, k] = _product(blocks[:, k - 1], blocks[:, k])
    starts = blocks[:, -1].copy()
    for k in range(1, width):
        starts[k] = _product(starts[k - 1], starts[k])
    blocks[1:] = _product(starts[:-1, None], blocks[1:])
    products = blocks.reshape(-1, 4)[:count]
    return np.asarray(products / np.linalg.norm(products, axis=1)[:, None], dtype=np.float64)


def integrated_gyro(time: FloatArray, gyro: FloatArray) -> Rotation:
    """Return the attitudes R_0B (N,) relative to the first sample, by the trapezoidal rule.

    Args:
        time: (N,) without gaps [s].
        gyro: (N, 3) [rad/s].
    """
    turns = Rotation.from_rotvec(trapezoids(time, gyro))
    return Rotation.from_quat(cumulative_rotations(turns))


class GyroIntegral:
    """Attitude integrated from the gyroscope, at any time, and the rate's running integral."""

    def __init__(self, time: FloatArray, gyro: FloatArray) -> None:
        self.time = time
        self.angle = integral(time, gyro)
        self._attitude = integrated_gyro(time, gyro)
        self._rate = gyro

    def attitude(self, time: FloatArray) -> Rotation:
        """Return attitudes of B relative to its start at times in the recording (else clamped)."""
        clipped = np.clip(time, self.time[0], self.time[-1])
        left = np.clip(np.searchsorted(self.time, clipped, side="right") - 1, 0, len(self.time) - 2)
        tau = clipped - self.time[left]
        turn = Rotation.from_rotvec(self._rate[left] * tau[:, None])
        return composed(self._attitude[left], turn)

    def has_long_gap(self, start: float, stop: float) -> bool:
        """Return whether the samples between two times have a gap too long to integrate across."""
        first, last = np.searchsorted(self.time, [start, stop])
        inside = self.time[max(first - 1, 0) : last + 1]
        return bool(np.diff(inside).max(initial=0.0) > _MAX_GYRO_GAP_S)

    def mean_rate(self, time: FloatArray, stride: int) -> FloatArray:
        """Return mean rates (M - stride, 3) [rad/s] from each time to the one `stride` later."""
        angle = interpolated(time, self.time, self.angle)
        lengths = time[stride:] - time[:-stride]
        return np.asarray((angle[stride:] - angle[:-stride]) / lengths[:, None], dtype=np.float64)


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Multiply quaternions (..., 4), xyzw; SciPy's composition is far slower."""
    return np.asarray(((p @ _LEFT).reshape(*p.shape[:-1], 4, 4) @ q[..., None])[..., 0])


def _left_matrix(p: FloatArray) -> FloatArray:
    """Return the matrix of q -> p q (Sola 2017, "Quaternion kinematics", eq. 19), in xyzw."""
    x, y, z, w = p
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])


_LEFT = np.array([_left_matrix(p).ravel() for p in np.eye(4)])
"""p @ _LEFT is the flattened matrix of p: one product for a whole stack, as in `so3.skew`."""
