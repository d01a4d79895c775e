"""Rotations and extended poses as matrix groups: SO(3), SE(3) and SE_2(3) in closed form.

Every function works on stacks, leading axes first, because the filter corrects all of its clones at
once. Conventions: X = exp(xi) with xi = (theta, rho_v, rho_p), rotation [rad] first; the left
Jacobian J carries the translation parts, exp(theta, rho) = (exp(theta), J(theta) rho).

Source: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
2018, appendices B and D; A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable
observer", 2017, for SE_2(3).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

# theta @ _HAT is the skew-symmetric matrix of theta, flattened: one product for a whole stack.
_HAT = np.zeros((3, 9))
_HAT[0, [5, 7]] = -1.0, 1.0
_HAT[1, [2, 6]] = 1.0, -1.0
_HAT[2, [1, 3]] = -1.0, 1.0

_SERIES_LIMIT = 1e-3  # t^2 [rad^2] up to which three terms of a series are exact to rounding
_EYE = np.eye(3)
_ONES = np.ones(3)


def skew(vector: FloatArray) -> FloatArray:
    """Cross-product matrices [x]x (..., 3, 3) of vectors (..., 3)."""
    return (vector @ _HAT).reshape(*vector.shape[:-1], 3, 3)


def exp_and_left_jacobian(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrices exp([theta]x) and left Jacobians J_l(theta), sharing their work.

    Args:
        theta: (..., 3) rotation vectors [rad].

    Returns:
        Two arrays (..., 3, 3).
    """
    K = skew(theta)
    KK = K @ K
    b, c = _coefficients(theta)
    J = _EYE + b * K + c * KK
    return _EYE + K @ J, J


def exp_times(theta: FloatArray, rho: FloatArray, X: FloatArray) -> FloatArray:
    """exp(theta, rho) X for a stack of poses, without forming the exponential.

    By Rodrigues' formula in homogeneous form, exp(A) X = X + A X + b A^2 X + c A^3 X, where A maps
    [R | p] to [K R | K p + rho] once and multiplies by K = [theta]x from then on.

    Args:
        theta: (n, 3) rotation vectors [rad].
        rho: (n, 3, m) translation parts, one column per vector of the pose.
        X: (n, 3, 3 + m) poses [R | vectors].
    """
    K = skew(theta)
    b, c = _coefficients(theta)
    first = K @ X
    first[:, :, 3:] += rho
    second = K @ first
    return X + first + (b * _EYE + c * K) @ second


def exp_so3(theta: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return exp_and_left_jacobian(theta)[0]


def log_so3(R: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) [rad], of norm up to pi, of rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(R, assume_valid=True).as_rotvec(), dtype=np.float64)


def exp_se23(xi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Exponential of SE_2(3).

    Args:
        xi: (..., 9) theta [rad], rho_v [m/s], rho_p [m].

    Returns:
        R (..., 3, 3), v (..., 3), p (..., 3).
    """
    R, J = exp_and_left_jacobian(xi[..., :3])
    return R, (J @ xi[..., 3:6, None])[..., 0], (J @ xi[..., 6:9, None])[..., 0]


def log_se23(R: FloatArray, v: FloatArray, p: FloatArray) -> FloatArray:
    """Logarithm (..., 9) of SE_2(3), the inverse of `exp_se23` for angles below pi."""
    theta = log_so3(R)
    _, J = exp_and_left_jacobian(theta)
    rho = np.linalg.solve(J, np.stack([v, p], axis=-1))
    return np.concatenate([theta, rho[..., 0], rho[..., 1]], axis=-1)


# Yaw of a rotation is that of its twist about the vertical: R is split into a tilt and a turn about
# z by atan2(s, c), s = R10 - R01, c = R00 + R11 (README.md, "Frames"); `sequences.rotations.yaw_of`
# is the same for many at once.
_UPSIDE_DOWN = 0.01
"""s^2 + c^2 = (1 + cos tilt)^2 below which yaw means nothing: within 26 degrees of upside down."""


def twist(R: FloatArray) -> tuple[float, float]:
    """S and c: sine and cosine of the yaw of R (3, 3), times 1 + cos tilt."""
    return float(R[1, 0] - R[0, 1]), float(R[0, 0] + R[1, 1])


def yaw_twist(R_WB: FloatArray) -> float:
    """Yaw [rad] of an attitude (3, 3); not-a-number close to upside down."""
    s, c = twist(R_WB)
    return math.atan2(s, c) if s * s + c * c > _UPSIDE_DOWN else math.nan


def yaw_rotation(R: FloatArray) -> FloatArray:
    """The turn about the vertical (3, 3) that has the yaw of R; none where R has none."""
    s, c = twist(R)
    norm = math.hypot(s, c)
    s, c = (s / norm, c / norm) if norm > 0.0 else (0.0, 1.0)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _coefficients(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(1 - cos t)/t^2 and (t - sin t)/t^3 (..., 1, 1), accurate down to zero."""
    squared = (theta * theta) @ _ONES
    b = 0.5 - squared * (1.0 / 24.0 - squared / 720.0)
    c = 1.0 / 6.0 - squared * (1.0 / 120.0 - squared / 5040.0)
    if np.vdot(theta, theta) > _SERIES_LIMIT:
        large = squared > _SERIES_LIMIT
        t = np.sqrt(np.where(large, squared, 1.0))
        b = np.where(large, 2.0 * (np.sin(0.5 * t) / t) ** 2, b)
        c = np.where(large, (t - np.sin(t)) / t**3, c)
    return b[..., None, None], c[..., None, None]
