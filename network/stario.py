"""StarIO: star operation, dual-wing attention, multi-scale gated convolution unit.

A stem and four stages of residual blocks process a window of IMU data. Each block is a DWSB (the
star operation, an element-wise product of two pointwise branches, weighted by two wings that use
its mean and deviation over time and over channels) followed by an MSGCU (a depthwise value branch
gated per channel). Widths, expansion and biases are chosen to match the published counts.

Shapes below: B windows, C channels, L time steps.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stario.network.baselines.parts import linear_layers

WIDTHS = (64, 128, 192, 256)
BLOCKS = (2, 2, 2, 2)
_LENGTH_AT_HEAD = 3
EPSILON = 1e-5


def moments(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation along `dim`, in one pass over x.

    sqrt(E[x^2] - E[x]^2 + eps) is several times faster than `torch.std`, and the epsilon keeps
    its gradient finite where x does not vary.
    """
    mean = x.mean(dim, keepdim=True)
    square = (x * x).mean(dim, keepdim=True)
    return mean, torch.sqrt(torch.clamp(square - mean * mean, min=0.0) + EPSILON)


class Wing(nn.Module):
    """Attention weights along one axis from mean and deviation over the other.

    `mu` and `xi` mix the two pooled vectors; a convolution of width 3 along the axis and a sigmoid
    turn them into weights.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mu = nn.Parameter(torch.ones(1))
        self.xi = nn.Parameter(torch.ones(1))
        self.convolution = nn.Conv1d(1, 1, 3, padding=1, bias=False)

    def forward(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return weights (B, 1, A) from pooled vectors (B, 1, A)."""
        return torch.sigmoid(self.convolution(self.mu * mean + self.xi * deviation))


class DualWingStarBlock(nn.Module):
    """DWSB: depthwise convolution, star operation, channel wing plus time wing."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = 2 * channels
        self.depthwise = nn.Conv1d(channels, channels, 3, padding=1, groups=channels, bias=False)
        self.norm = nn.BatchNorm1d(channels)
        self.branch_gate = nn.Conv1d(channels, inner, 1)
        self.branch_value = nn.Conv1d(channels, inner, 1)
        self.channel_wing = Wing()
        self.time_wing = Wing()
        self.project = nn.Conv1d(inner, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, C, L)."""
        x = self.norm(self.depthwise(x))
        star = rms_normalised(F.relu6(self.branch_gate(x)) * self.branch_value(x))
        over_time = [m.transpose(1, 2) for m in moments(star, dim=2)]
        weight_channel = self.channel_wing(*over_time).transpose(1, 2)
        weight_time = self.time_wing(*moments(star, dim=1))
        mixed: Tensor = self.project(star * (weight_channel + weight_time))
        return mixed


class GatedUnit(nn.Module):
    """MSGCU: depthwise value branch times a softmax gate over channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(channels)
        self.value = nn.Conv1d(channels, channels, 3, padding=1, groups=channels)
        self.squeeze = nn.Linear(channels, channels // 2, bias=False)
        self.excite = nn.Linear(channels // 2, channels, bias=False)
        self.project = nn.Conv1d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, C, L)."""
        x = self.norm(x)
        gate = F.softmax(self.excite(F.relu(self.squeeze(x.mean(dim=2)))), dim=1)
        gated: Tensor = self.project(rms_normalised(self.value(x) * gate.unsqueeze(2)))
        return gated


def rms_normalised(x: Tensor) -> Tensor:
    """Divide x by its root mean square over each window.

    Star products have heavy tails and a softmax gate averages 1/C: without this the blocks' outputs
    are almost zero at first and single batches explode later. It adds no parameter to the counts.
    """
    return x * torch.rsqrt((x * x).mean(dim=(1, 2), keepdim=True) + EPSILON)


class Block(nn.Module):
    """Residual block: X' = X + DWSB(X), then X' + MSGCU(X')."""

    def __init__(self, channels: int, gated_unit: bool) -> None:
        super().__init__()
        self.star = DualWingStarBlock(channels)
        self.gated = GatedUnit(channels) if gated_unit else None

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, L) to (B, C, L)."""
        x = x + self.star(x)
        return x if self.gated is None else x + self.gated(x)


class StarIO(nn.Module):
    """The network: maps (B, 6, 200) of gyroscope and accelerometer to (B, outputs).

    Args:
        outputs: 6 for displacement and log standard deviation, 2 for the counts of the table.
        gated_unit: whether blocks have the MSGCU; False is the paper's ablation.
    """

    def __init__(self, outputs: int = 6, gated_unit: bool = True) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        previous = 6
        for width, blocks in zip(WIDTHS, BLOCKS, strict=True):
            stem = previous == 6
            stride, padding = (2, 1) if stem else (3, 0)
            layers += [
                nn.Conv1d(previous, width, 3, stride=stride, padding=padding, bias=False),
                nn.BatchNorm1d(width),
                *(Block(width, gated_unit) for _ in range(blocks)),
            ]
            previous = width
        self.trunk = nn.Sequential(*layers)
        features = previous * _LENGTH_AT_HEAD
        layers = linear_layers(features, 512, 256, outputs, dropout=0.5)
        self.head = nn.Sequential(nn.Flatten(), *layers)

    def forward(self, windows: Tensor) -> Tensor:
        """Map (B, 6, 200) to (B, outputs)."""
        output: Tensor = self.head(self.trunk(windows))
        return output
