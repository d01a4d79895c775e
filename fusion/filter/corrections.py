"""Corrections: updates, other than by fixes, that move or turn the track visibly at once.

A filter's track is causal: an update that corrects what was believed for a while moves its end by
as much at once. A small one is the filter at work; a large one says that the track before it was
wrong, or that this update is.
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.values.lie import twist

MIN_METRES, MIN_TURN = 1.0, math.radians(10.0)
"""Distance [m] or turn about the vertical [rad] from which a correction is recorded."""

CORRECTIONS_LISTED = 100
"""Number of corrections that are kept, the latest ones."""

Correction = tuple[float, float, float, str]
"""Time [s], distance [m], turn about the vertical [rad], and what caused it."""


def correction(before: EkfState, after: EkfState, cause: str) -> Correction | None:
    """Return what an update from one state to the next has corrected; None if it is small."""
    if after is before:
        return None
    metres = float(np.linalg.norm(after.p_W - before.p_W))
    turn = abs(math.atan2(*twist(after.R_WB @ before.R_WB.T)))
    if metres < MIN_METRES and turn < MIN_TURN:
        return None
    return after.time, metres, turn, cause
