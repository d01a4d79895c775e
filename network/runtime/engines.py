"""What runs a network: `OnnxEngine`, below, or `TorchEngine`, in a file of its own.

ONNX Runtime runs files written by `export_onnx`, and graphs that take a weights file's tensors.
PyTorch is imported only by what needs it.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stario.network.card import Card, parse_card
from stario.sequences.errors import InputError, WeightsError
from stario.sequences.windows import WINDOW_SAMPLES

if TYPE_CHECKING:
    from stario.network.displacement import DisplacementNetwork

Float32Array = NDArray[np.float32]

Answer = tuple[Float32Array, Float32Array, Float32Array]
"""Displacement (B, 3) [m], log sigma (B, 3), and the state (2, B, H) after these windows."""

BATCH = 64
"""Number of windows that an engine computes at once."""

CARD_KEY = "stario_card"
"""Metadata key of the card, stored as JSON."""

GRAPHS = {"StarIO": "stario.onnx"}
"""Files in this folder with the graphs of networks, without weights."""


class Engine(ABC):
    """A network that is ready to run.

    Attributes:
        state_size: size H of the state (2, B, H) that a recurrent network (RNIN) carries from
            window to window; 0 of others.
    """

    state_size: int

    @property
    @abstractmethod
    def training_form(self) -> DisplacementNetwork:
        """Trainable form of the network in PyTorch, in evaluation mode.

        Raises:
            InputError: an exported graph does not contain it.
        """

    def run(self, windows: Float32Array, state: Float32Array | None = None) -> Answer:
        """Run windows (B, 6, 200), each from its own state, or from zero if `state` is None."""
        if state is None:
            state = np.zeros((2, len(windows), self.state_size), np.float32)
        starts = range(0, len(windows), BATCH)
        answers = [self._run(windows[k : k + BATCH], state[:, k : k + BATCH]) for k in starts]
        mean, log_sigma, after = zip(*answers, strict=True)
        return np.concatenate(mean), np.concatenate(log_sigma), np.concatenate(after, axis=1)

    @abstractmethod
    def _run(self, windows: Float32Array, state: Float32Array) -> Answer:
        """Run up to `BATCH` windows."""


class OnnxEngine(Engine):
    """ONNX Runtime on the CPU.

    Args:
        graph: content of an ONNX file.
        tensors: tensors of the weights, if the graph does not contain them, by name.
        architecture: name of the network that they belong to.

    Attributes:
        session: session of ONNX Runtime.

    Raises:
        Exception: ONNX Runtime's own, which have no common base: graph or tensors do not fit.
    """

    def __init__(
        self,
        graph: bytes,
        tensors: Mapping[str, NDArray[Any]] | None = None,
        architecture: str = "",
    ) -> None:
        self._graph, self._tensors, self._architecture = graph, tensors or {}, architecture
        import onnxruntime

        options = onnxruntime.SessionOptions()
        # A second thread gains little on windows this small, and waits for a busy core.
        granted = os.environ.get("OMP_NUM_THREADS", "")
        options.intra_op_num_threads = int(granted) if granted.isdecimal() else 1
        options.enable_cpu_mem_arena = False  # as fast, with 14 MB less
        options.log_severity_level = 3
        # ONNX Runtime reads them in place, so they stay. Batch norms' counters, integers, are in
        # no graph.
        self._given = {
            name: onnxruntime.OrtValue.ortvalue_from_numpy(tensor)
            for name, tensor in self._tensors.items()
            if tensor.dtype == np.float32
        }
        options.add_external_initializers(list(self._given), list(self._given.values()))
        self.session = onnxruntime.InferenceSession(
            graph, options, providers=["CPUExecutionProvider"]
        )
        shapes = {node.name: node.shape for node in self.session.get_inputs()}
        self.state_size = int(shapes["state"][2]) if "state" in shapes else 0

    def __reduce__(self) -> tuple[Any, ...]:
        """Send graph and weights to another process, which makes its own session."""
        return OnnxEngine, (self._graph, self._tensors, self._architecture)

    @cached_property
    def training_form(self) -> DisplacementNetwork:
        """As described in `Engine`; made when it is first needed."""
        if not self._architecture:
            raise InputError("model", "an exported graph", "a safetensors file of weights")
        import torch

        from stario.network.displacement import trainable

        state = {name: torch.tensor(tensor) for name, tensor in self._tensors.items()}
        return trainable(self._architecture, state)

    def _run(self, windows: Float32Array, state: Float32Array) -> Answer:
        feed = {"windows": windows, "state": state} if self.state_size else {"windows": windows}
        mean, log_sigma, *after = self.session.run(None, feed)
        return mean, log_sigma, *(after or [state])


def load_onnx(path: Path) -> tuple[OnnxEngine, Card]:
    """Load the engine and the card of an exported file.

    Args:
        path: file written by `export_onnx`.

    Raises:
        WeightsError: the file is missing, truncated, not written by `export_onnx`, or its graph was
            changed since.
    """
    if not path.is_file():
        raise WeightsError(path, "file", "no such file", "an exported model")
    try:
        engine = OnnxEngine(path.read_bytes())
    # ONNX Runtime's errors have no common base of their own.
    except Exception as error:
        import onnxruntime

        found = str(error).splitlines()[0]
        expected = f"a complete ONNX file that ONNX Runtime {onnxruntime.__version__} can read"
        raise WeightsError(path, "graph", found, expected) from error
    metadata = engine.session.get_modelmeta().custom_metadata_map
    if CARD_KEY not in metadata:
        raise WeightsError(path, CARD_KEY, "no such metadata", "a file from `stario export`")
    _check_graph(engine.session, path)
    return engine, parse_card(metadata[CARD_KEY], path)


def weights_engine(architecture: str, content: bytes) -> OnnxEngine | None:
    """Return an engine for a weights file; None if there is no graph that its tensors fit.

    Args:
        architecture: name of the network.
        content: content of the safetensors file.
    """
    if architecture not in GRAPHS:
        return None
    import safetensors.numpy

    graph = Path(__file__).with_name(GRAPHS[architecture]).read_bytes()
    try:
        return OnnxEngine(graph, safetensors.numpy.load(content), architecture)
    # Of either library: PyTorch converts other number formats, or names the tensor that is wrong.
    except Exception:
        return None


def _check_graph(session: Any, path: Path) -> None:
    """Refuse a graph converted by other tools, for example to half precision or a fixed batch."""
    nodes = {node.name: node for node in (*session.get_inputs(), *session.get_outputs())}
    for name, tail in (("windows", [6, WINDOW_SAMPLES]), ("displacement", [3]), ("log_sigma", [3])):
        expected, found = f"tensor(float) of shape {['batch', *tail]}", "none"
        if name in nodes:
            (batch, *rest), kind = nodes[name].shape, nodes[name].type
            if isinstance(batch, str) and rest == tail and kind == "tensor(float)":
                continue
            found = f"{kind} of shape {[batch, *rest]}"
        raise WeightsError(path, name, found, expected, "export the weights again")
