"""Cost of a network by the convention of the paper's table.

The table's figures come from a counter that covers a few kinds of modules and ignores operations
between them: the rules below, for one window, in evaluation mode. In a convolution, a
multiplication and its addition count as one, and the bias does not count; parameters count if
their module has a rule.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from stario.network.architectures import architecture, build_network
from stario.sequences.windows import WINDOW_SAMPLES


@dataclass(frozen=True)
class Cost:
    """Counts for one window.

    Attributes:
        parameters: parameters of modules that have a rule.
        flops: FLOPs by the rules.
    """

    parameters: int
    flops: int


def table_cost(name: str) -> Cost:
    """Count an architecture with the outputs that the paper's table counts.

    Raises:
        InputError: no network has that name.
    """
    return cost(build_network(name, architecture(name).table_outputs))


def cost(network: nn.Module) -> Cost:
    """Count a network that maps (B, 6, 200) to (B, outputs); it is left in evaluation mode."""
    flops = 0
    counted: dict[nn.Module, int] = {}

    def count(module: nn.Module, inputs: tuple[Any, ...], output: Any) -> None:
        nonlocal flops
        rule = _RULES.get(type(module))
        if rule is not None:
            flops += rule(module, inputs[0], output)
            counted[module] = sum(p.numel() for p in module.parameters())

    hooks = [m.register_forward_hook(count) for m in network.modules()]
    try:
        with torch.inference_mode():
            network.eval()(torch.zeros(1, 6, WINDOW_SAMPLES))
    finally:
        for hook in hooks:
            hook.remove()
    return Cost(sum(counted.values()), flops)


def _lstm(module: nn.LSTM, x: Tensor, y: Any) -> int:
    hidden = module.hidden_size
    steps = x.shape[0] * x.shape[1]
    inputs = [module.input_size, *[hidden] * (module.num_layers - 1)]
    return steps * sum(4 * ((n + hidden) * hidden + 3 * hidden) + 4 * hidden for n in inputs)


_RULES: dict[type[nn.Module], Callable[..., int]] = {
    nn.Conv1d: lambda m, x, y: y.numel() * (m.in_channels // m.groups) * m.kernel_size[0],
    nn.Linear: lambda m, x, y: m.in_features * y.numel(),
    nn.BatchNorm1d: lambda m, x, y: 4 * x.numel(),
    nn.AdaptiveAvgPool1d: lambda m, x, y: y.numel() * (x.shape[2] // y.shape[2] + 1),
    nn.LSTM: _lstm,
}
"""FLOPs of a module m from its input x and output y."""
