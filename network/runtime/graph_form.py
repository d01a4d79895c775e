"""The form of a network that is exported: StarIO without loops, writes in place or split norms.

The arithmetic is that of `stario.network.runtime.fast_stario`, whose folded weights are used. A
graph's runtime has no recording to replay; what counts there is the number of nodes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.fast_stario import FastStarIO, Stage
from stario.network.runtime.folded_layers import Depthwise, Gate, Product, Star, Wings
from stario.network.runtime.folding import folded
from stario.network.stario import EPSILON, StarIO


def graph_form(network: DisplacementNetwork) -> DisplacementNetwork:
    """A copy of a network in evaluation mode, as it is exported; outputs agree to 1e-5."""
    inner = network.eval().network
    graph = _StarIOGraph(FastStarIO(inner)) if isinstance(inner, StarIO) else folded(inner)
    return DisplacementNetwork(graph).eval()


class _StarIOGraph(nn.Module):
    """StarIO on rows of channels, (B L, C)."""

    def __init__(self, network: FastStarIO) -> None:
        super().__init__()
        self.stages = nn.ModuleList(map(_StageGraph, network.stages))
        self.head = nn.ModuleList(map(_Rows, network.head))

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        x = F.pad(windows.transpose(1, 2), (0, 0, 1, 1))
        for stage in self.stages:
            x = stage(x)
        rows = x.flatten(1)
        for layer in self.head[:-1]:
            rows = F.relu(layer(rows))
        output: Tensor = self.head[-1](rows)
        return output


class _Rows(nn.Module):
    weight: Tensor
    bias: Tensor

    def __init__(self, product: Product) -> None:
        super().__init__()
        self.register_buffer("weight", product.weight)
        self.register_buffer("bias", product.bias)

    def forward(self, rows: Tensor) -> Tensor:
        return torch.addmm(self.bias, rows, self.weight)


class _StageGraph(nn.Module):
    def __init__(self, stage: Stage) -> None:
        super().__init__()
        self.stride, self.length = stage.stride, stage.length
        self.taps = _Rows(stage.taps)
        self.layers = nn.ModuleList(
            _StarGraph(layer, stage.length) if isinstance(layer, Star) else _GateGraph(layer)
            for layer in stage.layers
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, L before, C before), padded already, to (B, L, C)."""
        channels = x.shape[2]
        if self.stride == 3:
            taps = x[:, : 3 * self.length].reshape(-1, 3 * channels)
        else:
            reach = self.stride * (self.length - 1) + 1
            parts = [x[:, k : k + reach : self.stride] for k in range(3)]
            taps = torch.cat(parts, dim=2).view(-1, 3 * channels)
        rows = self.taps(taps)
        for layer in self.layers:
            rows = layer(rows)
        result: Tensor = rows.view(-1, self.length, rows.shape[1])
        return result


class _DepthwiseGraph(nn.Module):
    bias: Tensor
    previous: Tensor
    present: Tensor
    following: Tensor

    def __init__(self, layer: Depthwise) -> None:
        super().__init__()
        self.register_buffer("bias", layer.bias)
        for name, tap in zip(("previous", "present", "following"), layer.taps, strict=True):
            self.register_buffer(name, tap)

    def forward(self, x: Tensor) -> Tensor:
        """(B, L, C) to (B, L, C)."""
        padded = F.pad(x, (0, 0, 1, 1))
        middle = x * self.present + self.bias
        return middle + padded[:, :-2] * self.previous + padded[:, 2:] * self.following


class _StarGraph(nn.Module):
    project: Tensor

    def __init__(self, star: Star, length: int) -> None:
        super().__init__()
        self.length, self.inner = length, star.wings.inner
        self.depthwise = _DepthwiseGraph(star.depthwise)
        weights, biases = star.branches.weight.chunk(2, 1), star.branches.bias
        assert biases is not None
        self.gate, self.value = (
            _Rows(Product(weight.T, bias))
            for weight, bias in zip(weights, biases.chunk(2), strict=True)
        )
        self.wings = _WingsGraph(star.wings)
        self.register_buffer("project", star.project.weight / star.wings.factor)

    def forward(self, rows: Tensor) -> Tensor:
        """(B L, C) to (B L, C)."""
        x = rows.view(-1, self.length, rows.shape[1])
        mixed = self.depthwise(x).view(-1, rows.shape[1])
        star = (self.gate(mixed).clamp(0.0, 6.0) * self.value(mixed)).view(
            -1, self.length, self.inner
        )
        star = star * self.wings(star)
        return torch.addmm(rows, star.view(-1, self.inner), self.project)


class _WingsGraph(nn.Module):
    """As `Wings`, but pooled by means, with a place between both wings that keeps them apart."""

    mu: Tensor
    xi: Tensor
    taps: Tensor

    def __init__(self, wings: Wings) -> None:
        super().__init__()
        self.inner = wings.inner
        for name in ("mu", "xi"):
            values: Tensor = getattr(wings, name) * wings.count
            parts = values[: self.inner], torch.zeros(1), values[self.inner :]
            self.register_buffer(name, torch.cat(parts))
        # Here r is whole: the factor that `Wings` leaves to the taps is taken off them.
        taps = [tap / wings.factor for tap in (wings.previous, wings.present, wings.following)]
        kernels = [torch.stack([tap[end] for tap in taps]) for end in (0, -1)]
        self.register_buffer("taps", torch.stack(kernels).unsqueeze(1))

    def forward(self, star: Tensor) -> Tensor:
        """Weights (B, L, D) x r."""
        square = star * star
        over_channels = square.mean(2)
        energy = over_channels.mean(1, keepdim=True) + EPSILON
        mean = torch.cat([F.pad(star.mean(1), (0, 1)), star.mean(2)], dim=1)
        squares = torch.cat([F.pad(square.mean(1), (0, 1)), over_channels], dim=1)
        variance = (squares - mean * mean).clamp(min=0.0)
        deviation = torch.sqrt(variance + energy * EPSILON)
        pooled = (mean * self.mu + deviation * self.xi).unsqueeze(1)
        r = torch.pow(energy, -0.5).unsqueeze(1)
        weights = torch.sigmoid(F.conv1d(pooled, self.taps, padding=1) * r) * r
        return weights[:, :1, : self.inner] + weights[:, 1, self.inner + 1 :].unsqueeze(2)


class _GateGraph(nn.Module):
    excite: Tensor
    project: Tensor

    def __init__(self, gate: Gate) -> None:
        super().__init__()
        self.value = _DepthwiseGraph(gate.value)
        self.length = len(gate.value.bias)
        self.squeeze = _Rows(gate.squeeze)
        self.epsilon = float(gate.epsilon)
        self.register_buffer("excite", gate.excite.weight)
        self.register_buffer("project", gate.project.weight)

    def forward(self, rows: Tensor) -> Tensor:
        """(B L, C) to (B L, C)."""
        x = rows.view(-1, self.length, rows.shape[1])
        gate = torch.softmax(F.relu(self.squeeze(x.sum(1))) @ self.excite, dim=1)
        value = self.value(x) * gate.unsqueeze(1)
        energy = (value * value).sum((1, 2), keepdim=True) + self.epsilon
        normalised = (value * torch.pow(energy, -0.5)).view(-1, rows.shape[1])
        return torch.addmm(rows, normalised, self.project)
