"""Trainable module around every network, from windows to displacement and log sigma."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from stario.network.architectures import build_network
from stario.sequences.sequence import STANDARD_GRAVITY

LOG_SIGMA_RANGE = (-6.0, 3.0)


class DisplacementNetwork(nn.Module):
    """A network with centred input: gravity is subtracted from the vertical specific force.

    Args:
        network: maps (B, 6, 200) to (B, 6); a recurrent one also has `state_size` and `step`, and
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
    def state_size(self) -> int:
        """Size H of the state (2, B, H) that a recurrent network carries along; 0 of others."""
        return getattr(self.network, "state_size", 0)

    @property
    def is_recurrent(self) -> bool:
        """Whether the network is recurrent: it carries a state from window to window."""
        return self.state_size > 0

    def forward(self, windows: Tensor, state: Tensor | None = None) -> tuple[Tensor, ...]:
        """Map windows (B, 6, 200) to displacement (B, 3) [m] and log sigma (B, 3).

        A recurrent network starts from a state (2, B, H), or from zero, and also returns the state
        after these windows.
        """
        network: Any = self.network
        centred = windows - self.gravity
        output, *after = network.step(centred, state) if self.is_recurrent else (network(centred),)
        output = output.float()
        return output[..., :3], output[..., 3:].clamp(*LOG_SIGMA_RANGE), *after


def trainable(architecture: str, state: Mapping[str, Tensor]) -> DisplacementNetwork:
    """Build a network with its weights, in evaluation mode.

    Raises:
        RuntimeError: the tensors are not those of the architecture.
    """
    network = DisplacementNetwork(build_network(architecture))
    network.network.load_state_dict(state)
    return network.eval()
