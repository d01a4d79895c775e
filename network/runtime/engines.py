"""What runs a network: `TorchEngine` or `OnnxEngine`.

Engines map windows to displacement and log sigma. A recurrent network (RNIN) also takes the state
after the previous window and returns the state for the next one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # PyTorch is imported only by what needs it
    from stario.network.displacement import DisplacementNetwork

Float32Array = NDArray[np.float32]

Answer = tuple[Float32Array, Float32Array, Float32Array | None]
"""Displacement (B, 3) [m], log sigma (B, 3), and the state after these windows."""

BATCH = 64
"""Number of windows that an engine computes at once."""


class Engine(Protocol):
    """A network that is ready to run."""

    @property
    def is_recurrent(self) -> bool:
        """Whether the network is recurrent: it carries a state from window to window."""
        ...

    @property
    def training_form(self) -> DisplacementNetwork:
        """Trainable form of the network in PyTorch, in evaluation mode.

        Raises:
            InputError: the engine has none.
        """
        ...

    def first_state(self) -> Float32Array:
        """Return the state (2, 1, H) of a recurrent network before the first window."""
        ...

    def run(self, windows: Float32Array, state: Float32Array | None = None) -> Answer:
        """Run windows (B, 6, 200), each from its own state, or from zero if `state` is None."""
        ...
