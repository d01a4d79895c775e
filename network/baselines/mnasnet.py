"""I-MnasNet: MnasNet in one dimension, as IMUNet's authors compare with.

Tan et al.: MnasNet: Platform-Aware Neural Architecture Search for Mobile, CVPR 2019; on IMU windows
in Zeinali, Zanddizari, Chang: IMUNet, 2024.
"""

from __future__ import annotations

from torch import Tensor, nn

from stario.network.baselines.parts import ConvNorm, inverted_residuals, mobile_head

_ROWS = (
    (3, 24, 3, 2, 3),
    (3, 40, 3, 2, 5),
    (6, 80, 3, 2, 5),
    (6, 96, 2, 1, 3),
    (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)
"""Expansion, channels, repeats, stride, kernel."""


class MnasNet(nn.Module):
    """(B, 6, 200) to (B, outputs)."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            ConvNorm(6, 32, 3, 2),
            nn.ReLU6(),
            ConvNorm(32, 32, 3, groups=32),
            nn.ReLU6(),
            ConvNorm(32, 16),
            inverted_residuals(16, _ROWS, nn.ReLU6),
            mobile_head(320, nn.ReLU6, outputs),
        )

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        output: Tensor = self.layers(windows)
        return output
