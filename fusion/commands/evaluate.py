"""`stario evaluate`: accuracy over many recordings with truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import (
    Estimating,
    JsonOption,
    OutOption,
    PathsArgument,
    Reading,
    distinct,
    found,
    grouped,
    print_json,
    progress_bar,
)
from stario.sequences.errors import InputError


@grouped
def evaluate(
    reading: Reading,
    estimating: Estimating,
    paths: PathsArgument = None,
    data: Annotated[
        Path, typer.Option(help="Folder of the development recordings, used without PATH.")
    ] = Path("../shared/data"),
    split: Annotated[str, typer.Option(help="Which of them: test, validation, training.")] = "test",
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Accuracy and consistency over many recordings with truth, medians and means."""
    from stario.fusion.compare import compare as compare_tracks
    from stario.fusion.evaluate import summary, summary_table
    from stario.fusion.results import write_comparison
    from stario.sequences.splits import split_paths

    settings, network = estimating.settings(), estimating.network()
    files = found(paths) if paths else split_paths(data, split)
    sequences = distinct(reading.read(file) for file in files)
    comparisons = []
    for sequence in sequences:
        if sequence.truth is None:
            raise InputError(f"{sequence.name}: truth", "none", "a recording with truth")
        with progress_bar(f"evaluate {sequence.name}") as progress:
            comparisons.append(compare_tracks(network, sequence, settings, progress))
    if out is not None:
        write_comparison(out, comparisons, settings)
    if as_json:
        print_json(summary(comparisons))
        return
    typer.echo(summary_table(comparisons))
