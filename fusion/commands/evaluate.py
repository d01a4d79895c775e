"""`stario evaluate`: accuracy over many recordings, of estimators or of networks alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, get_args

import typer

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.evaluation.pedestrian import Model
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.datasets.splits import ListEntry

_GROUP, _SET = "{group}", "{set}"


class _Found(NamedTuple):
    """An evaluation: its record, its text, and what writes its files into a folder."""

    record: object
    text: str
    write: Callable[[Path], object]


@options.expanded
def evaluate(
    context: typer.Context,
    reading: options.Reading,
    estimating: options.Estimator,
    paths: options.OptionalPaths = None,
    data: options.Data = None,
    split: str = typer.Option(
        "test",
        help="With --data: test, validation, training, holdout, all, open, or a list file "
        "with lines of name, group.",
    ),
    by: str | None = typer.Option(
        None,
        help="Evaluate the network alone by set, group, person, device, place or carry. "
        "Ground truth may be poses, positions or waypoints.",
    ),
    against: str | None = typer.Option(
        None,
        help="With --by: weights to compare with, or pdr (pedestrian dead reckoning without a "
        "network), by paired error ratios with 95 % intervals. {group} or {set} in a weights "
        "name stands for each recording's group, or its first word: leave-one-out.",
    ),
    filtered: bool = options.flag(
        False, "--filtered", help="With --by: also report the filter's mean NIS; slow."
    ),
    jobs: options.Jobs = 1,
    out: options.EvaluateOut = None,
    as_json: options.Json = False,
) -> None:
    """Evaluate accuracy and consistency over recordings with ground truth: medians and means."""
    from stario.fusion.evaluation.results import check_folder
    from stario.network.training.splits import warn_of_learned

    if out is not None:
        check_folder(out)
    _refuse_unused(context, by, bool(paths), data)
    listed, skipped = _listed(reading, paths or [], data, split)
    files = [entry.path for entry in listed]
    if data is not None:
        warn_of_learned([estimating.model, against or ""], files, data)
    if by is not None:
        groups = {entry.path: entry.group for entry in listed}
        found, failed = _groups(groups, reading, by, estimating.model, against, filtered, jobs)
    else:
        found, failed = _tracks(files, reading, estimating, jobs, out)
    if found is not None:
        if out is not None:
            found.write(out)
        common.print_result(as_json, found.record, found.text)
    common.exit_if_skipped([*skipped, *failed])


def _refuse_unused(context: typer.Context, by: str | None, named: bool, data: Path | None) -> None:
    """Refuse options that the chosen recordings and kind of evaluation do not use."""
    if named:
        options.refuse(context, "with PATH", "one of the two", "data")
    if data is None:
        options.refuse(context, "without --data", "use with --data", "split")
    else:
        options.refuse(context, "with --data", "use with PATH: name the archive", "where")
    if by is None:
        options.refuse(
            context, "without --by", "a grouping, such as --by set", "against", "filtered"
        )
    else:
        alone = "use without: the network alone is judged"
        options.refuse(context, "with --by", alone, "config", "magnetometer", "declination")


def _listed(
    reading: options.Reading, paths: list[Path], data: Path | None, split: str
) -> tuple[list[ListEntry], list[Skipped]]:
    """Return the named recordings, or else those of the split, and the skipped paths."""
    from stario.network.training.splits import read_packaged_list
    from stario.sequences.datasets.splits import ListEntry

    if paths:
        files, skipped = reading.recordings(paths)
        return [ListEntry(path, "") for path in files], skipped
    if data is None:
        raise InputError("PATH", "none", "recordings", "name some, or pass --data for a split")
    return read_packaged_list(split, data), []


def _tracks(
    files: list[Path],
    reading: options.Reading,
    estimating: options.Estimator,
    jobs: int,
    out: Path | None,
) -> tuple[_Found | None, list[Skipped]]:
    """Return the table of recordings, whose tracks are written one by one, and those skipped."""
    from stario.fusion.evaluation.compare import compare_recordings
    from stario.fusion.evaluation.results import write_recording, write_summary
    from stario.fusion.evaluation.scores import joined
    from stario.fusion.evaluation.text import summary, summary_table
    from stario.sequences.datasets.batch import without_skipped

    settings, network = estimating.settings(), estimating.network()
    model = estimating.for_processes(network, jobs)
    origin = common.origin_of(files, reading, estimating, network)
    skipped: list[Skipped] = []
    found = []
    with common.progress_bar("evaluate", 100 * len(files)) as progress:
        outcomes = compare_recordings(
            files, model, settings, reading.read, jobs, truth_needed=True, progress=progress
        )
        for comparison in without_skipped(outcomes, skipped):
            if out is not None:
                write_recording(out, comparison)
            found.append(comparison.scores)
    if not found:
        return None, skipped
    scores = joined(found)
    write = partial(write_summary, scores=scores, config=settings, origin=origin)
    return _Found(summary(scores), summary_table(scores), write), skipped


def _groups(
    groups: Mapping[Path, str],
    reading: options.Reading,
    by: str,
    ours: str,
    theirs: str | None,
    filtered: bool,
    jobs: int,
) -> tuple[_Found | None, list[Skipped]]:
    """Return the table of groups, and the recordings that were skipped."""
    from stario.fusion.evaluation.figures import write_benchmark
    from stario.fusion.evaluation.groups import By, alone_on, benchmark
    from stario.sequences.arrays import check_choice

    grouping: By = check_choice("--by", by, get_args(By))
    weights = list(dict.fromkeys([ours, theirs or ours]))
    for name in weights:
        if _GROUP not in name and _SET not in name:
            _for_group(name, "")  # fail on unloadable weights before preparing anything
    work = partial(
        alone_on,
        groups=groups,
        model=_for_group,
        weights=weights,
        read=reading.read,
        filtered=filtered,
    )
    found, skipped = common.each_used("evaluate", work, groups, jobs)
    if not found:
        return None, skipped
    table = benchmark(found, grouping, ours, theirs)
    return _Found(table.as_dict(), table.text(), partial(write_benchmark, found=table)), skipped


def _for_group(name: str, group: str) -> Model:
    """Load weights by name; `{group}` in it stands for the group, with underscores for blanks.

    `{set}` stands for the group's first word.
    """
    from stario.fusion.evaluation.pedestrian import model_named

    name = name.replace(_SET, group.partition(" ")[0])
    return model_named(name.replace(_GROUP, group.replace(" ", "_")))
