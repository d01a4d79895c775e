"""Trainable module around every network, from windows to displacement and log sigma."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from stario.sequences.sequence import STANDARD_GRAVITY

LOG_SIGMA_RANGE = (-6.0, 3.0)


class DisplacementNetwork(nn.Module):
    """A network with centred input: gravity is subtracted from the vertical specific force.

    Args:
        network: maps (B, 6, 200) to (B, 6); a recurrent one also has `first_state` and `step`, and
            maps (B, K, 6, 200) to (B, K, 6).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.gravity: Tensor
        gravity = torch.zeros(6, 1)
        gravity[5] = STANDARD_GRAVITY
        self.register_buffer("gravity", gravity, persistent=False)

    @property
    def is_recurrent(self) -> bool:
        """Whether the network is recurrent: it carries a state from window to window."""
        return hasattr(self.network, "step")

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Map windows (B, 6, 200) to displacement (B, 3) [m] and log sigma (B, 3)."""
        return _split_output(self.network(windows - self.gravity))

    def step(self, windows: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Run a recurrent network as in `forward`, starting from its state (2, B, H).

        Returns:
            Displacement, log sigma, and the state after these windows.
        """
        network: Any = self.network
        output, after = network.step(windows - self.gravity, state)
        return *_split_output(output), after

    def first_state(self, batch: int) -> Tensor:
        """Return the state (2, B, H) of a recurrent network before the first window."""
        network: Any = self.network
        state: Tensor = network.first_state(self.gravity.new_zeros(batch, 0))
        return state


def _split_output(output: Tensor) -> tuple[Tensor, Tensor]:
    output = output.float()
    return output[..., :3], output[..., 3:].clamp(*LOG_SIGMA_RANGE)
