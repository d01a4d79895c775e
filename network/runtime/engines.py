"""What runs a network: `TorchEngine` or `OnnxEngine`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # PyTorch is imported only by what needs it
    from stario.network.displacement import DisplacementNetwork

Float32Array = NDArray[np.float32]

Answer = tuple[Float32Array, Float32Array, Float32Array]
"""Displacement (B, 3) [m], log sigma (B, 3), and the state (2, B, H) after these windows."""

BATCH = 64
"""Number of windows that an engine computes at once."""


class Engine(ABC):
    """A network that is ready to run.

    Attributes:
        state_size: size H of the state (2, B, H) that a recurrent network (RNIN) carries from
            window to window; 0 of others.
    """

    state_size: int

    @property
    @abstractmethod
    def training_form(self) -> DisplacementNetwork:
        """Trainable form of the network in PyTorch, in evaluation mode.

        Raises:
            InputError: an exported graph does not contain it.
        """

    def run(self, windows: Float32Array, state: Float32Array | None = None) -> Answer:
        """Run windows (B, 6, 200), each from its own state, or from zero if `state` is None."""
        if state is None:
            state = np.zeros((2, len(windows), self.state_size), np.float32)
        starts = range(0, len(windows), BATCH)
        answers = [self._run(windows[k : k + BATCH], state[:, k : k + BATCH]) for k in starts]
        mean, log_sigma, after = zip(*answers, strict=True)
        return np.concatenate(mean), np.concatenate(log_sigma), np.concatenate(after, axis=1)

    @abstractmethod
    def _run(self, windows: Float32Array, state: Float32Array) -> Answer:
        """Run up to `BATCH` windows."""
