"""Comparison of all networks: counts, time and memory of an inference on this machine."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from stario.network.architectures import ARCHITECTURES, architecture, build_network
from stario.network.card import Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import DisplacementModel
from stario.network.runtime.cost import table_cost
from stario.network.runtime.engines import Engine, TorchEngine
from stario.network.runtime.inference import inference_form
from stario.network.runtime.memory import peak_bytes
from stario.network.runtime.timing import seconds_in_turn
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WINDOW_SAMPLES

BATCHES = (1, 64)

_RUNS = {1: 60, 64: 10}

_SEED = 0

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

    def as_dict(self) -> dict[str, object]:
        """Return the row as plain values."""
        return dict(vars(self))


def measured() -> dict[str, str]:
    """Return a description of how each column is obtained."""
    threads = torch.get_num_threads()
    return {
        "parameters": "those of modules covered by the rules of the paper's table, two outputs per "
        "head (stario.network.runtime.cost); here in millions, the paper's figure in parentheses",
        "flops": "by the same rules, for one window; in millions, likewise",
        "numel": "number of elements of all parameters of the same network; in millions",
        "milliseconds": "per window with six outputs, in the inference form, with random weights: "
        "median over calls in turn with all other networks, "
        + ", ".join(f"{runs} calls at batch {batch}" for batch, runs in _RUNS.items())
        + f"; {threads} threads in PyTorch and in ONNX Runtime",
        "peak_memory_mb": "weights of the inference form, and the peak size of the results of "
        "PyTorch's operations in the first inference of one window; memory that libraries take "
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
        cache: folder that keeps exported graphs, each of which takes up to half a minute to make;
            None skips ONNX Runtime.
        progress: called with the fraction of the work done.

    Raises:
        InputError: a name is unknown.
    """
    entries = [architecture(name) for name in names]
    models = [_model(name) for name in names]
    engines: dict[str, list[Engine] | None] = {
        "torch": [TorchEngine(model.training_form) for model in models],
        "onnxruntime": None,
    }
    if cache is not None and all(
        importlib.util.find_spec(name) for name in ("onnx", "onnxruntime", "onnxscript")
    ):
        graphs: list[Engine] = []
        for done, model in enumerate(models, 1):
            graphs.append(_graph_engine(model, cache))
            progress(0.6 * done / len(models))
        engines["onnxruntime"] = graphs
    times = {name: _times(group) if group else None for name, group in engines.items()}
    progress(0.9)
    rows = []
    for column, (name, entry, model) in enumerate(zip(names, entries, models, strict=True)):
        counted, whole = table_cost(name), build_network(name, entry.table_outputs)
        rows.append(
            ModelRow(
                name=name,
                parameters=counted.parameters,
                flops=counted.flops,
                numel=sum(p.numel() for p in whole.parameters()),
                milliseconds={
                    engine: None if found is None else {b: row[column] for b, row in found.items()}
                    for engine, found in times.items()
                },
                peak_memory_mb=_peak_memory(model.training_form) / 1e6,
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
        published = ARCHITECTURES[row.name]
        cells = [
            f"{row.parameters / 1e6:.3f} ({published.parameters:.3f})",
            f"{row.flops / 1e6:.3f} ({published.flops:.3f})",
            f"{row.numel / 1e6:.3f}",
        ]
        for engine in ("torch", "onnxruntime"):
            found = row.milliseconds[engine]
            cells += [figure(None if found is None else found[str(b)]) for b in BATCHES]
        table.append([row.name, *cells, f"{row.peak_memory_mb:.1f}"])
    return "\n".join([*aligned(table), *(f"{name}: {text}." for name, text in measured().items())])


def _model(name: str) -> DisplacementModel:
    torch.manual_seed(_SEED)
    network = DisplacementNetwork(build_network(name))
    return DisplacementModel(TorchEngine(network), Card(name))


def _graph_engine(model: DisplacementModel, cache: Path) -> Engine:
    """Return the exported graph, from the cache if the code that makes it is unchanged."""
    from stario.network.runtime.export import export_onnx
    from stario.network.runtime.onnx_file import load_onnx

    sources = b"".join(
        path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py"))
    )
    key = hashlib.sha256(sources + f"{torch.__version__} {model.name}".encode()).hexdigest()
    path = cache / f"graph-{key[:16]}.onnx"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        export_onnx(model, path)
    return load_onnx(path)[0]


def _times(engines: Sequence[Engine]) -> dict[str, list[float]]:
    """Return the time per window [ms] of each engine, by batch size."""
    generator = np.random.default_rng(_SEED)
    result = {}
    for batch in BATCHES:
        windows = generator.standard_normal((batch, 6, WINDOW_SAMPLES)).astype(np.float32)
        windows[:, 5] += STANDARD_GRAVITY
        calls = [partial(engine.run, windows) for engine in engines]
        medians = np.median(seconds_in_turn(calls, _RUNS[batch]), axis=0)
        result[str(batch)] = (1e3 / batch * medians).tolist()
    return result


def _peak_memory(network: DisplacementNetwork) -> int:
    form = inference_form(network)
    window = torch.zeros(1, 6, WINDOW_SAMPLES)

    return _weights(form) + peak_bytes(lambda: form(window))


def _weights(form: nn.Module) -> int:
    """Return the bytes of parameters and buffers, including the folded weights of `FastStarIO`."""
    from stario.network.runtime.fast_stario import FastStarIO

    known = [*form.parameters(), *form.buffers()]
    for module in form.modules():
        if isinstance(module, FastStarIO):
            known += module.weights()
    return sum(t.numel() * t.element_size() for t in known)
