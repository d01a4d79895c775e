"""Timing of several things in turn, so that all of them meet the same load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter

import numpy as np

from stario.sequences.sequence import FloatArray

_WARM_UP = 3


def seconds_in_turn(calls: Sequence[Callable[[], object]], runs: int) -> FloatArray:
    """Seconds of each call (runs, calls), made one after the other in every run.

    Args:
        calls: what is timed.
        runs: of all of them, after a few that are not counted.
    """
    seconds = np.zeros((_WARM_UP + runs, len(calls)))
    for row in seconds:
        for column, call in enumerate(calls):
            began = perf_counter()
            call()
            row[column] = perf_counter() - began
    return seconds[_WARM_UP:]
