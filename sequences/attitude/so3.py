"""Closed-form functions of the matrix group SO(3), vectorised over stacks.

Source: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
2018, appendix B.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import FloatArray

# theta @ _HAT is the skew-symmetric matrix of theta, flattened: one product for a whole stack.
_HAT = np.zeros((3, 9))
_HAT[0, [5, 7]] = -1.0, 1.0
_HAT[1, [2, 6]] = 1.0, -1.0
_HAT[2, [1, 3]] = -1.0, 1.0

_SERIES_LIMIT = 1e-3  # t^2 [rad^2] up to which three terms of a series are exact to rounding
_EYE = np.eye(3)
_ONES = np.ones(3)


def skew(vector: FloatArray) -> FloatArray:
    """Return the cross-product matrices [x]x (..., 3, 3) of vectors (..., 3)."""
    return (vector @ _HAT).reshape(*vector.shape[:-1], 3, 3)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b (..., 3); `np.cross` takes ten times as long for a handful of vectors."""
    return (skew(a) @ b[..., None])[..., 0]


def exp_and_left_jacobian(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation matrices exp([theta]x) and left Jacobians J_l(theta), computed together.

    Args:
        theta: (..., 3) rotation vectors [rad].

    Returns:
        Two arrays (..., 3, 3).
    """
    K = skew(theta)
    KK = K @ K
    b, c = series_coefficients(theta)
    J = _EYE + b * K + c * KK
    return _EYE + K @ J, J


def exp_so3(theta: FloatArray) -> FloatArray:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return exp_and_left_jacobian(theta)[0]


def log_so3(R: FloatArray) -> FloatArray:
    """Return the rotation vectors (..., 3) [rad], of norm up to pi, of matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(R, assume_valid=True).as_rotvec(), dtype=np.float64)


def series_coefficients(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (1 - cos t)/t^2 and (t - sin t)/t^3 (..., 1, 1) of Rodrigues' formula, also near 0."""
    squared = (theta * theta) @ _ONES
    b = 0.5 - squared * (1.0 / 24.0 - squared / 720.0)
    c = 1.0 / 6.0 - squared * (1.0 / 120.0 - squared / 5040.0)
    if np.vdot(theta, theta) > _SERIES_LIMIT:
        large = squared > _SERIES_LIMIT
        t = np.sqrt(np.where(large, squared, 1.0))
        b = np.where(large, 2.0 * (np.sin(0.5 * t) / t) ** 2, b)
        c = np.where(large, (t - np.sin(t)) / t**3, c)
    return b[..., None, None], c[..., None, None]
