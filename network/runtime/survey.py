"""Comparison of all networks: counts, time and memory of an inference on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.weak import WeakIdKeyDictionary

from stario.network.architectures import ARCHITECTURES, architecture, build_network
from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.engines import Engine, weights_engine
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.windows import WINDOW_SAMPLES

BATCHES = (1, 64)

_WARM_UP = 3

_RUNS = {1: 60, 64: 10}

_WORDS = """\
parameters, FLOPs: with two outputs per head, in millions; the paper's figure in parentheses. \
FLOPs are the multiplications of convolutions and linear layers for one window; the paper's also \
count norms and pooling.
torch 1 to onnx 64: median time per window [ms] in batches of 1 and 64, with random weights, in \
turn with all other networks; {threads} threads in PyTorch, one in ONNX Runtime.
peak MB: weights, and results of PyTorch's operations in the inference of one window; memory that \
libraries take within an operation is not counted."""


@dataclass(frozen=True)
class ModelRow:
    """Figures of one network.

    Attributes:
        name: name of the architecture.
        parameters: number of parameters with two outputs per head, as in the paper's table.
        flops: multiplications in convolutions and linear layers, with the same outputs.
        milliseconds: time per window [ms], by engine and batch size, with six outputs; None if
            ONNX Runtime has no graph of the network.
        peak_memory_mb: peak memory of an inference of one window in PyTorch [10^6 bytes].
    """

    name: str
    parameters: int
    flops: int
    milliseconds: dict[str, dict[str, float] | None]
    peak_memory_mb: float

    def counts(self) -> list[str]:
        """Return parameters and FLOPs in millions, with the paper's figures in parentheses."""
        published = ARCHITECTURES[self.name]
        pairs = (self.parameters, published.parameters), (self.flops, published.flops)
        return [f"{count / 1e6:.3f} ({in_paper:.3f})" for count, in_paper in pairs]


def table_counts(name: str) -> tuple[int, int]:
    """Return the parameters and FLOPs of a network, as `ModelRow` has them.

    Raises:
        InputError: no network has that name.
    """
    outputs = architecture(name).table_outputs
    with torch.device("meta"), FlopCounterMode(display=False) as counter:
        network = build_network(name, outputs).eval()
        network(torch.zeros(1, 6, WINDOW_SAMPLES))
    return sum(p.numel() for p in network.parameters()), counter.get_total_flops() // 2


def survey(names: Sequence[str]) -> list[ModelRow]:
    """Count the parameters and FLOPs of networks and measure their time and memory.

    Raises:
        InputError: a name is unknown.
    """
    torch.manual_seed(0)
    networks = [DisplacementNetwork(build_network(name)) for name in names]
    in_torch = _times([TorchEngine(network) for network in networks])
    states = [safetensors.torch.save(network.network.state_dict()) for network in networks]
    graphs = [weights_engine(*pair) for pair in zip(names, states, strict=True)]
    in_onnx = iter(_times([engine for engine in graphs if engine is not None]))
    return [
        ModelRow(
            name,
            *table_counts(name),
            {"torch": times, "onnxruntime": None if graph is None else next(in_onnx)},
            peak_bytes(network) / 1e6,
        )
        for name, network, times, graph in zip(names, networks, in_torch, graphs, strict=True)
    ]


def survey_table(rows: Sequence[ModelRow]) -> str:
    """Return the rows as a text table, with the paper's figures in parentheses."""
    table = [["", "parameters (paper)", "FLOPs (paper)"]]
    table[0] += ["torch 1", "torch 64", "onnx 1", "onnx 64", "peak MB"]
    for row in rows:
        found = (row.milliseconds[name] or {} for name in ("torch", "onnxruntime"))
        times = [figure(each.get(str(batch))) for each in found for batch in BATCHES]
        table.append([row.name, *row.counts(), *times, f"{row.peak_memory_mb:.1f}"])
    return "\n".join([*aligned(table), _WORDS.format(threads=torch.get_num_threads())])


def _times(engines: Sequence[Engine]) -> list[dict[str, float]]:
    """Return the time per window [ms] of each engine by batch size."""
    columns = [median_milliseconds(engines, batch, _RUNS[batch]).tolist() for batch in BATCHES]
    return [dict(zip(map(str, BATCHES), row, strict=True)) for row in zip(*columns, strict=True)]


def random_windows(batch: int) -> NDArray[np.float32]:
    """Return windows (batch, 6, 200) of noise about gravity."""
    windows = np.random.default_rng(0).standard_normal((batch, 6, WINDOW_SAMPLES))
    windows[:, 5] += STANDARD_GRAVITY
    return windows.astype(np.float32)


def median_milliseconds(engines: Sequence[Engine], batch: int, runs: int) -> FloatArray:
    """Return the median time per window (engines,) [ms].

    Every run calls all engines in turn, so that all are timed under the same load; a few runs
    before them are not timed.
    """
    windows = random_windows(batch)
    seconds = np.zeros((_WARM_UP + runs, len(engines)))
    for row in seconds:
        for column, engine in enumerate(engines):
            began = perf_counter()
            engine.run(windows)
            row[column] = perf_counter() - began
    return np.asarray(np.median(1e3 / batch * seconds[_WARM_UP:], axis=0))


def peak_bytes(network: torch.nn.Module) -> int:
    """Return the size of the weights and the most that the results for one window take at once."""
    weights = [*network.parameters(), *network.buffers()]
    results = _LivingResults()
    with torch.no_grad(), results:
        network(torch.zeros(1, 6, WINDOW_SAMPLES))
    return results.peak + sum(tensor.nbytes for tensor in weights)


class _LivingResults(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """The storages that operations have made and nothing has freed."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._sizes: Any = WeakIdKeyDictionary()
        self.peak: int = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        given = [storage._cdata for storage in _storages((args, kwargs))]  # seen by views
        self._sizes |= {s: s.nbytes() for s in _storages(result) if s._cdata not in given}
        self.peak = max(self.peak, sum(self._sizes.values()))
        return result


def _storages(tree: Any) -> list[torch.UntypedStorage]:
    return [t.untyped_storage() for t in tree_leaves(tree) if isinstance(t, torch.Tensor)]
