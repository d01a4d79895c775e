"""I-MobileNet: MobileNet V1 in one dimension, as IMUNet's authors compare with.

Howard et al.: MobileNets: Efficient Convolutional Neural Networks for Mobile Vision Applications,
2017; on IMU windows in Zeinali, Zanddizari, Chang: IMUNet, 2024.
"""

from __future__ import annotations

from torch import Tensor, nn

from stario.network.baselines.parts import ConvNorm

_BLOCKS = (
    (64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2), *[(512, 1)] * 5, (1024, 2),
    (1024, 1),
)  # fmt: skip
"""Channels and stride of each separable block."""


class MobileNet(nn.Module):
    """(B, 6, 200) to (B, outputs)."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        layers: list[nn.Module] = [ConvNorm(6, 32, 3, 2), nn.ReLU()]
        previous = 32
        for width, stride in _BLOCKS:
            layers += [ConvNorm(previous, previous, 3, stride, groups=previous), nn.ReLU()]
            layers += [ConvNorm(previous, width), nn.ReLU()]
            previous = width
        self.layers = nn.Sequential(
            *layers, nn.AdaptiveAvgPool1d(1), nn.Flatten(), nn.Linear(previous, outputs)
        )

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        output: Tensor = self.layers(windows)
        return output
