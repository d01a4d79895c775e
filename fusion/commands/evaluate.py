"""`stario evaluate`: accuracy over many recordings with truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import (
    Estimating,
    JobsOption,
    JsonOption,
    OutOption,
    PathsArgument,
    Reading,
    grouped,
    leave_with_skipped,
    print_json,
    progress_bar,
    recordings_at,
)


@grouped
def evaluate(
    reading: Reading,
    estimating: Estimating,
    paths: PathsArgument = None,
    data: Annotated[
        Path, typer.Option(help="Folder of the development recordings, used without PATH.")
    ] = Path("../shared/data"),
    split: Annotated[str, typer.Option(help="Which of them: test, validation, training.")] = "test",
    jobs: JobsOption = 1,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Accuracy and consistency over many recordings with truth, medians and means."""
    from stario.fusion.evaluate import scores_of, summary, summary_table
    from stario.fusion.many import compare_recordings
    from stario.fusion.results import write_recording, write_summary
    from stario.sequences.batch import Skipped
    from stario.sequences.splits import split_paths

    settings, network = estimating.settings(), estimating.network_for(jobs)
    files, skipped = recordings_at(paths) if paths else (split_paths(data, split), [])
    recordings = []
    with progress_bar("evaluate", 100 * len(files)) as progress:
        for outcome in compare_recordings(
            files, network, settings, reading.read, jobs, truth_needed=True, progress=progress
        ):
            if isinstance(outcome, Skipped):
                skipped.append(outcome)
                continue
            if out is not None:
                write_recording(out, outcome, settings)
            recordings.append(scores_of(outcome))
    if recordings and out is not None:
        write_summary(out, recordings, settings)
    if recordings and as_json:
        print_json(summary(recordings))
    elif recordings:
        typer.echo(summary_table(recordings))
    leave_with_skipped(skipped)
