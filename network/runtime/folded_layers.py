"""StarIO's layers as operations on buffers, with everything fixed after training folded in.

Shapes: B windows, L time steps, C channels, D channels of the star operation. `fast_stario`
explains what is folded and why the outputs stay the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from stario.network.stario import EPSILON, DualWingStarBlock, GatedUnit


class Recording:
    """Ordered operations with all buffers that they write to."""

    def __init__(self) -> None:
        self.operations: list[Callable[[], Any]] = []

    def do(self, function: Callable[..., Any], *values: Any, **named: Any) -> None:
        """Append an operation."""
        self.operations.append(partial(function, *values, **named))


class Product:
    """Product of rows (N, C) with a weight (D, C), plus a bias (D,) if there is one."""

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        self.weight = _own(weight.T)
        self.bias = None if bias is None else _own(bias)

    def record(self, recording: Recording, rows: Tensor) -> Tensor:
        """Record the product and return its buffer (N, D)."""
        result = torch.empty(len(rows), self.weight.shape[1])
        if self.bias is None:
            recording.do(torch.mm, rows, self.weight, out=result)
        else:
            recording.do(torch.addmm, self.bias, rows, self.weight, out=result)
        return result

    def onto(self, recording: Recording, rows: Tensor, x: Tensor) -> None:
        """Record the addition of the product to x (B, L, D)."""
        flat = x.view(-1, x.shape[2])
        recording.do(torch.addmm, flat, rows, self.weight, out=flat)


class Scratch:
    """Buffers that the blocks of a stage share."""

    def __init__(self, x: Tensor) -> None:
        batch, length, channels = x.shape
        inner = 2 * channels
        self.depthwise = torch.empty(batch, length, channels)
        # The star and its square are adjacent, so that they are pooled together.
        self.powers = torch.empty(2, batch, length, inner)
        self.sums = torch.empty(2, batch, inner + length)
        self.wings = torch.empty(batch, inner + length)
        self.energy = torch.empty(batch, 1)


def affine(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Return the scale and offset (C,) of a trained batch norm, in double precision."""
    assert norm.running_var is not None
    assert norm.running_mean is not None
    variance, mean = norm.running_var.double(), norm.running_mean.double()
    scale = norm.weight.detach().double() / torch.sqrt(variance + norm.eps)
    return scale, norm.bias.detach().double() - scale * mean


class Depthwise:
    """Depthwise convolution of width 3, zero-padded, with norms before and after it folded in.

    Args:
        convolution: depthwise convolution.
        before: scale and offset (C,) of its input.
        after: scale and offset (C,) of its output.
        length: L of its input.
    """

    def __init__(
        self,
        convolution: nn.Conv1d,
        before: tuple[Tensor, Tensor],
        after: tuple[Tensor, Tensor],
        length: int,
    ) -> None:
        taps = convolution.weight.double().squeeze(1).T  # (3, C)
        bias = torch.zeros(length, taps.shape[1], dtype=torch.float64)
        if convolution.bias is not None:
            bias = bias + convolution.bias
        reach = torch.ones(3, length, 1, dtype=torch.float64)
        reach[0, 0] = reach[2, -1] = 0.0  # zero padding has no offset
        bias = bias + (reach * (taps * before[1])[:, None]).sum(0)
        taps = taps * before[0] * after[0]
        self.bias = _own(bias * after[0] + after[1])
        self.taps = [_own(tap) for tap in taps]

    def record(self, recording: Recording, x: Tensor, y: Tensor) -> None:
        """Record the convolution from buffer x to buffer y, both (B, L, C)."""
        previous, present, following = self.taps
        recording.do(torch.addcmul, self.bias, x, present, out=y)
        _record_neighbours(recording, x, previous, following, y)


class Star:
    """DWSB with its residual connection.

    Attributes:
        omitted_bias: (C,) bias omitted from the result.
    """

    def __init__(self, block: DualWingStarBlock, length: int, offset: Tensor) -> None:
        before = torch.ones_like(offset), offset
        self.depthwise = Depthwise(block.depthwise, before, affine(block.norm), length)
        branches = block.branch_gate, block.branch_value
        weight = torch.cat([branch.weight.squeeze(2) for branch in branches])
        self.branches = Product(weight, torch.cat([bias_of(branch) for branch in branches]))
        self.wings = Wings(block, length)
        weight = block.project.weight.squeeze(2).double() * self.wings.factor
        self.project = Product(weight)
        self.omitted_bias = bias_of(block.project).double()

    def record(self, recording: Recording, x: Tensor, scratch: Scratch) -> None:
        """Record the in-place update of x (B, L, C)."""
        do = recording.do
        self.depthwise.record(recording, x, scratch.depthwise)
        rows = scratch.depthwise.flatten(0, 1)
        star, square = scratch.powers.flatten(1, 2).unbind()
        inner = star.shape[1]
        branches = self.branches.record(recording, rows)
        gate, value = branches[:, :inner], branches[:, inner:]
        do(torch.clamp, gate, 0.0, 6.0, out=gate)
        do(torch.mul, gate, value, out=star)
        do(torch.mul, star, star, out=square)
        do(torch.sum, scratch.powers, 2, out=scratch.sums[:, :, :inner])
        do(torch.sum, scratch.powers, 3, out=scratch.sums[:, :, inner:])
        self.wings.record(recording, scratch)
        channel, time = scratch.wings[:, :inner], scratch.wings[:, inner:]
        do(torch.add, channel.unsqueeze(1), time.unsqueeze(2), out=scratch.powers[1])
        do(torch.mul, star, square, out=star)
        self.project.onto(recording, star, x)


class Wings:
    """Weights of both wings from the pooled star operation, before its normalisation.

    With q the mean square, r = 1 / sqrt(q + eps), and mean m and variance v before normalisation,
    the normalised star has mean r m and deviation sqrt(r^2 v + eps) = r sqrt(v + eps (q + eps)).
    The convolution is linear in r too, and the weights include the r of the star they multiply.
    With sums s and s2 over n positions, n^2 v = n s2 - s^2, and E = L D (q + eps) is a sum. As
    r = sqrt(L D) / sqrt(E), the `factor` sqrt(L D) is folded into fixed weights.

    Vectors hold D positions of the channel wing, then L of the time wing.
    """

    def __init__(self, block: DualWingStarBlock, length: int) -> None:
        inner = block.branch_gate.out_channels
        self.inner = inner
        size = inner * length
        self.factor = size**0.5

        def side_by_side(of_channel: Tensor, of_time: Tensor) -> Tensor:
            parts = [of_channel.double().expand(inner), of_time.double().expand(length)]
            return torch.cat(parts)

        channel, time = block.channel_wing, block.time_wing
        count = side_by_side(torch.tensor(length), torch.tensor(inner))
        self.count = _own(count)
        self.floor = _own(count**2 * EPSILON / size)
        self.epsilon = torch.full((1,), size * EPSILON)
        self.mu = _own(side_by_side(channel.mu, time.mu) / count)
        self.xi = _own(side_by_side(channel.xi, time.xi) / count)
        kernels = channel.convolution.weight.view(3), time.convolution.weight.view(3)
        taps = [side_by_side(a, b) * self.factor for a, b in zip(*kernels, strict=True)]
        seam = torch.ones(inner + length - 1)
        seam[inner - 1] = 0.0  # the wings stay separate
        self.previous = _own(taps[0][1:] * seam)
        self.present = _own(taps[1])
        self.following = _own(taps[2][:-1] * seam)

    def record(self, recording: Recording, scratch: Scratch) -> None:
        """Record `scratch.wings`, weights x r / factor, from `scratch.sums` of star and square."""
        do = recording.do
        (total, square), weights, energy = scratch.sums.unbind(), scratch.wings, scratch.energy
        do(torch.sum, square[:, self.inner :], 1, keepdim=True, out=energy)
        do(torch.add, energy, self.epsilon, out=energy)
        do(torch.mul, square, self.count, out=square)
        do(torch.addcmul, square, total, total, value=-1.0, out=square)
        do(torch.clamp_min, square, 0.0, out=square)
        do(torch.addcmul, square, energy, self.floor, out=square)
        do(torch.sqrt, square, out=square)
        do(torch.mul, total, self.mu, out=total)
        do(torch.addcmul, total, square, self.xi, out=total)
        do(torch.mul, total, self.present, out=weights)
        _record_neighbours(recording, total, self.previous, self.following, weights)
        do(torch.rsqrt, energy, out=energy)
        do(torch.mul, weights, energy, out=weights)
        do(torch.sigmoid, weights, out=weights)
        do(torch.mul, weights, energy, out=weights)


class Gate:
    """MSGCU with its residual connection.

    Attributes:
        omitted_bias: (C,) bias omitted from the result.
    """

    def __init__(self, unit: GatedUnit, length: int, offset: Tensor) -> None:
        scale, shift = affine(unit.norm)
        shift = shift + scale * offset
        channels = len(shift)
        none = torch.ones(channels), torch.zeros(channels)
        self.value = Depthwise(unit.value, (scale, shift), none, length)
        squeeze = unit.squeeze.weight.double()
        self.squeeze = Product(squeeze * scale / length, squeeze @ shift)
        self.excite = Product(unit.excite.weight)
        size = length * channels
        self.epsilon = torch.full((1,), size * EPSILON)
        self.project = Product(unit.project.weight.squeeze(2).double() * size**0.5)
        self.omitted_bias = bias_of(unit.project).double()

    def record(self, recording: Recording, x: Tensor, scratch: Scratch) -> None:
        """Record the in-place update of x (B, L, C)."""
        do = recording.do
        pooled = torch.empty(len(x), x.shape[2])
        do(torch.sum, x, 1, out=pooled)
        hidden = self.squeeze.record(recording, pooled)
        do(torch.clamp_min, hidden, 0.0, out=hidden)
        gate = self.excite.record(recording, hidden)
        do(torch.softmax, gate, 1, out=gate)
        value, energy = scratch.depthwise, scratch.energy
        self.value.record(recording, x, value)
        do(torch.mul, value, gate.unsqueeze(1), out=value)
        do(torch.linalg.vector_norm, value.flatten(1), dim=1, keepdim=True, out=energy)
        do(torch.addcmul, self.epsilon, energy, energy, out=energy)
        do(torch.rsqrt, energy, out=energy)
        do(torch.mul, value, energy.unsqueeze(2), out=value)
        self.project.onto(recording, value.flatten(0, 1), x)


def _record_neighbours(
    recording: Recording, x: Tensor, previous: Tensor, following: Tensor, y: Tensor
) -> None:
    """Record adding to y (B, N, ...) the two outer taps of a width-3 convolution along N of x."""
    later, earlier = y[:, 1:], y[:, :-1]
    recording.do(torch.addcmul, later, x[:, :-1], previous, out=later)
    recording.do(torch.addcmul, earlier, x[:, 1:], following, out=earlier)


def _own(value: Tensor) -> Tensor:
    return value.detach().float().clone(memory_format=torch.contiguous_format)


def bias_of(convolution: nn.Conv1d) -> Tensor:
    """Return the bias (C,) of a convolution that has one."""
    assert convolution.bias is not None
    return convolution.bias.detach()
