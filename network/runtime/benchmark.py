"""Time per window of networks on the CPU, and of both forms of one network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.inference import inference_form
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.windows import WINDOW_SAMPLES

_WARM_UP = 3


@dataclass(frozen=True)
class NetworkSpeed:
    """Time per window on the CPU.

    Attributes:
        batch: number of windows per call.
        training_form: median for the training form, in evaluation mode [ms].
        inference_form: median for the inference form [ms].
        training_form_least: the same for its fastest call [ms], which other jobs disturb least.
        inference_form_least: fastest call of the inference form [ms].
        threads: number of threads that PyTorch used.
    """

    batch: int
    training_form: float
    inference_form: float
    training_form_least: float
    inference_form_least: float
    threads: int


def network_speed(
    network: DisplacementNetwork, batches: Sequence[int] = (1, 64), runs: int = 30
) -> list[NetworkSpeed]:
    """Time both forms of a network in alternating calls.

    Args:
        network: network on the CPU; it is left in evaluation mode.
        batches: numbers of windows per call; the result has one entry for each.
        runs: number of calls of each form per batch.
    """
    forms = [network.eval(), inference_form(network)]
    speeds = []
    for batch in batches:
        windows = torch.from_numpy(random_windows(batch))
        with torch.inference_mode():
            times = milliseconds_in_turn(forms, windows, runs)
        median, least = np.median(times, axis=0).tolist(), times.min(axis=0).tolist()
        threads = torch.get_num_threads()
        speeds.append(NetworkSpeed(batch, median[0], median[1], least[0], least[1], threads))
    return speeds


def random_windows(batch: int) -> NDArray[np.float32]:
    """Return windows (batch, 6, 200) of noise about gravity."""
    windows = np.random.default_rng(0).standard_normal((batch, 6, WINDOW_SAMPLES))
    windows[:, 5] += STANDARD_GRAVITY
    return windows.astype(np.float32)


def milliseconds_in_turn(
    networks: Sequence[Callable[[Any], object]], windows: Any, runs: int
) -> FloatArray:
    """Return the time per window (runs, networks) [ms] of calls with windows (B, 6, 200).

    Every run calls all networks in turn, so that all are timed under the same load; a few runs
    before them are not timed.
    """
    seconds = np.zeros((_WARM_UP + runs, len(networks)))
    for row in seconds:
        for column, network in enumerate(networks):
            began = perf_counter()
            network(windows)
            row[column] = perf_counter() - began
    return 1e3 / len(windows) * seconds[_WARM_UP:]
