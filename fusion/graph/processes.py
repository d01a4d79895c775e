"""The term between two keyframes that no measurement gives: a gap."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import B, V, X

from stario.fusion.filter.jacobians import yaw_jacobian
from stario.fusion.graph.factors import Between, Linearised
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.values.lie import about_vertical, twist
from stario.sequences.attitude.so3 import skew
from stario.sequences.sequence import FloatArray

_EYE = np.eye(3)


@dataclass(frozen=True, eq=False)
class Coasting(Between):
    """Constant velocity and biases across a gap without samples, apart from a turn.

    The pedestrian turns about the vertical by psi, the yaw of R_j (R_i R_ij)^T, and the velocity
    with him. The tilt may change by any angle; `Tilt` determines the new one. In the axes of body
    i, so that neither psi nor a turn of the world is observed by being linearised where the
    residual is not zero:

        psi      R_i^T (R_z(psi)^T v_j - v_i)      R_i^T (R_z(psi)^T (p_j - p_i) - t v_i)

    Attributes:
        seconds: length t of the gap [s].
        R_ij: (3, 3) rotation of the device as expected (`gap_rotation`).
        covariance: (13, 13) of these and of the changes of gyroscope and accelerometer bias.
    """

    seconds: float
    R_ij: FloatArray
    covariance: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in the axes of body i; biases in B."""
        a, b = KeyframeState.of(values, self.i), KeyframeState.of(values, self.j)
        R, t, to_i = b.R_WB @ (a.R_WB @ self.R_ij).T, self.seconds, a.R_WB.T
        psi = math.atan2(*twist(R))
        back = about_vertical(-psi)
        ends = back @ np.column_stack([b.v_W, b.p_W - a.p_W])
        changes = to_i @ (ends - np.column_stack([a.v_W, t * a.v_W]))
        biases = b.b_g - a.b_g, b.b_a - a.b_a

        # A rotation of R_j by w turns R by R_j w; one of R_i by -R_j R_ij^T w.
        turned = to_i @ np.stack([ends[1], -ends[0], np.zeros(2)])  # -e3 x
        by_psi = np.concatenate([[1.0], turned[:, 0], turned[:, 1]])
        rotated = np.outer(by_psi, yaw_jacobian(R)[0][1] @ b.R_WB)
        pose_i, pose_j = np.zeros((13, 6)), np.zeros((13, 6))
        pose_i[:7, :3], pose_j[:7, :3] = -rotated @ self.R_ij.T, rotated
        pose_i[1:7, :3] += skew(changes.T).reshape(6, 3)
        pose_i[4:7, 3:], pose_j[4:7, 3:] = -to_i @ back @ a.R_WB, to_i @ back @ b.R_WB
        velocity, bias = np.eye(13, 3, k=-1), np.zeros((13, 6))
        bias[7:10, 3:], bias[10:, :3] = _EYE, _EYE
        by_v_i = -(velocity + t * np.eye(13, 3, k=-4)) @ to_i
        by_v_j = velocity @ to_i @ back
        before = [(X(self.i), pose_i), (V(self.i), by_v_i), (B(self.i), -bias)]
        after = [(X(self.j), pose_j), (V(self.j), by_v_j), (B(self.j), bias)]
        return -np.concatenate([[psi], changes.T.ravel(), *biases]), before + after
