"""`stario evaluate --by`: networks alone, evaluated by group of recordings."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands.common import print_json, progress_bar
from stario.fusion.commands.options import ReadingOptions

if TYPE_CHECKING:
    from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning
    from stario.network.model import DisplacementModel
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.datasets.splits import ListEntry


def evaluate_by_group(
    recordings: list[ListEntry],
    reading: ReadingOptions,
    by: str,
    ours: str,
    theirs: str | None,
    ekf: bool,
    jobs: int,
    out: Path | None,
    as_json: bool,
) -> list[Skipped]:
    """Write and print the table of groups; return the recordings that were skipped."""
    from stario.fusion.evaluation.judging.judge import check_by, judge, rows_of
    from stario.fusion.evaluation.judging.prepared import prepared_recordings
    from stario.fusion.evaluation.judging.table import (
        JudgingResult,
        judgement_dict,
        judgement_text,
        write_judgement,
    )
    from stario.fusion.evaluation.results import make_folder
    from stario.sequences.datasets.stream_cache import cache_folder

    grouping = check_by(by)
    names = [ours] if theirs is None else [ours, theirs]
    models = {name: partial(_for_group, name) for name in names}
    for name in names:
        if _GROUP not in name:
            _for_group(name, "")  # fail on unloadable weights before preparing anything
    if out is not None:
        make_folder(out)
    paths = [entry.path for entry in recordings]
    prepared = prepared_recordings(paths, reading.read, reading.as_read(), cache_folder(), jobs)
    groups = {entry.path: entry.group for entry in recordings}
    with progress_bar("judge", len(recordings)) as progress:
        judged, skipped = judge(
            prepared,
            models,
            groups,
            reading.read if ekf else None,
            lambda done: progress(done / len(recordings)),
        )
    if not judged:
        return skipped
    found = JudgingResult(ours, theirs, rows_of(judged, grouping, ours, theirs), judged)
    if out is not None:
        write_judgement(out, found)
    if as_json:
        print_json(judgement_dict(found))
    else:
        typer.echo(judgement_text(found))
    return skipped


_GROUP = "{group}"


@cache
def _loaded(name: str) -> DisplacementModel | PedestrianDeadReckoning:
    from stario.fusion.evaluation.pedestrian import NAME, PedestrianDeadReckoning
    from stario.network.model import load_model

    if name == NAME:
        return PedestrianDeadReckoning()
    return load_model(name)


def _for_group(name: str, group: str) -> DisplacementModel | PedestrianDeadReckoning:
    """Load weights by name; `{group}` in it stands for the group, with underscores for blanks."""
    return _loaded(name.replace(_GROUP, group.replace(" ", "_")))
