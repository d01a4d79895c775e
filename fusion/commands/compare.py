"""`stario compare` and `evaluate`: tracks side by side, and accuracy over many recordings."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from stario.fusion.commands import common, options
from stario.sequences.datasets.batch import Skipped, without_skipped
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.evaluation.compare import Comparison
    from stario.fusion.evaluation.pedestrian import Model
    from stario.sequences.datasets.splits import ListEntry
    from stario.sequences.sequence import ImuSequence

_GROUP, _SET = "{group}", "{set}"

_SHOWN = ("track", "dead_reckoning")
"""Tracks without `--tracks`: what StarIO gives, and what one would have without it."""


@options.expanded
def compare(
    context: typer.Context,
    reading: options.Reading,
    estimating: options.Estimator,
    placing: options.Place,
    paths: options.OptionalPaths = None,
    fixes: options.Fixes = None,
    jobs: options.Jobs = 1,
    out: options.CompareOut = None,
    tracks: str = typer.Option(
        "",
        help="Further tracks, also as a table: filtered, network, network_true_attitude, pdr "
        "(from steps), separated by commas, or all.",
    ),
    report: options.Report = False,
    as_json: options.Json = False,
    explained: options.Explain = False,
) -> None:
    """Compare each recording's track with its truth and with dead reckoning by the IMU alone.

    Without PATH, that of a simulated walk.
    """
    from stario.fusion.evaluation.compare import TRACKS, compare_recordings, demonstration
    from stario.fusion.evaluation.results import metrics_dict, write_comparison
    from stario.fusion.evaluation.scores import joined
    from stario.fusion.values.fix_file import read_fixes
    from stario.sequences.arrays import check_choice
    from stario.sequences.files import check_folder

    if not paths:
        options.refuse(context, "without PATH", "use with a recording to read", *options.READING)
    also = common.further_files(report)
    chosen = TRACKS if tracks == "all" else [*_SHOWN, *(common.names_in(tracks) if tracks else [])]
    for name in chosen:
        check_choice("--tracks", name, TRACKS)
    settings, network = placing.settings(estimating.settings()), estimating.network()
    model = network if jobs == 1 else estimating.model  # each process loads the weights once
    absolute_fixes = [] if fixes is None else read_fixes(fixes)
    files, skipped = reading.recordings(paths or [])
    origin = common.origin_of(files, reading, estimating, network, fixes)
    read: Callable[[Path], ImuSequence] = reading.read
    if not paths:
        files, read = [Path("demonstration")], lambda path: demonstration()
    if fixes is not None and len(files) > 1:
        raise InputError("--fixes", f"{len(files)} recordings", "one recording")
    folder = out or Path("runs") / "compare"
    check_folder(folder)
    with common.progress_bar("compare", 100 * len(files)) as progress:
        outcomes = compare_recordings(
            files, model, settings, read, jobs, absolute_fixes, progress=progress, names=chosen
        )
        train = common.training_command(paths, reading, estimating.model) if paths else ""
        comparisons = [replace(c, train=train) for c in without_skipped(outcomes, skipped)]
    if explained:
        common.explain(as_json)
    if comparisons:
        written = write_comparison(folder, comparisons, settings, origin, also)
        lines = [line for found in comparisons for line in _lines(found, bool(tracks))]
        first = folder / comparisons[0].sequence.name / "plan.png"
        lines.append(f"figures and tracks: {first} and {len(written) - 1} other files")
        if not paths:
            command = "stario" if shutil.which("stario") else sys.argv[0]  # in no PATH: its own
            lines.append(f"next: {command} run FILE --report, with a phone's recording")
        scores = joined(found.scores for found in comparisons)
        common.print_result(as_json, metrics_dict(scores, comparisons[0].words), "\n".join(lines))
    common.exit_if_skipped(skipped)


def _lines(found: Comparison, as_table: bool) -> list[str]:
    """Return how good the track is beside dead reckoning, and perhaps a table of all tracks."""
    from stario.fusion.evaluation.text import error_words, place_words, track_table, track_words
    from stario.sequences.drawing.figures import distance

    alone = found.metrics["dead_reckoning"]
    far = alone["ate_m"] or alone["known_positions_m"]
    far = far or found.tracks["dead_reckoning"].trajectory.path_length()
    words = error_words(found) or place_words(found) or track_words(found)
    line = f"{found.sequence.name}: StarIO's track: {words}; dead reckoning: {distance(far)}"
    table = [track_table(found)] if as_table else []
    return [line, *table, *(finding.line() for finding in found.verdict)]


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
    by: options.Grouping | None = typer.Option(
        None,
        help="Evaluate the network alone by groups. Ground truth may be poses, positions or "
        "waypoints.",
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
    from stario.network.training.splits import warn_of_learned
    from stario.sequences.files import check_folder

    if out is not None:
        check_folder(out)
    _refuse_unused(context, by, bool(paths), data)
    listed, skipped = _listed(reading, paths or [], data, split)
    files = [entry.path for entry in listed]
    if data is not None:
        warn_of_learned([estimating.model, against or ""], files, data)
    if by is not None:
        groups = {entry.path: entry.group for entry in listed}
        weights = estimating.model, against
        skipped += _groups(groups, reading, by, *weights, filtered, jobs, out, as_json)
    else:
        skipped += _tracks(files, reading, estimating, jobs, out, as_json)
    common.exit_if_skipped(skipped)


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
    as_json: bool,
) -> list[Skipped]:
    """Print the table of recordings, whose tracks are written one by one; return those skipped."""
    from stario.fusion.evaluation.compare import compare_recordings
    from stario.fusion.evaluation.results import write_recording, write_summary
    from stario.fusion.evaluation.scores import joined
    from stario.fusion.evaluation.text import summary, summary_table

    settings, network = estimating.settings(), estimating.network()
    model = network if jobs == 1 else estimating.model  # each process loads the weights once
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
    if found:
        scores = joined(found)
        if out is not None:
            write_summary(out, scores, settings, origin)
        common.print_result(as_json, summary(scores), summary_table(scores))
    return skipped


def _groups(
    groups: Mapping[Path, str],
    reading: options.Reading,
    by: options.Grouping,
    ours: str,
    theirs: str | None,
    filtered: bool,
    jobs: int,
    out: Path | None,
    as_json: bool,
) -> list[Skipped]:
    """Print and write the table of groups; return the recordings that were skipped."""
    from stario.fusion.evaluation.groups import benchmark, write_benchmark

    weights = list(dict.fromkeys([ours, theirs or ours]))
    for name in weights:
        if _GROUP not in name and _SET not in name:
            _for_group(name, "")  # fail on unloadable weights before preparing anything
    judged: dict[str, Any] = {"model": _for_group, "weights": weights, "filtered": filtered}
    work = partial(_alone, reading=reading, groups=groups, **judged)
    found, skipped = common.each_used("evaluate", work, groups, jobs)
    if found:
        table = benchmark(found, by, ours, theirs)
        if out is not None:
            write_benchmark(out, table)
        common.print_result(as_json, table.as_dict(), table.text())
    return skipped


def _alone(
    path: Path, reading: options.Reading, groups: Mapping[Path, str], **judged: Any
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return what `alone_on` does of a path; further processes know it by its name."""
    from stario.fusion.evaluation.groups import alone_on

    return alone_on(reading.read(path), path, groups[path], **judged)


def _for_group(name: str, group: str) -> Model:
    """Load weights by name; `{group}` in it stands for the group, with underscores for blanks.

    `{set}` stands for the group's first word.
    """
    from stario.fusion.evaluation.pedestrian import model_named

    name = name.replace(_SET, group.partition(" ")[0])
    return model_named(name.replace(_GROUP, group.replace(" ", "_")))
