"""Loading of files written by `export_onnx` into ONNX Runtime, without importing PyTorch."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from stario.network.card import Card, parse_card
from stario.network.runtime.engines import OnnxEngine
from stario.sequences.errors import WeightsError
from stario.sequences.lazy import optional_package
from stario.sequences.windows import WINDOW_SAMPLES

CARD_KEY = "stario_card"
"""Metadata key of the card, stored as JSON."""


def load_onnx(path: Path) -> tuple[OnnxEngine, Card]:
    """Load the engine and the card of an exported file.

    Args:
        path: file written by `export_onnx`.

    Raises:
        InputError: the extra `onnx` is not installed.
        WeightsError: the file is missing, truncated, not written by `export_onnx`, or its graph was
            changed since.
    """
    runtime = optional_package("onnxruntime", "onnx")
    if not path.is_file():
        raise WeightsError(path, "file", "no such file", "an exported model")
    options = runtime.SessionOptions()
    # As many threads as PyTorch uses: the number set in the environment, else all (0).
    granted = os.environ.get("OMP_NUM_THREADS", "")
    options.intra_op_num_threads = int(granted) if granted.isdecimal() else 0
    options.log_severity_level = 3
    try:
        session = runtime.InferenceSession(
            path.read_bytes(), options, providers=["CPUExecutionProvider"]
        )
    # ONNX Runtime's errors have no common base of their own.
    except Exception as error:
        found = str(error).splitlines()[0]
        expected = f"a complete ONNX file that ONNX Runtime {runtime.__version__} can read"
        raise WeightsError(path, "graph", found, expected) from error
    metadata = session.get_modelmeta().custom_metadata_map
    if CARD_KEY not in metadata:
        raise WeightsError(path, CARD_KEY, "no such metadata", "a file from `stario export`")
    _check_graph(session, path)
    return OnnxEngine(session), parse_card(metadata[CARD_KEY], path)


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
