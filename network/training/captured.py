"""A training step recorded once on a GPU and replayed as a whole.

These networks have thousands of small kernels, and launching them one by one takes longer than
they run. A CUDA graph launches all of a step at once. It works on fixed memory: a step's inputs are
copied to where the recorded step reads them.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_UNRECORDED = 3
"""Steps before the recording, which let libraries choose their kernels and allocate memory."""


class CapturedStep:
    """A step that is recorded for inputs of fixed shapes.

    Args:
        step: function of a list of tensors on a GPU, and of a flag on which its operations depend;
            it changes the weights and returns a tensor, never waiting for the GPU.
    """

    def __init__(self, step: Callable[[list[Tensor], bool], Tensor]) -> None:
        self._step = step
        self._stage: object = None
        self._left = _UNRECORDED
        self._inputs: list[Tensor] = []
        self._result = torch.empty(0)
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, inputs: list[Tensor], flag: bool) -> Tensor:
        """Take a step, recorded anew when the flag or a shape changes."""
        stage = flag, [part.shape for part in inputs]
        if stage != self._stage:
            self._stage, self._left, self._graph = stage, _UNRECORDED, None
        if self._left:
            self._left -= 1
            return self._aside(inputs, flag)
        if self._graph is None:
            self._inputs = [part.clone() for part in inputs]
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._result = self._step(self._inputs, flag)
        for own, new in zip(self._inputs, inputs, strict=True):
            own.copy_(new)
        self._graph.replay()
        return self._result

    def _aside(self, inputs: list[Tensor], flag: bool) -> Tensor:
        """Take a step on another stream, as a recording demands of the steps before it."""
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            result = self._step(inputs, flag)
        torch.cuda.current_stream().wait_stream(stream)
        return result
