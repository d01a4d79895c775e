"""Timing of several functions in turn, so that all run under the same load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter

import numpy as np

from stario.sequences.sequence import FloatArray

_WARM_UP = 3


def seconds_in_turn(calls: Sequence[Callable[[], object]], runs: int) -> FloatArray:
    """Return the time (runs, calls) [s] of each call; every run makes all calls in turn.

    Args:
        calls: functions to time.
        runs: number of timed runs, after a few warm-up runs.
    """
    seconds = np.zeros((_WARM_UP + runs, len(calls)))
    for row in seconds:
        for column, call in enumerate(calls):
            began = perf_counter()
            call()
            row[column] = perf_counter() - began
    return seconds[_WARM_UP:]
