"""DeepILS: RoNIN's residual network with separable convolutions and attention in every block.

Tariq et al.: DeepILS: Toward Accurate Domain-Invariant AIoT-Enabled Inertial Localization System,
IEEE Internet of Things Journal, 2025. The attention is that of Woo et al.: CBAM: Convolutional
Block Attention Module, ECCV 2018, in one dimension.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stario.network.baselines.parts import ConvNorm, shortcut
from stario.network.baselines.plain import RoninResNet


class Attention(nn.Module):
    """CBAM: weights over channels, then weights over time."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.average = nn.AdaptiveAvgPool1d(1)
        self.shared = nn.Sequential(
            nn.Conv1d(channels, channels // 16, 1, bias=False),
            nn.ReLU(),
            nn.Conv1d(channels // 16, channels, 1, bias=False),
        )
        self.spatial = nn.Conv1d(2, 1, 7, padding=3, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, C, L)."""
        average, largest = self.average(x), x.amax(2, keepdim=True)
        x = x * torch.sigmoid(self.shared(average) + self.shared(largest))
        pooled = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], dim=1)
        return x * torch.sigmoid(self.spatial(pooled))


class SeparableBlock(nn.Module):
    """Residual block of two separable convolutions and attention."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            _depthwise(inputs, stride),
            ConvNorm(inputs, outputs),
            nn.ReLU(),
            _depthwise(outputs, 1),
            ConvNorm(outputs, outputs),
            Attention(outputs),
        )
        self.shortcut = shortcut(inputs, outputs, stride)
        self.relu = nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, outputs, L / stride)."""
        result: Tensor = self.relu(self.layers(x) + self.shortcut(x))
        return result


class DeepIls(RoninResNet):
    """R-ResNet with separable attention blocks."""

    block = SeparableBlock


def _depthwise(channels: int, stride: int) -> nn.Conv1d:
    return nn.Conv1d(channels, channels, 3, stride, padding=1, groups=channels, bias=False)
