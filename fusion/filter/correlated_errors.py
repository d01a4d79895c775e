"""The network's errors that are not white, which only the reported covariance contains.

The gains take the error of each displacement for white. In truth part of it decays within seconds,
and part lasts all along a track: README.md, "Correlated errors".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.ekf_state import CONSIDERED_SECONDS, EkfState
from stario.fusion.filter.kalman import gauss_markov
from stario.fusion.imu.inference import slope_variance
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.state import changed
from stario.sequences.sequence import FloatArray

WHITE, DRIFTING, LASTING = 0.35, 0.25, 0.15
"""Variances of the errors as fractions of the covariance that the network predicts: of those that
are independent, of those that decay within seconds, and of those along and across the displacement
that last. In unknown people's recordings the normalised errors have a variance of 0.5 to 1 and
autocorrelations of 0.2 to 0.4 after a second, 0.05 to 0.25 from five seconds to a minute."""

ACCEL_SHARE = 0.025
"""Actual variance of the accelerometer's noise as a fraction of that assumed for the gains, which
is so large because the network's errors are correlated."""

_SHORT = 0.5
"""Displacement [m] below which errors along and across it are in proportion to it: a slow one has
hardly a direction."""


class DisplacementErrors(NamedTuple):
    """Errors of one displacement.

    Attributes:
        white: (3, 3) covariance of those that are independent of other displacements' [m^2].
        considered: (3, 6) sensitivity to the considered ones, of unit variance [m].
    """

    white: FloatArray
    considered: FloatArray


def displacement_errors(
    d_W: FloatArray, covariance: FloatArray, level: float, f: FilterConfig
) -> DisplacementErrors:
    """Return the errors of a displacement.

    Args:
        d_W: (3,) displacement [m].
        covariance: (3, 3) its covariance as inferred, in the same axes [m^2].
        level: factor on the variance of the errors that change within seconds.
        f: settings of the filter.
    """
    predicted = 2.0 * f.covariance_scale * covariance
    climb = 2.0 * f.covariance_scale * slope_variance(d_W)
    predicted[2, 2] = max(predicted[2, 2] - climb, 1e-9)
    H = np.zeros((3, len(CONSIDERED_SECONDS)))
    # The symmetric root of the horizontal part: the errors do not depend on the axes. Roots of
    # negative numbers belong to an invalid covariance, which the update refuses.
    (a, b, _), (_, c, _), (_, _, height) = (level * DRIFTING * predicted).tolist()
    det = math.sqrt(max(a * c - b * b, 0.0))
    root = math.sqrt(max(a + c + 2.0 * det, 0.0))
    if root > 0.0:
        H[0, 0], H[1, 1], H[0, 1] = (a + det) / root, (c + det) / root, b / root
        H[1, 0], H[2, 2] = H[0, 1], math.sqrt(height)
    x, y, _ = d_W.tolist()
    length = math.hypot(x, y)
    if length > 0.0:
        (a, b, _), (_, c, _), _ = predicted.tolist()
        share = math.sqrt(LASTING) / (length * max(length, _SHORT))
        along = share * math.sqrt(max(a * x * x + 2.0 * b * x * y + c * y * y, 0.0))
        H[0, 3], H[1, 3] = along * x, along * y
        across = share * math.sqrt(max(a * y * y - 2.0 * b * x * y + c * x * x, 0.0))
        H[0, 4], H[1, 4] = -across * y, across * x
    H[2, -1] = math.sqrt(climb)
    overlap = f.overlap_scale / (2.0 * f.covariance_scale)  # a window's errors repeat in the next
    return DisplacementErrors(level * WHITE * overlap * predicted, H)


def with_considered_propagated(s: EkfState) -> EkfState:
    """Return the state with its considered errors propagated from their own time to the state's.

    Each takes a Gauss-Markov step of unit variance. Only displacements ask for them.
    """
    kept = np.exp((s.considered_time - s.time) / CONSIDERED_SECONDS)
    actual = gauss_markov(s.P_reported, s.considered_rows, kept, 1.0)
    return changed(s, covariances=np.array((s.P, actual)), considered_time=s.time)
