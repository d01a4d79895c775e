"""The last second of a stream, which a late fix repeats with the fix in its place.

States are immutable, so that keeping one costs a reference. README.md, "Fixes".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stario.fusion.filter.estimator_state import Displacement, EstimatorState, Step
from stario.fusion.fixes import Fix
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.state import changed
from stario.sequences.windows import WINDOW_SECONDS

_TIME_TOLERANCE = 1e-6
"""Tolerance when comparing times [s]."""

History = tuple[Step, ...]
"""Steps of the last second, in order."""


def with_step(
    state: EstimatorState,
    interval: ImuInterval,
    displacement: Displacement | None,
    fixes: Sequence[Fix],
) -> History:
    """Return the history with the step that is about to begin, without those too old for a fix.

    Args:
        state: the state before the step, with the history so far.
        interval: interval of the step.
        displacement: displacement given with it; None if there is none.
        fixes: fixes given with it.
    """
    step = Step(changed(state, history=()), interval.without_window(), displacement, tuple(fixes))
    oldest = interval.stop - WINDOW_SECONDS - _TIME_TOLERANCE
    return (*(s for s in state.history if s.interval.stop >= oldest), step)


def rewound(
    state: EstimatorState, start: float, time: float
) -> tuple[EstimatorState, History] | None:
    """Return the state before the step that contains a time, and the steps to be repeated.

    Args:
        state: the newest state, with its history.
        start: start of the stream [s].
        time: time of a late fix [s].

    Returns:
        None if the time is more than a window ago, or before the stream began.
    """
    steps = state.history
    oldest = max(start, state.ekf.time - WINDOW_SECONDS - _TIME_TOLERANCE)
    if time < oldest or not steps or time < steps[0].interval.start:
        return None
    k = int(np.searchsorted([step.interval.stop for step in steps[:-1]], time))
    return changed(steps[k].before, history=steps[:k]), steps[k:]
