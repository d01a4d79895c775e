"""What a magnetic bearing says about attitude and bias, for a graph without states of the field.

The azimuth of the field, its wander and the hard iron are states of the filter alone. A bearing
lowers the filter's covariance P of z = (theta, b_g) by k k^T, so for z alone it acts like a
measurement of u^T z with variance 1 - k^T u, u = P^-1 k. With these measurements a graph that
treats everything else as the filter does arrives at the filter's covariance, although the errors of
successive bearings are correlated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gtsam.symbol_shorthand import B, X

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import GYRO_BIAS
from stario.fusion.graph.factors import AtKeyframe, Linearised
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.sequences.attitude.so3 import log_so3
from stario.sequences.sequence import FloatArray

_Z = np.array([0, 1, 2, *range(GYRO_BIAS.start, GYRO_BIAS.stop)])
"""Indices of attitude and gyroscope bias in the error state."""

_MIN_GAIN = 1e-6
"""Smallest fraction of the variance along u that a bearing must remove."""


class Gained(NamedTuple):
    """A measurement u^T z = value, z being the error of the filter's estimate after the update.

    Attributes:
        weights: (6,) u.
        value: u^T z.
        variance: its variance.
    """

    weights: FloatArray
    value: float
    variance: float


def gained_information(before: EkfState, after: EkfState) -> Gained | None:
    """Return what an update has added about attitude and gyroscope bias.

    Returns:
        The measurement; None if nothing was gained.
    """
    sigma = np.sqrt(before.P.diagonal()[_Z])
    scale = np.outer(sigma, sigma)
    P, P_after = before.P[np.ix_(_Z, _Z)] / scale, after.P[np.ix_(_Z, _Z)] / scale
    eigenvalues, axes = np.linalg.eigh(P - P_after)
    if not eigenvalues[-1] > 0.0:
        return None
    k = math.sqrt(eigenvalues[-1]) * axes[:, -1]
    u = np.linalg.solve(P, k)
    variance = 1.0 - float(k @ u)
    if not _MIN_GAIN < 1.0 - variance < 1.0:
        return None
    turned = log_so3(after.R_WB @ before.R_WB.T)
    change = np.concatenate([turned, after.b_g - before.b_g]) / sigma
    return Gained(u / sigma, variance * float(k @ change) / float(k @ k), variance)


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
