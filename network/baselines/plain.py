"""The small networks of the paper's table, and those of RoNIN.

- R-ResNet, R-LSTM: Herath, Yan, Furukawa: RoNIN: Robust Neural Inertial Navigation in the Wild,
  ICRA 2020. The table's count of R-LSTM is that of a head that uses all time steps at once, larger
  than RoNIN's own.
- TLIO: Liu et al.: TLIO: Tight Learned Inertial Odometry, IEEE Robotics and Automation Letters
  5(4), 2020. RoNIN's trunk with two heads, for the displacement and for its log standard deviation.
- DeepILS: Tariq et al.: DeepILS: Toward Accurate Domain-Invariant AIoT-Enabled Inertial
  Localization System, IEEE Internet of Things Journal, 2025. RoNIN's residual network with
  separable convolutions and, in every block, the attention of Woo et al.: CBAM: Convolutional Block
  Attention Module, ECCV 2018, in one dimension.
- I-MobileNet, I-MnasNet, I-EfficientNetB0 in one dimension, as compared by IMUNet's authors
  (Zeinali, Zanddizari, Chang: IMUNet, 2024). Howard et al.: MobileNets, 2017; Tan et al.: MnasNet,
  CVPR 2019; Tan, Le: EfficientNet, ICML 2019, without squeeze and excitation.

All map (B, 6, 200) to (B, outputs).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stario.network.baselines.parts import (
    BasicBlock,
    ConvNorm,
    FCOut,
    initialise_as_ronin,
    inverted_residuals,
    mobile_head,
    residual_groups,
    resnet_stem,
    shortcut,
)
from stario.sequences.windows import WINDOW_SAMPLES

_MOBILE_BLOCKS = (
    (64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2), *[(512, 1)] * 5, (1024, 2),
    (1024, 1),
)  # fmt: skip
"""Channels and stride of each separable block."""

_MNAS_ROWS = (
    (3, 24, 3, 2, 3), (3, 40, 3, 2, 5), (6, 80, 3, 2, 5), (6, 96, 2, 1, 3), (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)  # fmt: skip
_EFFICIENT_ROWS = (
    (1, 16, 1, 1, 3), (6, 24, 2, 2, 3), (6, 40, 2, 2, 5), (6, 80, 3, 2, 3), (6, 112, 3, 1, 5),
    (6, 192, 4, 2, 5), (6, 320, 1, 1, 3),
)  # fmt: skip
"""Expansion, channels, repeats, stride, kernel."""


class RoninResNet(nn.Module):
    """R-ResNet: residual groups of `block`, and a head."""

    block: type[nn.Module] = BasicBlock

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(resnet_stem(), residual_groups(self.block))
        self.head = FCOut(512, 7, outputs)
        initialise_as_ronin(self)

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs)."""
        output: Tensor = self.head(self.trunk(windows))
        return output


class Tlio(nn.Module):
    """TLIO: the first half of the outputs is from one head, the second from the other."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(resnet_stem(), residual_groups(BasicBlock))
        self.mean = FCOut(512, 7, outputs // 2)
        self.log_sigma = FCOut(512, 7, outputs // 2)
        initialise_as_ronin(self)

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs)."""
        features = self.trunk(windows)
        return torch.cat([self.mean(features), self.log_sigma(features)], dim=1)


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


class RoninLstm(nn.Module):
    """R-LSTM, whose state starts at zero in every window."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.lstm = nn.LSTM(6, 100, num_layers=3, batch_first=True)
        self.head = FCOut(100, WINDOW_SAMPLES, outputs)

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs)."""
        features, _ = self.lstm(windows.transpose(1, 2))
        output: Tensor = self.head(features.transpose(1, 2))
        return output


class _Layers(nn.Module):
    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(*layers)

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs)."""
        output: Tensor = self.layers(windows)
        return output


class MobileNet(_Layers):
    """MobileNet V1."""

    def __init__(self, outputs: int = 6) -> None:
        layers: list[nn.Module] = [ConvNorm(6, 32, 3, 2), nn.ReLU()]
        previous = 32
        for width, stride in _MOBILE_BLOCKS:
            layers += [ConvNorm(previous, previous, 3, stride, groups=previous), nn.ReLU()]
            layers += [ConvNorm(previous, width), nn.ReLU()]
            previous = width
        head = nn.AdaptiveAvgPool1d(1), nn.Flatten(), nn.Linear(previous, outputs)
        super().__init__(*layers, *head)


class MnasNet(_Layers):
    """MnasNet: inverted residuals found by architecture search."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__(
            ConvNorm(6, 32, 3, 2),
            nn.ReLU6(),
            ConvNorm(32, 32, 3, groups=32),
            nn.ReLU6(),
            ConvNorm(32, 16),
            inverted_residuals(16, _MNAS_ROWS, nn.ReLU6),
            mobile_head(nn.ReLU6, outputs),
        )


class EfficientNetB0(_Layers):
    """EfficientNet-B0, whose activation is the swish, x sigmoid(x)."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__(
            ConvNorm(6, 32, 3, 2),
            nn.SiLU(),
            inverted_residuals(32, _EFFICIENT_ROWS, nn.SiLU),
            mobile_head(nn.SiLU, outputs),
        )


def _depthwise(channels: int, stride: int) -> nn.Conv1d:
    return nn.Conv1d(channels, channels, 3, stride, padding=1, groups=channels, bias=False)
