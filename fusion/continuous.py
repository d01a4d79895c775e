"""Continuous position next to the corrected one, for control and display (REP 105, map to odom).

README.md, "Continuous output".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.state import NavState, changed
from stario.sequences.sequence import FloatArray

MAX_STEP = 0.01
"""Largest part of the correction bled in from one state to the next [m]."""

BLEED_SECONDS = 1.0
"""Time constant for bleeding in a small correction [s]."""


@dataclass(frozen=True, eq=False)
class ContinuousPose:
    """A pose whose position does not step at updates.

    Attributes:
        time: [s].
        p_W: (3,) position [m].
        R_WB: (3, 3) attitude, that of the corrected state.
        v_W: (3,) velocity of the corrected state [m/s].
        correction_W: (3,) corrected minus continuous position, not yet bled in [m].
        map_frame: as in `NavState`; the position is reset when fixes move the frame.
    """

    time: float
    p_W: FloatArray
    R_WB: FloatArray
    v_W: FloatArray
    correction_W: FloatArray
    map_frame: int = 0


def advanced(before: ContinuousPose | None, state: NavState) -> ContinuousPose:
    """Advance the pose to a state: by the mean velocity and a bounded part of the correction.

    It starts at the corrected position, and is reset to it when the frame moves and after a gap,
    in which the motion is unknown.

    Args:
        before: pose at the previous state, None at first.
        state: the newest state.
    """
    p_W = state.p_W
    if before is not None and before.map_frame == state.map_frame and not state.in_gap:
        dt = state.time - before.time
        integrated = before.p_W + 0.5 * dt * (before.v_W + state.v_W)
        error = state.p_W - integrated
        part = -math.expm1(-dt / BLEED_SECONDS) * error
        p_W = integrated + part * min(1.0, MAX_STEP / max(float(np.linalg.norm(part)), 1e-12))
    correction_W = state.p_W - p_W
    return ContinuousPose(state.time, p_W, state.R_WB, state.v_W, correction_W, state.map_frame)


def copied(pose: ContinuousPose) -> ContinuousPose:
    """Return a copy whose arrays the caller may write to."""
    arrays = {k: v.copy() for k, v in vars(pose).items() if isinstance(v, np.ndarray)}
    return changed(pose, **arrays)
