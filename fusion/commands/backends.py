"""`stario check backends`: compare the filter with the graph."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import (
    exit_if_skipped,
    map_recordings,
    print_json,
    progress_bar,
)
from stario.fusion.commands.options import (
    EstimatorOptions,
    JsonOption,
    PathsArgument,
    ReadingOptions,
    expand_option_groups,
)

if TYPE_CHECKING:
    from stario.fusion.evaluation.checks.backends import Score
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence


@expand_option_groups
def backends(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: PathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = 20,
    seconds: Annotated[float, typer.Option(min=5.0, help="Duration of each walk in s.")] = 120.0,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the development recordings to use instead.")
    ] = None,
    split: Annotated[str, typer.Option(help="With --data: split to use.")] = "validation",
    as_json: JsonOption = False,
) -> None:
    """Compare EKF, graph and fixed-lag graph: accuracy, consistency, speed, slowest update.

    Without PATH or --data, use simulated walks, measured with white noise of known magnitude.
    """
    from stario.fusion.evaluation.checks.backends import (
        score_recording,
        score_table,
        score_walk,
        summary,
    )
    from stario.network.training.splits import split_paths

    scores: list[Score] = []
    skipped: list[Skipped] = []
    if paths or data is not None:
        settings, network = estimating.settings(), estimating.network()

        def scored(path: Path, sequence: ImuSequence) -> Score:
            return score_recording(network, sequence, settings)

        recordings = paths or split_paths(data or Path(), split)
        scores, skipped = map_recordings("backends", reading, recordings, scored)
    else:
        with progress_bar("backends", walks) as progress:
            for seed in range(walks):
                scores.append(score_walk(seed, seconds))
                progress((seed + 1) / walks)
    if scores and as_json:
        print_json({"summary": summary(scores), "scores": [asdict(score) for score in scores]})
    elif scores:
        typer.echo(score_table(scores))
    exit_if_skipped(skipped)
