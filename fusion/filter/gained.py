"""What a magnetic bearing says about attitude and bias, for those without states of the field.

The field's azimuth, its disturbance and the hard iron are states of the filter alone. A bearing
lowers the filter's covariance P of z = (theta, b_g) by k k^T, so for z alone it acts like a
measurement of u^T z with variance 1 - k^T u, u = P^-1 k. With these measurements a graph that
treats everything else as the filter does arrives at the filter's covariance, although the errors of
successive bearings are correlated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import GYRO_BIAS
from stario.sequences.attitude.so3 import log_so3
from stario.sequences.sequence import FloatArray

_Z = np.array([0, 1, 2, *range(GYRO_BIAS.start, GYRO_BIAS.stop)])
"""Indices of attitude and gyroscope bias in the error state."""

_MIN_GAIN = 1e-6
"""Smallest fraction of the variance along u that a bearing must remove."""


class Gained(NamedTuple):
    """A measurement u^T z = value, z being the error of the filter's estimate after the update."""

    weights: FloatArray
    """(6,) u."""
    value: float
    """u^T z."""
    variance: float
    """Its variance."""
    R_WB: FloatArray
    """(3, 3) estimated attitude."""
    b_g: FloatArray
    """(3,) estimated bias [rad/s]."""


def gained_information(before: EkfState, after: EkfState) -> Gained | None:
    """Return what an update has added about attitude and gyroscope bias; None for nothing."""
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
    value = variance * float(k @ change) / float(k @ k)
    return Gained(u / sigma, value, variance, after.R_WB, after.b_g)
