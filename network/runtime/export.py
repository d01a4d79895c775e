"""Export to ONNX, and models that ONNX Runtime computes from such files.

The graph takes `windows` (batch, 6, 200) as `DisplacementModel.predict` does, and gives
`displacement` (batch, 3) [m] and `log_sigma` (batch, 3); that of a network which remembers takes
`state` (2, batch, H) and gives `next_state` besides. Its metadata hold the card: window, rate,
frame, units and the calibration of the covariance.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from stario.network.card import Card, dump_card, parse_card
from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.engines import OnnxEngine
from stario.network.runtime.graph_form import graph_form
from stario.sequences.errors import InputError, WeightsError
from stario.sequences.files import atomic_write
from stario.sequences.windows import WINDOW_SAMPLES

if TYPE_CHECKING:
    from stario.network.model import DisplacementModel

CARD_KEY = "stario_card"
"""Of the metadata that holds the card as JSON."""

_UNITS = {
    "windows": "rows gyro xyz [rad/s], accel xyz (specific force) [m/s^2]; 200 samples at 200 Hz",
    "displacement": "xyz [m] over the window, in its frame",
    "log_sigma": "xyz, natural logarithm of [m], before the calibration on the card",
    "frame": "gravity-aligned, z up, yaw arbitrary",
}


def export_onnx(model: DisplacementModel, path: Path) -> None:
    """Write a model as ONNX file with a dynamic batch.

    Args:
        model: with weights that PyTorch computes.
        path: of the file, in an existing folder.

    Raises:
        InputError: the extra `onnx` is not installed, the model is an exported graph itself, or
            the folder does not exist.
    """
    _needed("onnx", "onnxscript")
    network = graph_form(model.training_form)
    with _quiet():
        program = torch.onnx.export(
            _Step(network) if network.remembers else network,
            _examples(network),
            dynamo=True,
            external_data=False,
            verbose=False,
            input_names=["windows", "state"][: 1 + network.remembers],
            output_names=["displacement", "log_sigma", "next_state"][: 2 + network.remembers],
            dynamic_shapes=_shapes(network),
        )
    assert program is not None
    graph = program.model_proto
    for key, text in {**_UNITS, CARD_KEY: dump_card(model.card)}.items():
        graph.metadata_props.add(key=key, value=text)
    with atomic_write(path, "wb") as file:
        file.write(graph.SerializeToString())


def load_onnx(path: Path) -> tuple[OnnxEngine, Card]:
    """The engine and the card of an exported file, on as many threads as PyTorch uses.

    Args:
        path: written by `export_onnx`.

    Raises:
        InputError: the extra `onnx` is not installed.
        WeightsError: the file is missing, cut short, or no file of `export_onnx`.
    """
    runtime = _needed("onnxruntime")
    if not path.is_file():
        raise WeightsError(path, "file", "nothing there", "an exported model")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    try:
        session = runtime.InferenceSession(
            path.read_bytes(), options, providers=["CPUExecutionProvider"]
        )
    # ONNX Runtime's errors have no common base of their own.
    except Exception as error:
        found = str(error).splitlines()[0]
        raise WeightsError(path, "graph", found, "a whole ONNX file") from error
    metadata = session.get_modelmeta().custom_metadata_map
    if CARD_KEY not in metadata:
        raise WeightsError(path, CARD_KEY, "no such metadata", "a file of `stario export`")
    return OnnxEngine(session), parse_card(metadata[CARD_KEY], path)


class _Step(nn.Module):
    """A network that remembers, with its state as input and output."""

    def __init__(self, network: DisplacementNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, windows: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.network.step(windows, state)


def _examples(network: DisplacementNetwork) -> tuple[Tensor, ...]:
    windows = torch.zeros(2, 6, WINDOW_SAMPLES)
    return (windows, network.first_state(2)) if network.remembers else (windows,)


def _shapes(network: DisplacementNetwork) -> tuple[dict[int, Any], ...]:
    batch = torch.export.Dim("batch")
    return ({0: batch}, {1: batch}) if network.remembers else ({0: batch},)


def _needed(*names: str) -> Any:
    """The last of some packages of the extra `onnx`."""
    import importlib

    module = None
    for name in names:
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            raise InputError(
                name, "not installed", "the extra `onnx`", "pip install 'stario[onnx]'"
            ) from error
    return module


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter warns of its own parts, and of packages that are not needed here."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
