"""The filter's right-invariant error: definition, propagation, measurement Jacobians.

    theta [rad], rho_v [m/s], rho_p [m], d_bg [rad/s], d_ba [m/s^2] | theta, rho_p of each clone
    R = (I + [theta]x) R^,  v = v^ + rho_v - [v^]x theta,  p = p^ + rho_p - [p^]x theta

where ^ marks the estimate. A Jacobian is a list of blocks; columns in no block are zero.
Derivations: README.md, "Error state" to "Fixes".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stario.fusion.imu.gap import gap_covariance
from stario.fusion.imu.preintegration import Segment
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.lie import twist
from stario.sequences.attitude.so3 import skew
from stario.sequences.sequence import FloatArray

CORE = 15
"""Size of the error state of one navigation state."""

VELOCITY, POSITION, GYRO_BIAS = slice(3, 6), slice(6, 9), slice(9, 12)
"""Rows of position and gyroscope bias in the error state and in the covariance of a `NavState`."""

CLONE = 6
"""Size of the error state of one cloned pose."""

CLONED = np.array([0, 1, 2, 6, 7, 8])
"""Rows of theta and rho_p, which a clone copies."""

GAIN, REPORTED = 0, 1
"""Indices of the covariances: as assumed for the gains, and of the error that these gains leave."""

Block = tuple[int, FloatArray]
"""First column of a Jacobian block in the error state, and the block (m, width)."""

_EYE = np.eye(3)
_LAST_EYE = np.eye(3, CLONE, k=3)
_LAST_MINUS_EYE = -_LAST_EYE
_LAST_EYE_CORE = np.eye(3, 9, k=6)


def displacement_jacobian(p_i_W: FloatArray, p_j_W: FloatArray, slot: int) -> list[Block]:
    """Return the Jacobian of the residual of `ekf.update_displacement`.

    theta_i: [p_i]x - (e3 x (p_j - p_i)) e3^T, rho_pi: -I, theta_j: -[p_j]x, rho_pj: I. The third
    column of the first block equals that of [p_j]x; written so, H times yaw is exactly zero.
    """
    P_i, P_j = skew(np.array((p_i_W, p_j_W)))
    H_i = _LAST_MINUS_EYE.copy()
    H_i[:, :2], H_i[:, 2] = P_i[:, :2], P_j[:, 2]
    H_j = _LAST_EYE_CORE.copy()
    H_j[:, :3] -= P_j
    return [(CORE + CLONE * slot, H_i), (0, H_j)]


def position_jacobian(p_W: FloatArray) -> list[Block]:
    """Return the Jacobian of a position: theta -[p]x, rho_p I."""
    H = _LAST_EYE_CORE.copy()
    H[:, :3] = -skew(p_W)
    return [(0, H)]


def velocity_jacobian(v_W: FloatArray) -> list[Block]:
    """Return the Jacobian of a velocity in the true W: theta -[v]x, rho_v I."""
    H = _LAST_EYE.copy()
    H[:, :3] = -skew(v_W)
    return [(0, H)]


def yaw_jacobian(R_WB: FloatArray) -> list[Block]:
    """Return the Jacobian (1, 3) of `yaw_twist` with respect to theta.

    With s = R10 - R01, c = R00 + R11 and R = (I + [theta]x) R^:
    d yaw = theta_z + (theta_x (s R21 - c R20) - theta_y (c R21 + s R20)) / (s^2 + c^2).
    """
    s, c = twist(R_WB)
    r20, r21 = float(R_WB[2, 0]), float(R_WB[2, 1])
    n = s * s + c * c
    return [(0, np.array([[(s * r21 - c * r20) / n, -(c * r21 + s * r20) / n, 1.0]]))]


def bearing_jacobian(R_WB: FloatArray, m_W: FloatArray, field_row: int) -> list[Block]:
    """Return the Jacobian of the bearing's residual, measured minus azimuth.

    The true bearing is that of (I + [theta]x) (m - R d_h): it moves by theta_z
    - m_z (m_x theta_x + m_y theta_y) / n - (m_x R1 - m_y R0) d_h / n with n = m_x^2 + m_y^2, and
    equals the true azimuth. A common turn of yaw and azimuth leaves the residual unchanged.

    Args:
        R_WB: (3, 3) attitude.
        m_W: (3,) field in the estimated world, hard iron removed [uT].
        field_row: row of the azimuth's error.
    """
    x, y, z = m_W
    n = x * x + y * y
    by_theta = np.array([[z * x / n, z * y / n, -1.0]])
    by_hard_iron = (x * R_WB[1] - y * R_WB[0]) / n
    return [(0, by_theta), (field_row, np.concatenate([[1.0, 1.0], by_hard_iron])[None])]


def plain_covariance(P: FloatArray, vectors_W: FloatArray) -> FloatArray:
    """Convert a covariance of invariant errors to plain ones: v - v^ = rho_v - [v^]x theta.

    Args:
        P: (..., n, n) covariance of theta, a rho for each vector, and any errors left unchanged.
        vectors_W: (..., k, 3) velocity and position, or one of them; negated, they convert back.
    """
    A = skew(vectors_W).reshape(*vectors_W.shape[:-2], -1, 3)
    stop = 3 + A.shape[-2]
    plain = P.copy()
    plain[..., 3:stop, :] -= A @ P[..., :3, :]
    plain[..., 3:stop] -= plain[..., :3] @ A.swapaxes(-1, -2)
    # Far from the origin, rounding in the products would make it asymmetric.
    return symmetric(plain)


def symmetric(P: FloatArray) -> FloatArray:
    """Return covariances (..., n, n) without the asymmetry of rounding."""
    return np.asarray(0.5 * (P + P.swapaxes(-1, -2)))


def invariant_from_local(R_WB: FloatArray, v_W: FloatArray, p_W: FloatArray) -> FloatArray:
    """Return the map (15, 15) from gtsam's local error of a state to the right-invariant one.

    gtsam's tangent is R exp(w), p + R dp, v + R dv, in the order rotation, position, velocity,
    accelerometer bias, gyroscope bias.
    """
    adjoint = _BIAS_SWAP.copy()
    adjoint[0:3, 0:3] = R_WB
    adjoint[3:6, 6:9] = R_WB
    adjoint[6:9, 3:6] = R_WB
    adjoint[3:9, 0:3] = (skew(np.array((v_W, p_W))) @ R_WB).reshape(6, 3)
    return adjoint


class Propagation(NamedTuple):
    """State at a segment's end and its linearisation, order theta, rho_v, rho_p, d_bg, d_ba."""

    R_WB: FloatArray
    """(3, 3)."""
    v_W: FloatArray
    """(3,) [m/s]."""
    p_W: FloatArray
    """(3,) [m]."""
    transition: FloatArray
    """(15, 15)."""
    noise: FloatArray
    """(2, 15, 15) as assumed for the gains, and as it is."""


def propagated(
    segment: Segment,
    R_WB: FloatArray,
    v_W: FloatArray,
    p_W: FloatArray,
    b_g: FloatArray,
    b_a: FloatArray,
    accel_share: float = 1.0,
) -> Propagation:
    """Return `Segment.predict` with the transition and noise of the right-invariant error."""
    bias_jacobian = np.empty((9, 6), order="F")
    R, v, p = segment.predict(R_WB, v_W, p_W, b_g, b_a, bias_jacobian)
    adjoint = invariant_from_local(R, v, p)
    local = np.ascontiguousarray(segment.pim.residualCovariance())  # faster products
    noise = np.empty((2, CORE, CORE))
    noise[GAIN] = adjoint @ local @ adjoint.T
    actual = adjoint.copy()
    actual[:, 3:9] *= math.sqrt(accel_share)
    noise[REPORTED] = actual @ local @ actual.T

    transition = _nav_transition(segment.duration, segment.gravity)
    by_bias = adjoint[:9, :9] @ bias_jacobian
    transition[:9, 9:12] = by_bias[:, 3:]
    transition[:9, 12:15] = by_bias[:, :3]
    return Propagation(R, v, p, transition, noise)


def propagated_in_gap(
    seconds: float,
    turn_variance: float,
    R_WB: FloatArray,
    v_W: FloatArray,
    p_W: FloatArray,
    config: NavigatorConfig,
) -> Propagation:
    """Return the state after a gap: the velocity is kept, with a pedestrian's noise.

    No force is measured that a wrong tilt could rotate, so the motion does not depend on gravity:
    theta' = theta, rho_v' = rho_v, rho_p' = rho_p + t rho_v.

    Args:
        seconds: length t of the gap [s].
        turn_variance: as for `gap_covariance` [rad^2].
        R_WB: (3, 3) attitude after it.
        v_W: (3,) velocity [m/s].
        p_W: (3,) position before it [m].
        config: noise densities.
    """
    p = p_W + seconds * v_W
    covariance = gap_covariance(seconds, turn_variance, v_W, config)
    noise = plain_covariance(covariance, -np.array((v_W, p)))
    return Propagation(R_WB, v_W, p, _nav_transition(seconds, 0.0), np.array((noise, noise)))


_IDENTITY = np.eye(CORE)
_BIAS_SWAP = np.zeros((CORE, CORE))
_BIAS_SWAP[9:12, 12:15] = np.eye(3)
_BIAS_SWAP[12:15, 9:12] = np.eye(3)


def _nav_transition(dt: float, gravity: float) -> FloatArray:
    """Return the transition without its bias columns, for gravity (0, 0, -gravity) in W."""
    transition = _IDENTITY.copy()
    g_dt, half_g_dt2 = gravity * dt, 0.5 * gravity * dt * dt
    transition[3, 1], transition[4, 0] = g_dt, -g_dt
    transition[6, 1], transition[7, 0] = half_g_dt2, -half_g_dt2
    transition[6, 3] = transition[7, 4] = transition[8, 5] = dt
    return transition
