"""A magnetic bearing, for a graph without states of the field (`filter.gained`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import B, X

from stario.fusion.graph.factors import AtKeyframe, Linearised
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.sequences.attitude.so3 import log_so3
from stario.sequences.sequence import FloatArray


@dataclass(frozen=True, eq=False)
class Bearing(AtKeyframe):
    """A combination of the errors of attitude and gyroscope bias, weights^T (theta, b_g) = value.

    Attributes:
        R_WB: (3, 3) attitude from which theta counts.
        b_g: (3,) bias from which its error counts [rad/s].
        weights: (6,) of theta [rad] and bias [rad/s].
        value: measured combination.
        covariance: (1, 1).
    """

    R_WB: FloatArray
    b_g: FloatArray
    weights: FloatArray
    value: float
    covariance: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise for small theta."""
        state = KeyframeState.of(values, self.k)
        turned = log_so3(state.R_WB @ self.R_WB.T)
        error = np.concatenate([turned, state.b_g - self.b_g])
        H_x, H_b = np.zeros((1, 6)), np.zeros((1, 6))
        H_x[0, :3] = self.weights[:3] @ state.R_WB
        H_b[0, 3:] = self.weights[3:]
        residual = np.array([self.value - float(self.weights @ error)])
        return residual, [(X(self.k), H_x), (B(self.k), H_b)]
