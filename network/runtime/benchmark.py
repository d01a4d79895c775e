"""Time per window of networks on the CPU, and of one network in both engines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from stario.network.model import DisplacementModel
from stario.network.runtime.engines import Engine
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.windows import WINDOW_SAMPLES

_WARM_UP = 3


@dataclass(frozen=True)
class NetworkSpeed:
    """Time per window on the CPU.

    Attributes:
        batch: number of windows per call.
        model: median for the model as it runs [ms].
        torch: median for its network in PyTorch [ms].
    """

    batch: int
    model: float
    torch: float


def network_speed(
    model: DisplacementModel, batches: Sequence[int] = (1, 64), runs: int = 30
) -> list[NetworkSpeed]:
    """Time a model, and the same network in PyTorch, in alternating calls.

    Args:
        model: model with trainable weights.
        batches: numbers of windows per call; the result has one entry for each.
        runs: number of calls of each per batch.
    """
    engines = [model.engine, TorchEngine(model.training_form)]
    return [
        NetworkSpeed(batch, *median_milliseconds(engines, batch, runs).tolist())
        for batch in batches
    ]


def random_windows(batch: int) -> NDArray[np.float32]:
    """Return windows (batch, 6, 200) of noise about gravity."""
    windows = np.random.default_rng(0).standard_normal((batch, 6, WINDOW_SAMPLES))
    windows[:, 5] += STANDARD_GRAVITY
    return windows.astype(np.float32)


def median_milliseconds(engines: Sequence[Engine], batch: int, runs: int) -> FloatArray:
    """Return the median time per window (engines,) [ms].

    Every run calls all engines in turn, so that all are timed under the same load; a few runs
    before them are not timed.
    """
    windows = random_windows(batch)
    seconds = np.zeros((_WARM_UP + runs, len(engines)))
    for row in seconds:
        for column, engine in enumerate(engines):
            began = perf_counter()
            engine.run(windows)
            row[column] = perf_counter() - began
    return np.asarray(np.median(1e3 / batch * seconds[_WARM_UP:], axis=0))
