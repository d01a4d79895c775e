"""StarIO as an ONNX graph, with or without its weights.

It computes what `stario.network.stario` does, in the form that ONNX Runtime executes fastest on a
CPU; the outputs agree up to rounding:

- Activations are rows of channels, (B L, C): 1x1 convolutions, and strided ones whose taps do not
  overlap, become one matrix product over all windows.
- Depthwise convolutions are two-dimensional, over (B, C, 1, L): only those have kernels that
  process several channels at a time.
- A wing's convolution has `mu` and `xi` in its taps.

The graph names tensors as a file of weights does. What depends on them alone, such as transposed
weights and folded batch norms, is evaluated by ONNX Runtime once, when it loads the graph. So one
graph without weights, `stario.onnx`, serves every file of weights. After a change of the network:

    python -m stario.network.runtime.stario_graph

Shapes below: B windows, L time steps, C channels, D channels of the star operation.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper
from torch import nn

from stario.network.displacement import LOG_SIGMA_RANGE
from stario.network.runtime.engines import GRAPHS
from stario.network.stario import EPSILON, Block, StarIO
from stario.sequences.files import atomic_write
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WINDOW_SAMPLES

_OPSET, _IR_VERSION = 18, 10
"""Versions of the format: as old as the operators allow, for old runtimes."""

_ELSEWHERE = "the weights' safetensors file"
"""Location of the tensors' data; whoever loads the graph provides them."""


def stario_graph(network: StarIO, with_weights: bool = False) -> ModelProto:
    """Build the graph of `DisplacementNetwork(network)`, with its weights or without.

    It maps `windows` (batch, 6, 200) to `displacement` (batch, 3) [m] and `log_sigma` (batch, 3).
    """
    graph = _Graph({k: v.numpy() for k, v in network.state_dict().items()}, with_weights)
    gravity = np.zeros((6, 1), np.float32)
    gravity[5] = STANDARD_GRAVITY
    x = graph.op("Sub", "windows", graph.constant(gravity))
    output = _head(graph, *_trunk(graph, x, network.trunk), network.head)
    mean, log_sigma = graph.op("Split", output, graph.constant([3, 3]), axis=1, outputs=2)
    graph.op("Identity", mean, into="displacement")
    limits = (graph.constant(np.float32(limit)) for limit in LOG_SIGMA_RANGE)
    graph.op("Clip", log_sigma, *limits, into="log_sigma")
    return graph.model()


class _Graph:
    """A graph being built: each method appends nodes and returns the name of their result.

    Args:
        weights: the weights by name.
        contained: whether the graph contains them.
    """

    def __init__(self, weights: Mapping[str, NDArray[Any]], contained: bool) -> None:
        self._weights, self._contained = weights, contained
        self._nodes: list[NodeProto] = []
        self._tensors: dict[str, TensorProto] = {}

    def weight(self, name: str) -> str:
        """Refer to a tensor of the weights."""
        tensor = numpy_helper.from_array(self._weights[name], name)
        if not self._contained:
            tensor.ClearField("raw_data")
            tensor.data_location = TensorProto.EXTERNAL
            tensor.external_data.add(key="location", value=_ELSEWHERE)
        self._tensors[name] = tensor
        return name

    def constant(self, value: Any) -> str:
        """Add a constant: integers, or an array of float32."""
        array = np.asarray(value)
        name = f"constant {array.dtype} {array.tolist()}"
        self._tensors[name] = numpy_helper.from_array(array, name)
        return name

    def op(
        self, kind: str, *inputs: str, outputs: int = 1, into: str = "", **attributes: Any
    ) -> Any:
        """Append a node; return its output's name (`into`), or a list if there are several."""
        first = into or f"{kind} {len(self._nodes)}"
        names = [first, *(f"{first}.{k}" for k in range(1, outputs))]
        self._nodes.append(helper.make_node(kind, inputs, names, **attributes))
        return names if outputs > 1 else first

    def reshape(self, x: str, *shape: int) -> str:
        """Reshape x; -1 stands for what remains."""
        return str(self.op("Reshape", x, self.constant(shape)))

    def norm(self, name: str) -> tuple[str, str]:
        """Return the scale and offset (C,) of a trained batch norm."""
        variance = self.op("Add", self.weight(f"{name}.running_var"), self.epsilon())
        scale = self.op("Div", self.weight(f"{name}.weight"), self.op("Sqrt", variance))
        centre = self.op("Mul", scale, self.weight(f"{name}.running_mean"))
        return scale, self.op("Sub", self.weight(f"{name}.bias"), centre)

    def product(self, x: str, name: str) -> str:
        """Apply a linear layer or a 1x1 convolution to rows (N, C)."""
        weight, shape = self.weight(f"{name}.weight"), self._weights[f"{name}.weight"].shape
        if len(shape) == 3:
            weight = self.reshape(weight, *shape[:2])
        bias = [self.weight(f"{name}.bias")] if f"{name}.bias" in self._weights else []
        return str(self.op("Gemm", x, weight, *bias, transB=1))

    def epsilon(self) -> str:
        """Return what is added below roots and in denominators: batch norms use the same."""
        return self.constant(np.float32(EPSILON))

    def model(self) -> ModelProto:
        """Return the graph, checked, with the shapes of all results."""
        given, *results = (
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape])
            for name, shape in (
                ("windows", [6, WINDOW_SAMPLES]),
                ("displacement", [3]),
                ("log_sigma", [3]),
            )
        )
        tensors = list(self._tensors.values())
        graph = helper.make_graph(self._nodes, "StarIO", [given], results, tensors)
        opset = helper.make_opsetid("", _OPSET)
        model = helper.make_model(graph, opset_imports=[opset], ir_version=_IR_VERSION)
        # ONNX Runtime loads a graph with known shapes in half the time.
        return onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True)


def _trunk(graph: _Graph, windows: str, trunk: nn.Sequential) -> tuple[str, int, int]:
    """Return the features (B L, C) of windows (B, 6, 200), with L and C."""
    x, length, channels = windows, WINDOW_SAMPLES, 6
    for index, layer in enumerate(trunk):
        name = f"trunk.{index}"
        if isinstance(layer, nn.Conv1d):
            stem = index == 0
            x = _stem(graph, x, layer) if stem else _strided(graph, x, index, length, channels)
            padded = length + 2 * int(layer.padding[0])
            length, channels = (padded - 3) // layer.stride[0] + 1, layer.out_channels
        elif isinstance(layer, Block):
            x = _star(graph, x, f"{name}.star", length, channels)
            if layer.gated is not None:
                x = _gated(graph, x, f"{name}.gated", length, channels)
    return x, length, channels


def _stem(graph: _Graph, x: str, layer: nn.Conv1d) -> str:
    """Return rows (B L, C) of the normalised convolution of windows (B, 6, 200)."""
    scale, offset = graph.norm("trunk.1")
    weight = graph.weight("trunk.0.weight")
    weight = graph.op("Mul", weight, graph.reshape(scale, -1, 1, 1))
    x = graph.op("Conv", x, weight, offset, strides=layer.stride, pads=[1, 1])
    return graph.reshape(graph.op("Transpose", x, perm=[0, 2, 1]), -1, layer.out_channels)


def _strided(graph: _Graph, x: str, index: int, length: int, channels: int) -> str:
    """Return rows of the normalised convolution, of width and stride 3, of rows (B L, C)."""
    if length % 3:
        x = graph.reshape(x, -1, length, channels)
        end = graph.constant([length - length % 3])
        x = graph.op("Slice", x, graph.constant([0]), end, graph.constant([1]))
    scale, offset = graph.norm(f"trunk.{index + 1}")
    weight = graph.op("Transpose", graph.weight(f"trunk.{index}.weight"), perm=[2, 1, 0])
    weight = graph.op("Mul", graph.reshape(weight, 3 * channels, -1), scale)
    return str(graph.op("Gemm", graph.reshape(x, -1, 3 * channels), weight, offset))


def _star(graph: _Graph, x: str, name: str, length: int, channels: int) -> str:
    """DWSB with its residual connection, on rows (B L, C)."""
    inner = 2 * channels
    scale, offset = graph.norm(f"{name}.norm")
    rows = _depthwise(graph, x, f"{name}.depthwise", length, channels, scale, offset)
    rows = graph.reshape(rows, -1, channels)
    gate, value = (graph.product(rows, f"{name}.branch_{branch}") for branch in ("gate", "value"))
    gate = graph.op("Clip", gate, *(graph.constant(np.float32(limit)) for limit in (0.0, 6.0)))
    star = graph.reshape(graph.op("Mul", gate, value), -1, length, inner)
    star = _rms_normalised(graph, star)
    square = graph.op("Mul", star, star)
    of_channel = _wing(graph, star, square, f"{name}.channel_wing", axis=1)
    of_time = _wing(graph, star, square, f"{name}.time_wing", axis=2)
    weighted = graph.op("Mul", star, graph.op("Add", of_channel, of_time))
    mixed = graph.product(graph.reshape(weighted, -1, inner), f"{name}.project")
    return str(graph.op("Add", mixed, x))


def _wing(graph: _Graph, star: str, square: str, name: str, axis: int) -> str:
    """Return the weights of a wing, which pools (B, L, D) over `axis`, to multiply with (B, L, D).

    Its convolution takes pooled mean and deviation as two channels.
    """
    mean, mean_square = (
        graph.op("ReduceMean", x, graph.constant([axis]), keepdims=0) for x in (star, square)
    )
    variance = graph.op("Sub", mean_square, graph.op("Mul", mean, mean))
    variance = graph.op("Max", variance, graph.constant(np.float32(0.0)))
    deviation = graph.op("Sqrt", graph.op("Add", variance, graph.epsilon()))
    pooled = graph.reshape(graph.op("Concat", mean, deviation, axis=1), 0, 2, -1)
    mix = graph.op("Concat", graph.weight(f"{name}.mu"), graph.weight(f"{name}.xi"), axis=0)
    taps = graph.op("Mul", graph.weight(f"{name}.convolution.weight"), graph.reshape(mix, 1, 2, 1))
    weights = graph.op("Sigmoid", graph.op("Conv", pooled, taps, pads=[1, 1]))
    return str(weights) if axis == 1 else graph.reshape(weights, 0, -1, 1)


def _gated(graph: _Graph, x: str, name: str, length: int, channels: int) -> str:
    """MSGCU with its residual connection, on rows (B L, C)."""
    scale, offset = graph.norm(f"{name}.norm")
    y = graph.reshape(x, -1, length, channels)
    y = graph.op("Add", graph.op("Mul", y, scale), offset)
    mean = graph.op("ReduceMean", y, graph.constant([1]), keepdims=0)
    gate = graph.product(graph.op("Relu", graph.product(mean, f"{name}.squeeze")), f"{name}.excite")
    gate = graph.reshape(graph.op("Softmax", gate, axis=1), -1, 1, channels)
    value = _depthwise(graph, y, f"{name}.value", length, channels)
    gated = _rms_normalised(graph, graph.op("Mul", value, gate))
    projected = graph.product(graph.reshape(gated, -1, channels), f"{name}.project")
    return str(graph.op("Add", projected, x))


def _depthwise(
    graph: _Graph, x: str, name: str, length: int, channels: int, scale: str = "", offset: str = ""
) -> str:
    """Return the depthwise convolution (B, L, C) of x, followed by a norm if one is given."""
    weight = graph.reshape(graph.weight(f"{name}.weight"), channels, 1, 1, 3)
    if scale:
        weight = graph.op("Mul", weight, graph.reshape(scale, -1, 1, 1, 1))
    x = graph.op("Transpose", graph.reshape(x, -1, 1, length, channels), perm=[0, 3, 1, 2])
    bias = offset or graph.weight(f"{name}.bias")
    y = graph.op("Conv", x, weight, bias, pads=[0, 1, 0, 1], group=channels)
    return graph.reshape(graph.op("Transpose", y, perm=[0, 2, 3, 1]), -1, length, channels)


def _rms_normalised(graph: _Graph, x: str) -> str:
    square = graph.op("ReduceMean", graph.op("Mul", x, x), graph.constant([1, 2]))
    return str(graph.op("Div", x, graph.op("Sqrt", graph.op("Add", square, graph.epsilon()))))


def _head(graph: _Graph, x: str, length: int, channels: int, head: nn.Sequential) -> str:
    """Return the output (B, 6) for features (B L, C)."""
    x = graph.op("Transpose", graph.reshape(x, -1, length, channels), perm=[0, 2, 1])
    x = graph.reshape(x, -1, channels * length)
    for index, layer in enumerate(head):
        if isinstance(layer, nn.Linear):
            x = graph.product(x, f"head.{index}")
        elif isinstance(layer, nn.ReLU):
            x = graph.op("Relu", x)
    return x


if __name__ == "__main__":
    with atomic_write(Path(__file__).with_name(GRAPHS["StarIO"]), "wb") as file:
        file.write(stario_graph(StarIO()).SerializeToString(deterministic=True))
