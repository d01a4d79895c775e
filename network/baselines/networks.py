"""The networks that the paper compares StarIO with.

- R-ResNet, R-LSTM: Herath, Yan, Furukawa: RoNIN: Robust Neural Inertial Navigation in the Wild,
  ICRA 2020. The table's count of R-LSTM is that of a head that uses all time steps at once, larger
  than RoNIN's own.
- TLIO: Liu et al.: TLIO: Tight Learned Inertial Odometry, IEEE Robotics and Automation Letters
  5(4), 2020. RoNIN's trunk with two heads, for the displacement and for its log standard deviation.
- DeepILS: Tariq et al.: DeepILS: Toward Accurate Domain-Invariant AIoT-Enabled Inertial
  Localization System, IEEE Internet of Things Journal, 2025. RoNIN's residual network with
  separable convolutions and, in every block, the attention of Woo et al.: CBAM: Convolutional Block
  Attention Module, ECCV 2018, in one dimension.
- RNIN: Chen et al.: RNIN-VIO: Robust Neural Inertial Navigation Aided Visual-Inertial Odometry in
  Challenging Scenes, ISMAR 2021. A residual trunk, an LSTM over successive windows, two heads.
- I-IMUNet: Zeinali, Zanddizari, Chang: IMUNet: Efficient Regression Architecture for Inertial IMU
  Navigation and Positioning, IEEE Transactions on Instrumentation and Measurement 73, 2024.
  Depthwise-separable residual blocks and a learned subtraction of the raw input.
- I-MobileNet, I-MnasNet, I-EfficientNetB0 in one dimension, as compared by IMUNet's authors.
  Howard et al.: MobileNets, 2017; Tan et al.: MnasNet,
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
    linear_layers,
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

_IMUNET_BLOCKS = (
    (64, 1), (64, 1), (64, 1), (64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2), (512, 1),
    (1024, 2), (1024, 1),
)  # fmt: skip
"""Channels and stride of each; the third and every second one after it is a "down" block."""

_MNAS_ROWS = (
    (3, 24, 3, 2, 3), (3, 40, 3, 2, 5), (6, 80, 3, 2, 5), (6, 96, 2, 1, 3), (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)  # fmt: skip
_EFFICIENT_ROWS = (
    (1, 16, 1, 1, 3), (6, 24, 2, 2, 3), (6, 40, 2, 2, 5), (6, 80, 3, 2, 3), (6, 112, 3, 1, 5),
    (6, 192, 4, 2, 5), (6, 320, 1, 1, 3),
)  # fmt: skip
"""Expansion, channels, repeats, stride, kernel."""

_RNIN_HIDDEN = 256
_RNIN_FEATURES = 64 * 13


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


class Rnin(nn.Module):
    """RNIN, whose LSTM state comes from the preceding windows.

    Windows (B, 6, 200) are the next of B chains; (B, K, 6, 200) are the next K of each, as in
    training.
    """

    state_size = _RNIN_HIDDEN

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            resnet_stem(pool=False), residual_groups(BasicBlock), ConvNorm(512, 64), nn.Flatten()
        )
        self.lstm = nn.LSTM(_RNIN_FEATURES, _RNIN_HIDDEN, batch_first=True)
        widths = _RNIN_HIDDEN, 256, 256, outputs // 2
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
        features = self.trunk(windows.flatten(0, -3)).view(windows.shape[0], -1, _RNIN_FEATURES)
        recalled, after = self.lstm(features, None if state is None else (state[:1], state[1:]))
        recalled = recalled.view(*windows.shape[:-2], _RNIN_HIDDEN)
        outputs = torch.cat([self.mean(recalled), self.log_sigma(recalled)], dim=-1)
        return outputs, torch.cat(after)


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
        for index, (width, stride) in enumerate(_IMUNET_BLOCKS):
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
