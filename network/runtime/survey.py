"""Comparison of all networks: counts, time and memory of an inference on this machine."""

from __future__ import annotations

import hashlib
import importlib.util
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from stario.network.architectures import ARCHITECTURES, architecture, build_network
from stario.network.card import Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import DisplacementModel
from stario.network.runtime.cost import cost
from stario.network.runtime.engines import Engine
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.windows import WINDOW_SAMPLES

BATCHES = (1, 64)

_WARM_UP = 3

_RUNS = {1: 60, 64: 10}

Milliseconds = dict[str, dict[str, float] | None]


@dataclass(frozen=True)
class ModelRow:
    """Figures of one network.

    Attributes:
        name: name of the architecture.
        parameters: parameters by the convention of the paper's table, with two outputs per head.
        flops: FLOPs by the same convention and with the same outputs.
        numel: number of elements of all parameters, with two outputs per head.
        milliseconds: time per window [ms], by engine and batch size, with six outputs; None if the
            engine is not installed.
        peak_memory_mb: peak memory of an inference of one window in PyTorch [10^6 bytes].
    """

    name: str
    parameters: int
    flops: int
    numel: int
    milliseconds: Milliseconds
    peak_memory_mb: float

    def counts(self) -> list[str]:
        """Return parameters and FLOPs in millions, with the paper's figures in parentheses."""
        published = ARCHITECTURES[self.name]
        pairs = (self.parameters, published.parameters), (self.flops, published.flops)
        return [f"{count / 1e6:.3f} ({in_paper:.3f})" for count, in_paper in pairs]


def measured() -> dict[str, str]:
    """Return a description of how each column is obtained."""
    threads = torch.get_num_threads()
    return {
        "parameters": "those of modules covered by the rules of the paper's table, two outputs per "
        "head (stario.network.runtime.cost); here in millions, the paper's figure in parentheses",
        "flops": "by the same rules, for one window; in millions, likewise",
        "numel": "number of elements of all parameters of the same network; in millions",
        "milliseconds": "per window with six outputs, with random weights: "
        "median over calls in turn with all other networks, "
        + ", ".join(f"{runs} calls at batch {batch}" for batch, runs in _RUNS.items())
        + f"; {threads} threads in PyTorch, one in ONNX Runtime",
        "peak_memory_mb": "weights, and the peak size of the results of "
        "PyTorch's operations in the inference of one window; memory that libraries take "
        "within an operation is not counted",
    }


def survey(
    names: Sequence[str],
    cache: Path | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> list[ModelRow]:
    """Count the parameters and FLOPs of networks and measure their time and memory.

    Args:
        names: names of architectures.
        cache: folder that keeps exported graphs, as tracing takes up to half a minute; None skips
            ONNX Runtime.
        progress: called with the fraction of the work done.

    Raises:
        InputError: a name is unknown.
    """
    engines: list[Engine] = [_engine(name) for name in names]
    times = {"torch": _times(engines), "onnxruntime": None}
    if cache is not None and all(importlib.util.find_spec(name) for name in ("onnx", "onnxscript")):
        graphs: list[Engine] = []
        for name, engine in zip(names, engines, strict=True):
            graphs.append(_graph_engine(name, engine, cache))
            progress(0.6 * len(graphs) / len(names))
        times["onnxruntime"] = _times(graphs)
    progress(0.9)
    rows = []
    for column, (name, engine) in enumerate(zip(names, engines, strict=True)):
        whole = build_network(name, architecture(name).table_outputs)
        counted = cost(whole)
        rows.append(
            ModelRow(
                name=name,
                parameters=counted.parameters,
                flops=counted.flops,
                numel=sum(p.numel() for p in whole.parameters()),
                milliseconds={
                    runtime: None if found is None else {b: row[column] for b, row in found.items()}
                    for runtime, found in times.items()
                },
                peak_memory_mb=_peak_memory(engine.training_form) / 1e6,
            )
        )
    progress(1.0)
    return rows


def survey_table(rows: Sequence[ModelRow]) -> str:
    """Return the rows as a text table, with the paper's figures in parentheses."""
    columns = "parameters (paper),FLOPs (paper),numel,torch 1,torch 64,onnx 1,onnx 64,peak MB"
    titles = columns.split(",")
    table = [["", *titles]]
    for row in rows:
        cells = [*row.counts(), f"{row.numel / 1e6:.3f}"]
        for engine in ("torch", "onnxruntime"):
            found = row.milliseconds[engine]
            cells += [figure(None if found is None else found[str(b)]) for b in BATCHES]
        table.append([row.name, *cells, f"{row.peak_memory_mb:.1f}"])
    return "\n".join([*aligned(table), *(f"{name}: {text}." for name, text in measured().items())])


def _engine(name: str) -> TorchEngine:
    torch.manual_seed(0)
    return TorchEngine(DisplacementNetwork(build_network(name)))


def _graph_engine(name: str, engine: Engine, cache: Path) -> Engine:
    """Return the exported graph, from the cache if the code that makes it is unchanged."""
    from stario.network.runtime.export import export_onnx
    from stario.network.runtime.onnx_engine import load_onnx

    sources = b"".join(
        path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py"))
    )
    key = hashlib.sha256(sources + f"{torch.__version__} {name}".encode()).hexdigest()
    path = cache / f"graph-{key[:16]}.onnx"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        export_onnx(DisplacementModel(engine, Card(name)), path)
    return load_onnx(path)[0]


def _times(engines: Sequence[Engine]) -> dict[str, list[float]]:
    """Return the time per window [ms] of each engine, by batch size."""
    return {
        str(batch): median_milliseconds(engines, batch, _RUNS[batch]).tolist() for batch in BATCHES
    }


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


def _peak_memory(network: DisplacementNetwork) -> int:
    known = [*network.parameters(), *network.buffers()]
    weights = sum(t.numel() * t.element_size() for t in known)
    window = torch.zeros(1, 6, WINDOW_SAMPLES)
    return weights + peak_bytes(lambda: network(window))


def peak_bytes(work: Callable[[], object]) -> int:
    """Return the peak memory [bytes] of operations' results, in addition to existing tensors.

    Memory that an operation takes and frees internally, such as a packed copy of its weights, is
    not counted.
    """
    counter = _Counter()
    with torch.no_grad(), counter:
        work()
    return counter.peak


def _storages(tree: Any) -> list[torch.UntypedStorage]:
    return [t.untyped_storage() for t in tree_leaves(tree) if isinstance(t, torch.Tensor)]


class _Counter(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counter of the bytes of all new tensors' storages that have not been freed."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.current: int = 0
        self.peak: int = 0
        self._alive: set[int] = set()

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        existing = [storage._cdata for storage in _storages((args, kwargs))]  # seen by views
        for storage in _storages(result):
            if storage._cdata not in existing:
                self._add(storage)
        return result

    def _add(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key not in self._alive:
            self._alive.add(key)
            self.current += size
            self.peak = max(self.peak, self.current)
            weakref.finalize(storage, self._remove, key, size)

    def _remove(self, key: int, size: int) -> None:
        self._alive.discard(key)
        self.current -= size
