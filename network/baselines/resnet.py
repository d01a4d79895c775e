"""R-ResNet: the ResNet-18 of RoNIN.

Herath, Yan, Furukawa: RoNIN: Robust Neural Inertial Navigation in the Wild, ICRA 2020.
"""

from __future__ import annotations

from torch import Tensor, nn

from stario.network.baselines.parts import (
    BasicBlock,
    FCOut,
    initialise_as_ronin,
    residual_groups,
    resnet_stem,
)


class RoninResNet(nn.Module):
    """(B, 6, 200) to (B, outputs)."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(resnet_stem(), residual_groups(BasicBlock))
        self.head = FCOut(512, 128, 7, 512, outputs)
        initialise_as_ronin(self)

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        output: Tensor = self.head(self.trunk(windows))
        return output
