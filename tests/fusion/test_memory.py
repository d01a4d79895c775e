"""Memory use of a stream."""

import gc
import tracemalloc
from collections.abc import Callable
from typing import Any

import pytest

from stario.fusion import Navigator
from stario.sequences.sequence import ImuSequence

Make = Callable[..., Any]


def endless(sequence: ImuSequence, start: float, seconds: float):
    """Yield the recording's samples over and over."""
    step = 1.0 / sequence.rate
    rows = list(zip(sequence.gyro.tolist(), sequence.accel.tolist(), strict=True))
    for k in range(round(seconds / step)):
        yield start + k * step, *rows[k % len(rows)]


def memory_growth(walk: ImuSequence, model: Any, warm_up: float, seconds: float) -> int:
    navigator = Navigator(model)
    tracemalloc.start()
    try:
        for row in endless(walk, 0.0, warm_up):
            navigator.push(*row)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for row in endless(walk, warm_up, seconds):
            navigator.push(*row)
        gc.collect()
        return tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()


def test_the_memory_of_a_stream_does_not_grow(make_walk: Make, still_model: Any) -> None:
    # The interpreter's own caches fill for a minute or so. 16 bytes per sample are less than
    # storing one number per sample would take.
    assert memory_growth(make_walk(1, 30.0, 50.0), still_model, 60.0, 60.0) < 16 * 50 * 60


@pytest.mark.slow
def test_the_memory_of_an_hours_stream_does_not_grow(make_walk: Make, still_model: Any) -> None:
    assert memory_growth(make_walk(1, 30.0, 50.0), still_model, 120.0, 3600.0) < 60_000
