"""`stario export`: export a network for other runtimes."""

from __future__ import annotations

from pathlib import Path

import typer

from stario.sequences.errors import InputError


def export(
    model: str = typer.Option(
        "default",
        help="Network: a name from `stario check models`, default, or weights with their card.",
    ),
    runs: Path = typer.Option(
        Path("runs"), help="Folder of training runs in which named networks are found."
    ),
    out: Path | None = typer.Option(None, help="File to write. Default: ./NETWORK.onnx"),
) -> None:
    """Export a network with its calibration as ONNX; `--model FILE.onnx` then runs it anywhere."""
    from stario.network.model import load_model, weights_named
    from stario.network.runtime.export import export_onnx

    loaded = load_model(weights_named(model, runs))
    path = out or Path(f"{loaded.name}.onnx")
    if path.suffix != ".onnx":
        raise InputError("--out", str(path), "a name ending in .onnx")
    export_onnx(loaded, path)
    typer.echo(str(path))
