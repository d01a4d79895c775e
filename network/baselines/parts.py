"""Layers shared by several of the paper's networks.

Shapes below: B windows, C channels, L time steps.
"""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn


class ConvNorm(nn.Sequential):
    """Convolution without bias, followed by batch norm.

    Args:
        inputs: input channels.
        outputs: output channels.
        kernel: width of the convolution, zero-padded to keep the length at stride 1.
        stride: stride of the convolution.
        groups: groups of the convolution; `inputs` for a depthwise one.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1
    ) -> None:
        super().__init__(
            nn.Conv1d(
                inputs, outputs, kernel, stride, padding=kernel // 2, groups=groups, bias=False
            ),
            nn.BatchNorm1d(outputs),
        )


class FCOut(nn.Sequential):
    """Head of the RoNIN networks: 1x1 convolution, then three linear layers.

    Args:
        channels: channels C of the features (B, C, L).
        length: length L of the features.
        outputs: number of outputs per window.
    """

    def __init__(self, channels: int, length: int, outputs: int) -> None:
        super().__init__(
            ConvNorm(channels, 128),
            nn.Flatten(),
            *linear_layers(128 * length, 512, 512, outputs, dropout=0.5),
        )


def linear_layers(*widths: int, dropout: float) -> list[nn.Module]:
    """Return linear layers from each width to the next, all but the last with ReLU and dropout."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(), nn.Dropout(dropout)]
    return layers[:-2]


class BasicBlock(nn.Module):
    """Residual block of two convolutions of width 3 (He et al. 2016, in one dimension)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = ConvNorm(inputs, outputs, 3, stride)
        self.second = ConvNorm(outputs, outputs, 3)
        self.shortcut = shortcut(inputs, outputs, stride)
        self.relu = nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, outputs, L / stride)."""
        inner = self.second(self.relu(self.first(x)))
        result: Tensor = self.relu(inner + self.shortcut(x))
        return result


def shortcut(inputs: int, outputs: int, stride: int) -> nn.Module:
    """Return the identity, or a strided 1x1 convolution if the shape changes."""
    if inputs == outputs and stride == 1:
        return nn.Identity()
    return ConvNorm(inputs, outputs, 1, stride)


def resnet_stem(pool: bool = True) -> nn.Sequential:
    """Return a stem that maps (B, 6, 200) to (B, 64, 50), or (B, 64, 100) without pooling."""
    layers: list[nn.Module] = [ConvNorm(6, 64, 7, 2), nn.ReLU()]
    if pool:
        layers.append(nn.MaxPool1d(3, 2, padding=1))
    return nn.Sequential(*layers)


def residual_groups(block: type[nn.Module]) -> nn.Sequential:
    """Return four groups of two blocks `block(inputs, outputs, stride)`: 64 to 512 channels."""
    blocks = []
    previous = 64
    for width, stride in ((64, 1), (128, 2), (256, 2), (512, 2)):
        blocks += [block(previous, width, stride), block(width, width, 1)]
        previous = width
    return nn.Sequential(*blocks)


def initialise_as_ronin(network: nn.Module) -> None:
    """Initialise convolutions Kaiming-normal (fan-out), linear layers N(0, 0.01) with zero bias."""
    for module in network.modules():
        if isinstance(module, nn.Conv1d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(module, nn.Linear):
            nn.init.normal_(module.weight, 0.0, 0.01)
            nn.init.zeros_(module.bias)


class InvertedResidual(nn.Module):
    """MBConv: 1x1 expansion, depthwise, 1x1 projection; a skip if the shape stays the same.

    Sandler et al. 2018 (MobileNet V2), in one dimension, without squeeze and excitation.

    Args:
        inputs: input channels.
        outputs: output channels.
        expand: expansion factor.
        stride: stride of the depthwise convolution.
        kernel: width of the depthwise convolution.
        activation: activation after expansion and depthwise convolution.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        expand: int,
        stride: int,
        kernel: int,
        activation: type[nn.Module],
    ) -> None:
        super().__init__()
        inner = inputs * expand
        self.layers = nn.Sequential(
            ConvNorm(inputs, inner),
            activation(),
            ConvNorm(inner, inner, kernel, stride, groups=inner),
            activation(),
            ConvNorm(inner, outputs),
        )
        self.skip = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, outputs, L / stride)."""
        result: Tensor = self.layers(x)
        return x + result if self.skip else result


def inverted_residuals(
    inputs: int,
    rows: tuple[tuple[int, int, int, int, int], ...],
    activation: type[nn.Module],
) -> nn.Sequential:
    """Return blocks from rows of (expand, channels, repeats, stride of the first, kernel)."""
    blocks = []
    for expand, width, repeats, stride, kernel in rows:
        for index in range(repeats):
            first = stride if index == 0 else 1
            blocks.append(InvertedResidual(inputs, width, expand, first, kernel, activation))
            inputs = width
    return nn.Sequential(*blocks)


def mobile_head(activation: type[nn.Module], outputs: int) -> nn.Sequential:
    """Return a head that maps features (B, 320, L) to (B, outputs) by the mean of 1280 channels."""
    return nn.Sequential(
        ConvNorm(320, 1280),
        activation(),
        nn.AdaptiveAvgPool1d(1),
        nn.Flatten(),
        nn.Dropout(0.5),
        nn.Linear(1280, outputs),
    )
