"""`stario inspect`: properties and problems of a recording."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import process_each
from stario.fusion.commands.options import (
    JsonOption,
    PathsArgument,
    ReadingOptions,
    expand_option_groups,
)
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.network.model import DisplacementModel
    from stario.sequences.sequence import ImuSequence


@expand_option_groups
def inspect(
    paths: PathsArgument,
    reading: ReadingOptions,
    model: Annotated[
        str, typer.Option(help="Compare the motion with these weights' training.")
    ] = "default",
    out: Annotated[
        Path | None, typer.Option(help="Folder for figure and findings. Default: runs/NAME.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Inspect recordings: timing, noise, units, signs, magnetometer, truth, kind of motion."""
    from stario.network.model import load_model

    process_each(reading, paths, out, partial(_inspect, network=load_model(model)), as_json)


def _inspect(
    sequence: ImuSequence, folder: Path, network: DisplacementModel
) -> tuple[dict[str, object], str]:
    """Write one recording's figure and findings; return its record and the findings in words."""
    from stario.fusion.evaluation.familiarity import familiarity
    from stario.fusion.evaluation.folders import make_folder
    from stario.sequences.drawing.figures import save_figure
    from stario.sequences.drawing.plots import imu_overview
    from stario.sequences.files import write_json
    from stario.sequences.inspection.report import inspect_recording
    from stario.sequences.inspection.samples import without_times_ahead

    found, sequence = inspect_recording(sequence), without_times_ahead(sequence)
    make_folder(folder)
    fit, rest = found.fit, found.rest
    figure = imu_overview(
        sequence,
        rotation=None if fit is None else (fit.times, fit.speed),
        rest=rest.stretches if rest else (),
        gaps=[(start, start + length) for start, length in found.timing.gaps],
    )
    save_figure(figure, folder / "inspection.png")
    motion = None
    with suppress(InputError):  # undetermined: the problems give the reason
        motion = familiarity(network, sequence)
    record = found.as_dict() | {"motion": motion and motion.as_dict()}
    write_json(folder / "inspection.json", record)
    lines = [sequence.summary(), *found.lines(), *(motion.lines() if motion else [])]
    return record, "\n".join([*lines, f"figure: {folder / 'inspection.png'}"])
