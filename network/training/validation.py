"""How well a network in training does on recordings kept from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stario.network.displacement import DisplacementNetwork
from stario.sequences.errors import InputError
from stario.sequences.rotations import about_z
from stario.sequences.windows import (
    WINDOW_SAMPLES,
    WorldStream,
    headings_at,
    turned_windows,
    window_starts,
    windows_at,
)

VALIDATION_STRIDE = 20
"""Samples from the start of a window to the next one's."""


class ValidationSet:
    """Windows kept from training, cut anew each time: all at once would fill the memory.

    Args:
        streams: of recordings kept from training.
        device: of the networks that are asked.

    Raises:
        InputError: no stream is longer than a second.
    """

    def __init__(self, streams: Sequence[WorldStream], device: torch.device) -> None:
        self.streams, self.device = streams, device
        counts = [len(window_starts(stream, VALIDATION_STRIDE)) for stream in streams]
        if not sum(counts):
            raise InputError("validation", "no window", "stretches longer than a second")
        self.names = np.repeat([stream.name for stream in streams], counts)

    @torch.inference_mode()
    def residuals(self, network: DisplacementNetwork) -> tuple[np.ndarray, np.ndarray]:
        """Errors (M, 3) [m] and log sigmas (M, 3); the network is left in evaluation mode."""
        network.eval()
        errors, log_sigmas = [], []
        for stream in self.streams:
            answer = _Answers(network)
            starts = window_starts(stream, VALIDATION_STRIDE)
            for first in range(0, len(starts), answer.batch):
                windows, target = windows_at(stream, starts[first : first + answer.batch])
                heading = headings_at(stream.facing_W, starts[first : first + answer.batch])
                windows = turned_windows(windows, -heading)
                target = about_z(-heading).apply(target).astype(np.float32)
                mean, log_sigma = answer(torch.from_numpy(windows).to(self.device))
                errors.append(mean.cpu() - torch.from_numpy(target))
                log_sigmas.append(log_sigma.cpu())
        return torch.cat(errors).double().numpy(), torch.cat(log_sigmas).double().numpy()

    def errors(self, network: DisplacementNetwork) -> dict[str, float]:
        """Mean squared error by recording [m^2]."""
        squared = (self.residuals(network)[0] ** 2).sum(axis=1)
        return {str(n): float(squared[self.names == n].mean()) for n in dict.fromkeys(self.names)}


class _Answers:
    """A network's answers to the windows of one stream, in order of time."""

    def __init__(self, network: DisplacementNetwork) -> None:
        self._network = network
        # Windows that begin within one second belong to series of their own, as in use.
        self.batch = WINDOW_SAMPLES // VALIDATION_STRIDE if network.remembers else 256
        self._state = network.first_state(self.batch) if network.remembers else None

    def __call__(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        if self._state is None:
            mean, log_sigma = self._network(windows)
        else:
            state = self._state[:, : len(windows)].contiguous()
            mean, log_sigma, self._state = self._network.step(windows, state)
        return mean, log_sigma
