"""`stario inspect`: what a recording is like and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import JsonOption, OutOption, Reading, grouped, print_json


@grouped
def inspect(
    path: Annotated[Path, typer.Argument(help="A recording: a file, or a recording's folder.")],
    reading: Reading,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Look a recording over: timing, noise, units, signs, and how its truth fits."""
    from stario.fusion.evaluation.results import make_folder
    from stario.sequences.files import write_json
    from stario.sequences.inspection import inspect_recording
    from stario.sequences.plots import imu_overview, save_figure

    sequence = reading.read(path)
    found = inspect_recording(sequence)
    folder = out or Path("runs") / sequence.name
    make_folder(folder)
    fit, rest = found.fit, found.rest
    figure = imu_overview(
        sequence,
        rotation=None if fit is None else (fit.times, fit.speed),
        rest=rest.stretches if rest else (),
        gaps=[(start, start + length) for start, length in found.timing.gaps],
    )
    save_figure(figure, folder / "inspection.png")
    write_json(folder / "inspection.json", found.as_dict())
    if as_json:
        print_json(found.as_dict())
        return
    typer.echo("\n".join(found.lines()))
    typer.echo(f"figure: {folder / 'inspection.png'}")
