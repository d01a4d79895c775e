"""StarIO for use on a CPU: the same numbers from a recording of in-place operations.

What makes it fast, each step exact up to rounding:

- Activations are rows of channels, (B, L, C): 1x1 convolutions, and strided ones whose taps do not
  overlap, are matrix products. The two branches of the star operation are one product.
- Trained batch norms are affine and go into the convolution next to them. Where a norm comes
  before zero padding, the padded taps miss its offset, so that a depthwise convolution gets a bias
  per position and channel.
- Biases of the blocks' last convolutions only shift the residual stream by a constant: it is left
  out, and what reads the stream has it in its own bias.
- The root mean square of a window is one number: what follows is linear in it, so it scales
  pooled vectors instead of the large tensors. Sums stand for means, counts go into weights.
- Both wings lie side by side in one vector; taps per position keep their convolutions apart.
- A single window is a few hundred operations of about a microsecond each, less than it takes to
  ask for their memory: for every size of batch they are recorded once, with buffers and views.

Shapes below: B windows, L time steps, C channels, D channels of the star operation.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from stario.network.runtime.folding import affine
from stario.network.stario import EPSILON, Block, DualWingStarBlock, GatedUnit, StarIO
from stario.sequences.windows import WINDOW_SAMPLES

_RECORDINGS = 4
"""Sizes of batches whose buffers are kept, for each thread."""


class FastStarIO(nn.Module):
    """StarIO in evaluation mode: (B, 6, 200) to (B, outputs), without gradients.

    Args:
        network: whose weights are copied; later changes do not reach the copy.
    """

    def __init__(self, network: StarIO) -> None:
        super().__init__()
        self.stages: list[Stage] = []
        layers = list(network.trunk)
        length, offset = WINDOW_SAMPLES, torch.zeros(6, dtype=torch.float64)
        while layers:
            convolution, norm = layers.pop(0), layers.pop(0)
            blocks = []
            while layers and isinstance(layers[0], Block):
                blocks.append(layers.pop(0))
            stage = Stage(convolution, norm, blocks, length, offset)
            self.stages.append(stage)
            length, offset = stage.length, stage.offset
        self.head = _head(network.head, length, offset)
        self._local = threading.local()

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        with torch.no_grad():
            return self._recording(len(windows)).play(windows)

    def weights(self) -> list[Tensor]:
        """Every folded weight."""
        found: list[Tensor] = []
        held: list[object] = [*self.stages, *self.head]
        while held:
            item = held.pop()
            if isinstance(item, Tensor):
                found.append(item)
            elif isinstance(item, list | tuple):
                held += item
            elif isinstance(item, Stage | Product | Star | Gate | Depthwise | Wings):
                held += vars(item).values()
        return found

    def _recording(self, batch: int) -> _Recording:
        known: dict[int, _Recording] = self._local.__dict__.setdefault("recordings", {})
        found = known.pop(batch, None)
        if found is None:
            # Buffers made in inference mode could not be written outside of it.
            with torch.inference_mode(False):
                found = _Recording(self.stages, self.head, batch)
        known[batch] = found  # the newest is the last
        while len(known) > _RECORDINGS:
            del known[next(iter(known))]
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Buffers stay behind when the network is sent to another process."""
        return {k: v for k, v in self.__dict__.items() if k != "_local"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._local = threading.local()


class _Recording:
    """The operations on a batch of one size, in order, with everything they write to."""

    def __init__(self, stages: list[Stage], head: list[Product], batch: int) -> None:
        self._operations: list[Callable[[], Any]] = []
        self._windows = torch.zeros(batch, 6, WINDOW_SAMPLES)
        padded = torch.zeros(batch, WINDOW_SAMPLES + 2, 6)
        self.do(padded[:, 1:-1].copy_, self._windows.transpose(1, 2))
        x = padded
        for stage in stages:
            x = stage.record(self, x)
        rows = x.view(batch, -1)
        for layer in head[:-1]:
            rows = layer.record(self, rows)
            self.do(torch.clamp_min, rows, 0.0, out=rows)
        self._outputs = head[-1].record(self, rows)

    def do(self, function: Callable[..., Any], *values: Any, **named: Any) -> None:
        """Append an operation."""
        self._operations.append(partial(function, *values, **named))

    def play(self, windows: Tensor) -> Tensor:
        self._windows.copy_(windows)
        for operation in self._operations:
            operation()
        return self._outputs.clone()


class Product:
    """Product of rows (N, C) with a weight (D, C), plus a bias (D,) if there is one."""

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        self.weight = _own(weight.T)
        self.bias = None if bias is None else _own(bias)

    def record(self, recording: _Recording, rows: Tensor) -> Tensor:
        """The buffer (N, D) of the result."""
        result = torch.empty(len(rows), self.weight.shape[1])
        if self.bias is None:
            recording.do(torch.mm, rows, self.weight, out=result)
        else:
            recording.do(torch.addmm, self.bias, rows, self.weight, out=result)
        return result

    def onto(self, recording: _Recording, rows: Tensor, x: Tensor) -> None:
        """Add the product to x (B, L, D)."""
        flat = x.view(-1, x.shape[2])
        recording.do(torch.addmm, flat, rows, self.weight, out=flat)


class Stage:
    """Strided convolution with its norm, and the blocks behind it.

    Args:
        convolution: of width 3.
        norm: of its output.
        blocks: at the stage's width.
        length: of the convolution's input.
        offset: (C,) what the input lacks.

    Attributes:
        length: L of the stage's output.
        offset: (C,) what the output lacks.
    """

    def __init__(
        self,
        convolution: nn.Module,
        norm: nn.Module,
        blocks: list[nn.Module],
        length: int,
        offset: Tensor,
    ) -> None:
        assert isinstance(convolution, nn.Conv1d)
        assert isinstance(norm, nn.BatchNorm1d)
        self.stride = convolution.stride[0]
        # Only the stem pads; its input lacks nothing.
        self.length = (length + 2 * int(convolution.padding[0]) - 3) // self.stride + 1
        scale, shift = affine(norm)
        weight = convolution.weight.double() * scale[:, None, None]
        bias = shift + weight.sum(2) @ offset
        self.taps = Product(weight.transpose(1, 2).flatten(1), bias)
        self.offset = torch.zeros(len(bias), dtype=torch.float64)
        self.layers: list[Star | Gate] = []
        for block in blocks:
            assert isinstance(block, Block)
            self._add(Star(block.star, self.length, self.offset))
            if block.gated is not None:
                self._add(Gate(block.gated, self.length, self.offset))

    def _add(self, layer: Star | Gate) -> None:
        self.layers.append(layer)
        self.offset = self.offset + layer.left_out

    def record(self, recording: _Recording, x: Tensor) -> Tensor:
        """The buffer (B, L, C) of the result for an input buffer, padded already."""
        taps = x.unfold(1, 3, self.stride)[:, : self.length].transpose(2, 3)
        if x.shape[1] == self.stride * self.length and self.stride == 3:
            rows = x  # the taps lie there one after the other
        else:
            rows = torch.empty(taps.shape)
            recording.do(rows.copy_, taps)
        batch = len(x)
        y = self.taps.record(recording, rows.view(batch * self.length, -1))
        y = y.view(batch, self.length, -1)
        scratch = _Scratch(y)
        for layer in self.layers:
            layer.record(recording, y, scratch)
        return y


class _Scratch:
    """Buffers that the blocks of a stage share."""

    def __init__(self, x: Tensor) -> None:
        batch, length, channels = x.shape
        inner = 2 * channels
        self.depthwise = torch.empty(batch, length, channels)
        # The star and its square lie one after the other, so that they are pooled together.
        self.powers = torch.empty(2, batch, length, inner)
        self.sums = torch.empty(2, batch, inner + length)
        self.wings = torch.empty(batch, inner + length)
        self.energy = torch.empty(batch, 1)


class Depthwise:
    """Depthwise convolution of width 3, zero-padded, with norms before and after it folded in.

    Args:
        convolution: of the channels.
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
        reach[0, 0] = reach[2, -1] = 0.0  # the padding is zero, it has no offset
        bias = bias + (reach * (taps * before[1])[:, None]).sum(0)
        taps = taps * before[0] * after[0]
        self.bias = _own(bias * after[0] + after[1])
        self.taps = [_own(tap) for tap in taps]

    def record(self, recording: _Recording, x: Tensor, y: Tensor) -> None:
        """From buffer to buffer, both (B, L, C)."""
        previous, present, following = self.taps
        recording.do(torch.addcmul, self.bias, x, present, out=y)
        _record_neighbours(recording, x, previous, following, y)


class Star:
    """DWSB and its shortcut.

    Attributes:
        left_out: (C,) bias that is missing in the result.
    """

    def __init__(self, block: DualWingStarBlock, length: int, offset: Tensor) -> None:
        before = torch.ones_like(offset), offset
        self.depthwise = Depthwise(block.depthwise, before, affine(block.norm), length)
        branches = block.branch_gate, block.branch_value
        weight = torch.cat([branch.weight.squeeze(2) for branch in branches])
        self.branches = Product(weight, torch.cat([_bias(branch) for branch in branches]))
        self.wings = Wings(block, length)
        weight = block.project.weight.squeeze(2).double() * self.wings.factor
        self.project = Product(weight)
        self.left_out = _bias(block.project).double()

    def record(self, recording: _Recording, x: Tensor, scratch: _Scratch) -> None:
        """Change x (B, L, C)."""
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

    With q the mean square, r = 1 / sqrt(q + eps), and mean m and variance v before normalising,
    the normalised star has mean r m and deviation sqrt(r^2 v + eps) = r sqrt(v + eps (q + eps)).
    The convolution is linear in r too, and the weights take up the r of the star they multiply.
    With sums s and s2 over n positions, n^2 v = n s2 - s^2; and E = L D (q + eps) is a sum. The
    `factor` sqrt(L D) by which 1 / sqrt(E) is less than r is left to fixed weights.

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
        seam[inner - 1] = 0.0  # neither wing sees the other
        self.previous = _own(taps[0][1:] * seam)
        self.present = _own(taps[1])
        self.following = _own(taps[2][:-1] * seam)

    def record(self, recording: _Recording, scratch: _Scratch) -> None:
        """From `scratch.sums` of star and square to `scratch.wings`: weights x r / factor."""
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
    """MSGCU and its shortcut.

    Attributes:
        left_out: (C,) bias that is missing in the result.
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
        self.left_out = _bias(unit.project).double()

    def record(self, recording: _Recording, x: Tensor, scratch: _Scratch) -> None:
        """Change x (B, L, C)."""
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


def _head(head: nn.Sequential, length: int, offset: Tensor) -> list[Product]:
    """Linear layers; the first reads the channels of a time step together, not the reverse."""
    first, *others = [layer for layer in head if isinstance(layer, nn.Linear)]
    weight = first.weight.double().view(len(first.weight), -1, length)
    products = [Product(weight.transpose(1, 2).flatten(1), first.bias + weight.sum(2) @ offset)]
    return products + [Product(layer.weight, layer.bias) for layer in others]


def _record_neighbours(
    recording: _Recording, x: Tensor, previous: Tensor, following: Tensor, y: Tensor
) -> None:
    """Add to y (B, N, ...) the two outer taps of a convolution of width 3 along N of x."""
    later, earlier = y[:, 1:], y[:, :-1]
    recording.do(torch.addcmul, later, x[:, :-1], previous, out=later)
    recording.do(torch.addcmul, earlier, x[:, 1:], following, out=earlier)


def _own(value: Tensor) -> Tensor:
    return value.detach().float().clone(memory_format=torch.contiguous_format)


def _bias(convolution: nn.Conv1d) -> Tensor:
    assert convolution.bias is not None
    return convolution.bias.detach()
