"""StarIO for inference on a CPU: the same outputs from a recording of in-place operations.

These steps make it fast; each is exact up to rounding:

- Activations are rows of channels, (B, L, C): 1x1 convolutions, and strided ones whose taps do not
  overlap, become matrix products. The two branches of the star operation are one product.
- Trained batch norms are affine and are folded into the adjacent convolution. If a norm precedes
  zero padding, the padded taps lack its offset, so that a depthwise convolution gets a bias per
  position and channel.
- Biases of the blocks' last convolutions only shift the residual stream by a constant. The
  constant is omitted and added to the biases of the layers that read the stream.
- The root mean square of a window is one number, and the operations after it are linear in it, so
  it scales pooled vectors instead of the large tensors. Sums replace means, with the counts folded
  into weights.
- Both wings share one vector; taps per position keep their convolutions separate.
- A single window takes a few hundred operations of about a microsecond each, less than allocating
  their memory takes: they are recorded once per batch size, with buffers and views.

Shapes below: B windows, L time steps, C channels, D channels of the star operation.
"""

from __future__ import annotations

import threading
from typing import Any

import torch
from torch import Tensor, nn

from stario.network.runtime.folded_layers import (
    Depthwise,
    Gate,
    Product,
    Recording,
    Scratch,
    Star,
    Wings,
    affine,
)
from stario.network.stario import Block, StarIO
from stario.sequences.windows import WINDOW_SAMPLES

_RECORDINGS = 4
"""Number of batch sizes whose buffers are kept, per thread."""


class FastStarIO(nn.Module):
    """StarIO in evaluation mode: maps (B, 6, 200) to (B, outputs), without gradients.

    Args:
        network: network whose weights are copied; later changes do not affect the copy.
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
        """Map (B, 6, 200) to (B, outputs)."""
        with torch.no_grad():
            return self._recording(len(windows)).play(windows)

    def weights(self) -> list[Tensor]:
        """Return all folded weights."""
        found: list[Tensor] = []
        pending: list[object] = [*self.stages, *self.head]
        while pending:
            item = pending.pop()
            if isinstance(item, Tensor):
                found.append(item)
            elif isinstance(item, list | tuple):
                pending += item
            elif isinstance(item, Stage | Product | Star | Gate | Depthwise | Wings):
                pending += vars(item).values()
        return found

    def _recording(self, batch: int) -> _Batch:
        known: dict[int, _Batch] = self._local.__dict__.setdefault("recordings", {})
        found = known.pop(batch, None)
        if found is None:
            # Buffers made in inference mode could not be written outside it.
            with torch.inference_mode(False):
                found = _Batch(self.stages, self.head, batch)
        known[batch] = found  # the most recent is last
        while len(known) > _RECORDINGS:
            del known[next(iter(known))]
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Exclude buffers when the network is sent to another process."""
        return {k: v for k, v in self.__dict__.items() if k != "_local"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._local = threading.local()


class _Batch(Recording):
    """Recorded operations for one batch size."""

    def __init__(self, stages: list[Stage], head: list[Product], batch: int) -> None:
        super().__init__()
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

    def play(self, windows: Tensor) -> Tensor:
        self._windows.copy_(windows)
        for operation in self.operations:
            operation()
        return self._outputs.clone()


class Stage:
    """Strided convolution with its norm, and the blocks after it.

    Args:
        convolution: convolution of width 3.
        norm: norm of its output.
        blocks: blocks at the stage's width.
        length: length of the convolution's input.
        offset: (C,) constant omitted from the input.

    Attributes:
        length: L of the stage's output.
        offset: (C,) constant omitted from the output.
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
        # Only the stem pads, and nothing is omitted from its input.
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
        self.offset = self.offset + layer.omitted_bias

    def record(self, recording: Recording, x: Tensor) -> Tensor:
        """Record the stage on a buffer that is already padded; return the result's (B, L, C)."""
        taps = x.unfold(1, 3, self.stride)[:, : self.length].transpose(2, 3)
        if x.shape[1] == self.stride * self.length and self.stride == 3:
            rows = x  # the taps are already contiguous
        else:
            rows = torch.empty(taps.shape)
            recording.do(rows.copy_, taps)
        batch = len(x)
        y = self.taps.record(recording, rows.view(batch * self.length, -1))
        y = y.view(batch, self.length, -1)
        scratch = Scratch(y)
        for layer in self.layers:
            layer.record(recording, y, scratch)
        return y


def _head(head: nn.Sequential, length: int, offset: Tensor) -> list[Product]:
    """Return the linear layers, the first reordered for inputs (L, C) instead of (C, L)."""
    first, *others = [layer for layer in head if isinstance(layer, nn.Linear)]
    weight = first.weight.double().view(len(first.weight), -1, length)
    products = [Product(weight.transpose(1, 2).flatten(1), first.bias + weight.sum(2) @ offset)]
    return products + [Product(layer.weight, layer.bias) for layer in others]
