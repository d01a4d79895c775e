"""I-EfficientNetB0: EfficientNet-B0 in one dimension, as IMUNet's authors compare with.

Tan, Le: EfficientNet: Rethinking Model Scaling for Convolutional Neural Networks, ICML 2019; on IMU
windows, without squeeze and excitation, in Zeinali, Zanddizari, Chang: IMUNet, 2024.
"""

from __future__ import annotations

from torch import Tensor, nn

from stario.network.baselines.parts import ConvNorm, inverted_residuals, mobile_head

_ROWS = (
    (1, 16, 1, 1, 3),
    (6, 24, 2, 2, 3),
    (6, 40, 2, 2, 5),
    (6, 80, 3, 2, 3),
    (6, 112, 3, 1, 5),
    (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)
"""Expansion, channels, repeats, stride, kernel."""


class EfficientNetB0(nn.Module):
    """(B, 6, 200) to (B, outputs); its activation is the swish, x sigmoid(x)."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            ConvNorm(6, 32, 3, 2),
            nn.SiLU(),
            inverted_residuals(32, _ROWS, nn.SiLU),
            mobile_head(320, nn.SiLU, outputs),
        )

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        output: Tensor = self.layers(windows)
        return output
