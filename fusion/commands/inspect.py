"""`stario inspect`: properties and problems of a recording."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.sequences.sequence import ImuSequence


@options.expanded
def inspect(
    paths: options.Paths,
    reading: options.Reading,
    model: str = typer.Option("default", help="Weights that the recording is tried with."),
    out: Path | None = typer.Option(
        None, help="Folder for figure and findings. Default: runs/NAME."
    ),
    as_json: options.Json = False,
) -> None:
    """Inspect recordings: timing, noise, units, signs, magnetometer, truth, track."""
    from stario.fusion.evaluation.results import make_folder
    from stario.fusion.evaluation.verdict import recording_verdict
    from stario.fusion.navigator import Navigator
    from stario.network.model import load_model
    from stario.sequences.drawing.figures import save_figure
    from stario.sequences.drawing.plots import imu_overview
    from stario.sequences.files import write_json
    from stario.sequences.inspection.report import inspect_recording
    from stario.sequences.inspection.samples import without_times_ahead

    train = common.training_command(paths, reading)
    navigator = Navigator(load_model(model))

    def inspected(given: ImuSequence, folder: Path) -> tuple[dict[str, object], str]:
        """Write one recording's figure and findings; return its record and the findings."""
        found, sequence = inspect_recording(given), without_times_ahead(given)
        make_folder(folder)
        fit, rest = found.fit, found.rest
        figure = imu_overview(
            sequence,
            rotation=None if fit is None else (fit.times, fit.speed),
            rest=rest.stretches if rest else (),
            gaps=[
                (gap["start_s"], gap["start_s"] + gap["length_s"]) for gap in found.figures["gaps"]
            ],
        )
        save_figure(figure, folder / "inspection.png")
        track = None
        with suppress(InputError):  # refused: the inspection gives the reason
            track = navigator.run(given)
        verdict = recording_verdict(given, track, found, train)
        record = found.as_dict() | {"verdict": [asdict(finding) for finding in verdict]}
        write_json(folder / "inspection.json", record)
        lines = [sequence.summary(), *found.lines(), *(finding.line() for finding in verdict)]
        return record, "\n".join([*lines, f"figure: {folder / 'inspection.png'}"])

    common.process_each(reading, paths, out, inspected, as_json)
