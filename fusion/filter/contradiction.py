"""Displacements that contradict the filter share a steady error, until one fits as it is.

README.md, "Gates". From the first outlier on the error is a state: less it, displacements still
measure how the velocity changes. Without that, tilt and bias of the accelerometer would soon
explain any displacement, and the filter would follow false ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.kalman import corrected
from stario.sequences.sequence import FloatArray

MAX_SECONDS = 6.0
"""An error that lasts longer [s] is not taken for one: the filter was wrong."""

OFFSET_WALK = 0.15
"""Change of the error from one displacement to the next [m]: it may turn with the device."""

_NO_OFFSET_SIGMA = 1e-3
"""Sigma of an error that is none after all [m]."""


@dataclass(frozen=True, eq=False)
class Contradiction:
    """Times of the displacements that do not fit as they are [s]; the first opened it."""

    times: tuple[float, ...]


def is_nearer_offset(s: EkfState, residual: FloatArray) -> bool:
    """Return whether a displacement's residual (3,) [m] is nearer to the offset than to zero.

    After some seconds the velocity is so uncertain that a false displacement would fit as well.
    """
    return bool(residual @ s.offset_W > 0.5 * s.offset_W @ s.offset_W)


def believed(s: EkfState) -> EkfState:
    """Return the state if the displacements had no steady error: the filter was wrong."""
    H = np.zeros((3, s.covariances.shape[1]))
    H[:, s.offset_rows] = np.eye(3)
    R = _NO_OFFSET_SIGMA**2 * np.eye(3)
    return corrected(s, -s.offset_W, H, np.array((R, R))).without_offset()
