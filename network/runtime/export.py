"""Export to ONNX; `engines` loads the files.

The graph maps `windows` (batch, 6, 200), as in `DisplacementModel.predict`, to `displacement`
(batch, 3) [m] and `log_sigma` (batch, 3); that of a recurrent network also takes `state`
(2, batch, H) and returns `next_state`. Its metadata hold the card: window, rate, frame, units and
the calibration of the covariance. StarIO's graph is that of `stario_graph`, others are traced by
PyTorch.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from stario.network.card import dump_card
from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.engines import CARD_KEY
from stario.network.stario import StarIO
from stario.sequences.files import atomic_write
from stario.sequences.lazy import optional_package
from stario.sequences.windows import WINDOW_SAMPLES

if TYPE_CHECKING:
    from stario.network.model import DisplacementModel

_UNITS = {
    "windows": "rows gyro xyz [rad/s], accel xyz (specific force) [m/s^2]; 200 samples at 200 Hz",
    "displacement": "xyz [m] over the window, in its frame",
    "log_sigma": "xyz, natural logarithm of [m], before the calibration on the card",
}


def export_onnx(model: DisplacementModel, path: Path) -> None:
    """Write a model as an ONNX file with a dynamic batch size.

    Args:
        model: model that runs in PyTorch.
        path: path of the file, in an existing folder.

    Raises:
        InputError: the extra `onnx` is not installed, the model is itself an exported graph, or
            the folder does not exist.
    """
    optional_package("onnx", "onnx")
    network = model.training_form
    if isinstance(network.network, StarIO):
        from stario.network.runtime.stario_graph import stario_graph

        graph = stario_graph(network.network, with_weights=True)
    else:
        graph = _traced(network)
    card = {"frame": model.card.frame, CARD_KEY: dump_card(model.card)}
    for key, text in {**_UNITS, **card}.items():
        graph.metadata_props.add(key=key, value=text)
    with atomic_write(path, "wb") as file:
        file.write(graph.SerializeToString())


def _traced(network: DisplacementNetwork) -> Any:
    optional_package("onnxscript", "onnx")
    batch = torch.export.Dim("batch")
    inputs = {"windows": torch.zeros(2, 6, WINDOW_SAMPLES)}
    if network.is_recurrent:
        inputs["state"] = torch.zeros(2, 2, network.state_size)
    with _quiet():
        program = torch.onnx.export(
            network,
            tuple(inputs.values()),
            dynamo=True,
            external_data=False,
            verbose=False,
            input_names=list(inputs),
            output_names=["displacement", "log_sigma", "next_state"][: 1 + len(inputs)],
            dynamic_shapes=({0: batch}, {1: batch})[: len(inputs)],
        )
    assert program is not None
    return program.model_proto


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's warnings about its own code and about packages not needed here."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
