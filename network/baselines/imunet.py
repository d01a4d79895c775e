"""I-IMUNet: depthwise-separable residual blocks and a learned subtraction of the raw input.

Zeinali, Zanddizari, Chang: IMUNet: Efficient Regression Architecture for Inertial IMU Navigation
and Positioning, IEEE Transactions on Instrumentation and Measurement 73, 2024.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stario.network.baselines.parts import ConvNorm, resnet_stem

_BLOCKS = (
    (64, 1), (64, 1), (64, 1), (64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2), (512, 1),
    (1024, 2), (1024, 1),
)  # fmt: skip
"""Channels and stride of each; the third and every second one after it is a "down" block."""


class ImuNetBlock(nn.Module):
    """Depthwise and pointwise convolution; in `down` blocks the residual is a convolution."""

    def __init__(self, inputs: int, outputs: int, stride: int, down: bool) -> None:
        super().__init__()
        self.depthwise = ConvNorm(inputs, inputs, 3, stride, groups=inputs)
        self.pointwise = ConvNorm(inputs, outputs)
        self.residual = ConvNorm(inputs, outputs, 1, stride) if down else nn.Identity()
        self.elu = nn.ELU()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, outputs, L / stride)."""
        inner = self.elu(self.pointwise(self.elu(self.depthwise(x))))
        result: Tensor = self.elu(inner + self.residual(x))
        return result


class NoiseLayer(nn.Module):
    """Layer that subtracts a weighted copy of the raw window from features and adds an offset."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(1, size) * 0.01)
        self.bias = nn.Parameter(torch.zeros(1, size))

    def forward(self, features: Tensor, raw: Tensor) -> Tensor:
        """Combine features and raw input, both (B, size)."""
        return features - self.weight * raw + self.bias


class ImuNet(nn.Module):
    """I-IMUNet: maps (B, 6, 200) to (B, outputs)."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        blocks = []
        previous = 64
        for index, (width, stride) in enumerate(_BLOCKS):
            down = index >= 2 and index % 2 == 0
            blocks.append(ImuNetBlock(previous, width, stride, down))
            previous = width
        self.trunk = nn.Sequential(resnet_stem(), *blocks)
        self.last = nn.Sequential(nn.Conv1d(previous, 400, 2), nn.BatchNorm1d(400), nn.Flatten())
        self.noise = NoiseLayer(1200)
        self.elu = nn.ELU()
        self.output = nn.Linear(1200, outputs)

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs)."""
        features = self.last(self.trunk(windows))
        output: Tensor = self.output(self.elu(self.noise(features, windows.flatten(1))))
        return output
