"""Extended poses as matrix groups: SE(3) and SE_2(3) in closed form, and the yaw of a rotation.

Functions take stacks, leading axes first, because the filter corrects all of its clones at once.
Conventions: X = exp(xi) with xi = (theta, rho_v, rho_p), rotation [rad] first; the left
Jacobian J carries the translation parts, exp(theta, rho) = (exp(theta), J(theta) rho).

Source: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
2018, appendices B and D; A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable
observer", 2017, for SE_2(3).
"""

from __future__ import annotations

import math

import numpy as np

from stario.sequences.attitude.so3 import exp_and_left_jacobian, log_so3, series_coefficients, skew
from stario.sequences.sequence import FloatArray

UNKNOWN_YAW = math.pi / math.sqrt(3.0)
"""Standard deviation of an unknown yaw, uniform over the circle [rad]."""

_EYE = np.eye(3)


def exp_times(theta: FloatArray, rho: FloatArray, X: FloatArray) -> FloatArray:
    """Return exp(theta, rho) X for a stack of poses, without forming the exponential.

    By Rodrigues' formula in homogeneous form, exp(A) X = X + A X + b A^2 X + c A^3 X, where A maps
    [R | p] to [K R | K p + rho] once and multiplies by K = [theta]x from then on.

    Args:
        theta: (n, 3) rotation vectors [rad].
        rho: (n, 3, m) translation parts, one column per vector of the pose.
        X: (n, 3, 3 + m) poses [R | vectors].
    """
    K = skew(theta)
    b, c = series_coefficients(theta)
    first = K @ X
    first[:, :, 3:] += rho
    second = K @ first
    return X + first + (b * _EYE + c * K) @ second


def log_se23(R: FloatArray, v: FloatArray, p: FloatArray) -> FloatArray:
    """Return the logarithm (..., 9) of elements of SE_2(3), for angles below pi."""
    theta = log_so3(R)
    _, J = exp_and_left_jacobian(theta)
    rho = np.linalg.solve(J, np.stack([v, p], axis=-1))
    return np.concatenate([theta, rho[..., 0], rho[..., 1]], axis=-1)


# The yaw of a rotation is that of its twist about the vertical: R is split into a tilt and a
# rotation about z by atan2(s, c), s = R10 - R01, c = R00 + R11 (README.md, "Frames").
# `sequences.attitude.rotations.yaw_of` is the same for stacks.
_UPSIDE_DOWN = 0.01
"""Yaw is undefined where s^2 + c^2 = (1 + cos tilt)^2 is smaller: 26 degrees from upside down."""


def twist(R: FloatArray) -> tuple[float, float]:
    """Return s and c: sine and cosine of the yaw of R (3, 3), times 1 + cos tilt."""
    return float(R[1, 0] - R[0, 1]), float(R[0, 0] + R[1, 1])


def yaw_twist(R_WB: FloatArray) -> float:
    """Return the yaw [rad] of an attitude (3, 3); NaN close to upside down."""
    s, c = twist(R_WB)
    return math.atan2(s, c) if s * s + c * c > _UPSIDE_DOWN else math.nan


def yaw_rotation(R: FloatArray) -> FloatArray:
    """Return the rotation about the vertical (3, 3) with the yaw of R; identity if undefined."""
    s, c = twist(R)
    return about_vertical(math.atan2(s, c))


def e3_cross(vector: FloatArray) -> FloatArray:
    """Return e3 x vector (3,): how it changes per angle about the vertical."""
    return np.array([-vector[1], vector[0], 0.0])


def about_vertical(angle: float) -> FloatArray:
    """Return the rotation (3, 3) about the vertical by an angle [rad]."""
    s, c = math.sin(angle), math.cos(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
