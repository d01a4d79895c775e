"""`stario inspect`: what a recording is like and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import (
    JsonOption,
    OutOption,
    Reading,
    grouped,
    leave_with_skipped,
    print_json,
)

if TYPE_CHECKING:
    from stario.sequences.sequence import ImuSequence


@grouped
def inspect(
    path: Annotated[Path, typer.Argument(help="A recording, or a folder or list of some.")],
    reading: Reading,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Look recordings over: timing, noise, units, signs, magnetometer, and how truth fits."""
    from stario.fusion.evaluation.many import distinct_name
    from stario.sequences.batch import Skipped, each

    files, skipped = reading.recordings([path])
    names: set[str] = set()

    def inspected(file: Path) -> dict[str, object]:
        sequence = reading.read(file)
        name = distinct_name(sequence.name, names)
        folder = out if out and len(files) == 1 else (out or Path("runs")) / name
        return _inspect(sequence, folder, told=not as_json)

    records: list[dict[str, object]] = []
    for outcome in each(inspected, files, jobs=1):
        if isinstance(outcome, Skipped):
            skipped.append(outcome)
        else:
            records.append(outcome)
    if as_json and records:
        print_json(records[0] if len(files) == 1 else records)
    leave_with_skipped(skipped)


def _inspect(sequence: ImuSequence, folder: Path, told: bool) -> dict[str, object]:
    from stario.fusion.evaluation.results import make_folder
    from stario.sequences.files import write_json
    from stario.sequences.inspection import inspect_recording
    from stario.sequences.plots import imu_overview, save_figure

    found = inspect_recording(sequence)
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
    if told:
        typer.echo("\n".join(found.lines()))
        typer.echo(f"figure: {folder / 'inspection.png'}")
    return found.as_dict()
