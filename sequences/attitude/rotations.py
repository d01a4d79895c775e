"""Rotations, as readers, windows, metrics and estimators need them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import FloatArray

NORM_TOLERANCE = 1e-2
"""Largest deviation of a quaternion's norm from 1 that rounding in a file explains."""


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
    steps = 0.5 * np.diff(time)[:, None] * (gyro[1:] + gyro[:-1])
    return Rotation.from_quat(cumulative_rotations(Rotation.from_rotvec(steps)))


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Multiply quaternions (..., 4), xyzw; SciPy's composition is far slower."""
    a, b = p[..., :3], q[..., :3]
    vector = p[..., 3:] * b + q[..., 3:] * a + np.cross(a, b)
    scalar = p[..., 3] * q[..., 3] - np.sum(a * b, axis=-1)
    return np.concatenate([vector, scalar[..., None]], axis=-1)
