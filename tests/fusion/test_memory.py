"""Memory use of a stream."""

import gc
import tracemalloc
from itertools import pairwise

import pytest

from stario.fusion import Navigator
from stario.sequences.sequence import ImuSequence

BYTES_PER_NUMBER = 16
RATE = 50.0


def memory_growth(navigator: Navigator, walk: ImuSequence, warm_up: float, seconds: float) -> int:
    """Growth [bytes], from the half with less of it: caches fill once, leaks grow in both.

    The recording's samples are pushed over and over.
    """
    rows = list(zip(walk.gyro.tolist(), walk.accel.tolist(), strict=True))
    held = []
    tracemalloc.start()
    try:
        for start, stop in pairwise([0.0, warm_up, warm_up + 0.5 * seconds, warm_up + seconds]):
            for k in range(round(start * RATE), round(stop * RATE)):
                navigator.push(k / RATE, *rows[k % len(rows)])
            gc.collect()  # free lists are no growth
            held.append(tracemalloc.get_traced_memory()[0])
        return 2 * min(after - before for before, after in pairwise(held))
    finally:
        tracemalloc.stop()


def test_the_memory_of_a_stream_does_not_grow(make_walk, still_model):
    growth = memory_growth(Navigator(still_model), make_walk(1, 30.0, RATE), 12.0, 20.0)
    # One number per sample.
    assert growth < BYTES_PER_NUMBER * RATE * 20.0


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_the_memory_of_an_hours_stream_does_not_grow(make_walk, still_model, backend):
    navigator = Navigator(still_model, backend=backend)
    growth = memory_growth(navigator, make_walk(1, 30.0, RATE), 120.0, 3600.0)
    # Half of one number per network update.
    assert growth < 0.5 * BYTES_PER_NUMBER * 2.0 * 3600.0
