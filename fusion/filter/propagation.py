"""Propagation of the right-invariant error across a preintegrated segment.

README.md, "Propagation": the transition of theta, rho_v, rho_p does not depend on the state, so the
filter cannot learn yaw or position by linearising at different estimates.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from stario.fusion.error_state import CORE
from stario.fusion.imu.preintegration import Segment
from stario.fusion.lie import FloatArray, skew


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
    """(15, 15)."""


def propagated(
    segment: Segment,
    R_WB: FloatArray,
    v_W: FloatArray,
    p_W: FloatArray,
    b_g: FloatArray,
    b_a: FloatArray,
) -> Propagation:
    """`Segment.predict` with the transition and the noise of the right-invariant error.

    gtsam's tangent is local, R exp(w), p + R dp, v + R dv, in the order rotation, position,
    velocity, accelerometer bias, gyroscope bias; the adjoint of the end state turns it into the
    right-invariant error.
    """
    start = gtsam.NavState(gtsam.Rot3(R_WB), p_W, v_W)
    bias_jacobian = np.empty((9, 6), order="F")
    bias = gtsam.imuBias.ConstantBias(b_a, b_g)
    end = segment.pim.predict(start, bias, None, bias_jacobian)
    R, v, p = end.attitude().matrix(), end.velocity(), end.position()

    adjoint = _BIAS_SWAP.copy()
    adjoint[0:3, 0:3] = R
    adjoint[3:6, 6:9] = R
    adjoint[6:9, 3:6] = R
    adjoint[3:9, 0:3] = (skew(np.array((v, p))) @ R).reshape(6, 3)
    noise = adjoint @ segment.pim.residualCovariance() @ adjoint.T

    transition = _nav_transition(segment.duration, segment.gravity)
    by_bias = adjoint[:9, :9] @ bias_jacobian
    transition[:9, 9:12] = by_bias[:, 3:]
    transition[:9, 12:15] = by_bias[:, :3]
    return Propagation(R, v, p, transition, noise)


_IDENTITY = np.eye(CORE)
_BIAS_SWAP = np.zeros((CORE, CORE))
_BIAS_SWAP[9:12, 12:15] = np.eye(3)
_BIAS_SWAP[12:15, 9:12] = np.eye(3)


def _nav_transition(dt: float, gravity: float) -> FloatArray:
    """Transition without its bias columns; gravity is (0, 0, -gravity) in W."""
    transition = _IDENTITY.copy()
    fall, drop = gravity * dt, 0.5 * gravity * dt * dt
    transition[3, 1], transition[4, 0] = fall, -fall
    transition[6, 1], transition[7, 0] = drop, -drop
    transition[6, 3] = transition[7, 4] = transition[8, 5] = dt
    return transition
