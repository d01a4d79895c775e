"""RNIN: residual trunk, an LSTM over successive windows, two heads.

Chen et al.: RNIN-VIO: Robust Neural Inertial Navigation Aided Visual-Inertial Odometry in
Challenging Scenes, ISMAR 2021.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stario.network.baselines.parts import (
    BasicBlock,
    ConvNorm,
    linear_layers,
    residual_groups,
    resnet_stem,
)

_HIDDEN = 256


class Rnin(nn.Module):
    """RNIN, whose LSTM state comes from the preceding windows.

    A call with (B, 6, 200) treats each window as the first of a chain; `step` continues from the
    state after an earlier call; a call with (B, K, 6, 200) runs through K windows in a row, as in
    training.
    """

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            resnet_stem(pool=False), residual_groups(BasicBlock), ConvNorm(512, 64), nn.Flatten()
        )
        self.lstm = nn.LSTM(64 * 13, _HIDDEN, batch_first=True)
        widths = _HIDDEN, 256, 256, outputs // 2
        self.mean = nn.Sequential(*linear_layers(*widths, dropout=0.2))
        self.log_sigma = nn.Sequential(*linear_layers(*widths, dropout=0.2))

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs), or (B, K, 6, 200) to (B, K, outputs)."""
        if windows.dim() == 3:
            return self.step(windows, self.first_state(windows))[0]
        features = self.trunk(windows.flatten(0, 1)).unflatten(0, windows.shape[:2])
        return self._heads(self.lstm(features)[0])

    def first_state(self, windows: Tensor) -> Tensor:
        """Return the zero state (2, B, 256) before the first window."""
        return windows.new_zeros(2, len(windows), _HIDDEN)

    def step(self, windows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Process one window of each of B chains.

        Args:
            windows: (B, 6, 200).
            state: (2, B, 256) hidden and cell state after each chain's last window.

        Returns:
            Outputs (B, outputs) and the state after these windows.
        """
        features = self.trunk(windows).unsqueeze(1)
        recalled, (hidden, cell) = self.lstm(features, (state[:1], state[1:]))
        return self._heads(recalled.squeeze(1)), torch.cat([hidden, cell])

    def _heads(self, features: Tensor) -> Tensor:
        return torch.cat([self.mean(features), self.log_sigma(features)], dim=-1)
