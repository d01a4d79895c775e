"""Time per displacement of both forms of a network, measured in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.inference import inference_form
from stario.network.runtime.timing import seconds_in_turn
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WINDOW_SAMPLES


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
    network: DisplacementNetwork, batches: Sequence[int] = (1, 64), runs: int = 30, seed: int = 0
) -> list[NetworkSpeed]:
    """Time both forms of a network in alternating calls, so that both run under the same load.

    Args:
        network: network on the CPU; it is left in evaluation mode.
        batches: numbers of windows per call, each at least 1.
        runs: number of calls of each form per batch, minimum 1.
        seed: seed of the windows.

    Returns:
        One entry per batch.

    Raises:
        InputError: a batch or the number of runs is less than 1.
    """
    if runs < 1 or not batches or min(batches) < 1:
        raise InputError("runs, batches", f"{runs}, {list(batches)}", "counts of at least 1")
    forms = (network.eval(), inference_form(network))
    generator = torch.Generator().manual_seed(seed)
    return [_speed(forms, batch, runs, generator) for batch in batches]


def _speed(
    forms: tuple[torch.nn.Module, ...], batch: int, runs: int, generator: torch.Generator
) -> NetworkSpeed:
    windows = torch.randn(batch, 6, WINDOW_SAMPLES, generator=generator)
    windows[:, 5] += STANDARD_GRAVITY
    with torch.inference_mode():
        seconds = seconds_in_turn([partial(form, windows) for form in forms], runs)
    per_window = 1e3 / batch * seconds
    medians, least = np.median(per_window, axis=0), per_window.min(axis=0)
    return NetworkSpeed(
        batch=batch,
        training_form=float(medians[0]),
        inference_form=float(medians[1]),
        training_form_least=float(least[0]),
        inference_form_least=float(least[1]),
        threads=torch.get_num_threads(),
    )
