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
_FEATURES = 64 * 13


class Rnin(nn.Module):
    """RNIN, whose LSTM state comes from the preceding windows.

    Windows (B, 6, 200) are the next of B chains; (B, K, 6, 200) are the next K of each, as in
    training.
    """

    state_size = _HIDDEN

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            resnet_stem(pool=False), residual_groups(BasicBlock), ConvNorm(512, 64), nn.Flatten()
        )
        self.lstm = nn.LSTM(_FEATURES, _HIDDEN, batch_first=True)
        widths = _HIDDEN, 256, 256, outputs // 2
        self.mean = nn.Sequential(*linear_layers(*widths, dropout=0.2))
        self.log_sigma = nn.Sequential(*linear_layers(*widths, dropout=0.2))

    def forward(self, windows: Tensor) -> Tensor:
        """Map the first windows of chains, (..., 6, 200), to (..., outputs)."""
        return self.step(windows)[0]

    def step(self, windows: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Process windows of B chains.

        Args:
            windows: (B, 6, 200) or (B, K, 6, 200).
            state: (2, B, 256) hidden and cell state after each chain's last window; None for zero.

        Returns:
            Outputs (B, outputs) or (B, K, outputs), and the state after these windows.
        """
        features = self.trunk(windows.flatten(0, -3)).view(windows.shape[0], -1, _FEATURES)
        recalled, after = self.lstm(features, None if state is None else (state[:1], state[1:]))
        recalled = recalled.view(*windows.shape[:-2], _HIDDEN)
        outputs = torch.cat([self.mean(recalled), self.log_sigma(recalled)], dim=-1)
        return outputs, torch.cat(after)
