"""TLIO: RoNIN's trunk with two heads, for the displacement and for its log standard deviation.

Liu et al.: TLIO: Tight Learned Inertial Odometry, IEEE Robotics and Automation Letters 5(4), 2020.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stario.network.baselines.parts import (
    BasicBlock,
    FCOut,
    initialise_as_ronin,
    residual_groups,
    resnet_stem,
)


class Tlio(nn.Module):
    """(B, 6, 200) to (B, outputs), the first half from one head, the second from the other."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(resnet_stem(), residual_groups(BasicBlock))
        self.mean = FCOut(512, 128, 7, 512, outputs // 2)
        self.log_sigma = FCOut(512, 128, 7, 512, outputs // 2)
        initialise_as_ronin(self)

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        features = self.trunk(windows)
        return torch.cat([self.mean(features), self.log_sigma(features)], dim=1)
