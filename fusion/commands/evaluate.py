"""`stario evaluate`: accuracy over many recordings, of estimators or of networks alone."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from stario.fusion.commands.common import (
    exit_if_skipped,
    names_in,
    origin_of,
    print_result,
    progress_bar,
    with_bar,
)
from stario.fusion.commands.options import (
    DataOption,
    EstimatorOptions,
    EvaluateOutOption,
    JobsOption,
    JsonOption,
    OptionalPathsArgument,
    ReadingOptions,
    RunsOption,
    changed,
    expand_option_groups,
    flag,
    refuse_unused,
    refuse_unused_sources,
)
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.config import NavigatorConfig
    from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning
    from stario.network.model import DisplacementModel
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.datasets.splits import ListEntry

_GROUP, _SET = "{group}", "{set}"
_SPLIT, _RUNS = "test", Path("runs")


@expand_option_groups
def evaluate(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    data: DataOption = None,
    split: Annotated[
        str,
        typer.Option(
            help="With --data: test, validation, training, holdout, all, open, or a list file "
            "with lines of name, group."
        ),
    ] = _SPLIT,
    by: Annotated[
        str | None,
        typer.Option(
            help="Evaluate the network alone by set, group, person, device, place or carry. "
            "Ground truth may be poses, positions or waypoints.",
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help="With --by: weights to compare with, or pdr (pedestrian dead reckoning without a "
            "network), by paired error ratios with 95 % intervals. {group} or {set} in a weights "
            "name stands for each recording's group, or its first word: leave-one-out."
        ),
    ] = None,
    ekf: Annotated[
        bool, flag("--ekf", help="With --by: also report the mean NIS of the EKF; slow.")
    ] = False,
    models: Annotated[
        str | None,
        typer.Option(
            help="Networks to compare, separated by commas: names from `stario check models`, "
            "default, or weights files; several weights of one network are averaged.",
        ),
    ] = None,
    runs: RunsOption = _RUNS,
    convention: Annotated[
        str | None,
        typer.Option(help="How --models averages position errors: rms (default), ronin or mean."),
    ] = None,
    jobs: JobsOption = 1,
    out: EvaluateOutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate accuracy and consistency over recordings with ground truth: medians and means."""
    from stario.fusion.evaluation.folders import check_folder
    from stario.network.training.splits import warn_of_learned

    if out is not None:
        check_folder(out)
    refuse_unused_sources(reading, paths, data, split != _SPLIT)
    _refuse_unused(estimating, by, against, ekf, models, convention, runs)
    listed, skipped = _listed(reading, paths or [], data, split)
    files = [entry.path for entry in listed]
    if data is not None:
        names = [estimating.model, against or ""] if models is None else names_in(models)
        warn_of_learned(names, files, data)
    if by is not None:
        skipped += _groups(listed, reading, by, estimating.model, against, ekf, jobs, out, as_json)
    elif models is not None:
        settings, averaging = estimating.settings(), convention or "rms"
        names = names_in(models)
        skipped += _networks(names, runs, files, settings, reading, averaging, jobs, out, as_json)
    else:
        skipped += _tracks(files, reading, estimating, jobs, out, as_json)
    exit_if_skipped(skipped)


def _refuse_unused(
    estimating: EstimatorOptions,
    by: str | None,
    against: str | None,
    ekf: bool,
    models: str | None,
    convention: str | None,
    runs: Path,
) -> None:
    """Refuse options that the chosen kind of evaluation does not use."""
    if by is None:
        grouped = {"--against": against is not None, "--ekf": ekf}
        refuse_unused(grouped, "without --by", "a grouping, such as --by set")
    else:
        refuse_unused({"--models": models is not None}, "with --by", "--model and --against")
        settings = changed(estimating, "config", "magnetometer", "declination")
        refuse_unused(settings, "with --by", "use without: the network alone is judged")
    if models is None:
        listed = {"--convention": convention is not None, "--runs": runs != _RUNS}
        refuse_unused(listed, "without --models", "networks named with --models")
    else:
        refuse_unused(changed(estimating, "model"), "with --models", "one of the two")


def _listed(
    reading: ReadingOptions, paths: list[Path], data: Path | None, split: str
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
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    jobs: int,
    out: Path | None,
    as_json: bool,
) -> list[Skipped]:
    """Write and print the table of recordings; return those that were skipped."""
    from stario.fusion.evaluation.compare import compare_recordings
    from stario.fusion.evaluation.results import write_recording, write_summary
    from stario.fusion.evaluation.summary import Scores, scores_of, summary, summary_table
    from stario.sequences.datasets.batch import without_skipped

    settings, network = estimating.settings(), estimating.network()
    model = estimating.for_processes(network, jobs)
    origin = origin_of(files, reading, estimating, network)
    skipped: list[Skipped] = []
    recordings: list[Scores] = []
    with progress_bar("evaluate", 100 * len(files)) as progress:
        outcomes = compare_recordings(
            files, model, settings, reading.read, jobs, truth_needed=True, progress=progress
        )
        for comparison in without_skipped(outcomes, skipped):
            if out is not None:
                write_recording(out, comparison)
            recordings.append(scores_of(comparison))
    if recordings:
        if out is not None:
            write_summary(out, {r.name: r.record for r in recordings}, settings, origin)
        print_result(as_json, summary(recordings), summary_table(recordings))
    return skipped


def _networks(
    names: list[str],
    runs: Path,
    files: list[Path],
    settings: NavigatorConfig,
    reading: ReadingOptions,
    convention: str,
    jobs: int,
    out: Path | None,
    as_json: bool,
) -> list[Skipped]:
    """Write and print the table of networks; return the recordings that were skipped."""
    from stario.fusion.evaluation.figures import write_table
    from stario.fusion.evaluation.networks import compare_networks, networks_text, table_dict
    from stario.network.model import load_model, weights_named
    from stario.sequences.accuracy.metrics import Convention
    from stario.sequences.arrays import check_choice

    averaging: Convention = check_choice("convention", convention, get_args(Convention))
    networks = {name: load_model(weights_named(name, runs)) for name in names}
    with progress_bar("evaluate", 100 * len(files)) as progress:
        table, skipped = compare_networks(
            files,
            list(networks.items()),
            settings,
            reading.read,
            averaging,
            jobs,
            progress=progress,
        )
    if table is not None:
        if out is not None:
            write_table(out, table)
        print_result(as_json, table_dict(table), networks_text(table))
    return skipped


def _groups(
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
    from stario.fusion.evaluation.benchmark.aligned import aligned_recordings
    from stario.fusion.evaluation.benchmark.groups import (
        By,
        benchmark,
        benchmark_dict,
        benchmark_text,
    )
    from stario.fusion.evaluation.figures import write_benchmark
    from stario.sequences.arrays import check_choice

    grouping: By = check_choice("--by", by, get_args(By))
    names = [ours] if theirs is None else [ours, theirs]
    models = {name: partial(_for_group, name) for name in names}
    for name in names:
        if _GROUP not in name and _SET not in name:
            _for_group(name, "")  # fail on unloadable weights before preparing anything
    paths = [entry.path for entry in recordings]
    aligned = aligned_recordings(paths, reading.read, jobs)
    groups = {entry.path: entry.group for entry in recordings}
    shown = with_bar("benchmark", aligned, len(recordings))
    found, skipped = benchmark(shown, models, groups, reading.read if ekf else None)
    if found is not None:
        rows = found.rows(grouping, ours, theirs)
        if out is not None:
            write_benchmark(out, found, rows, ours, theirs)
        record = benchmark_dict(found, rows, ours, theirs)
        print_result(as_json, record, benchmark_text(rows, ours, theirs))
    return skipped


@cache
def _loaded(name: str) -> DisplacementModel | PedestrianDeadReckoning:
    from stario.fusion.evaluation.pedestrian import NAME, PedestrianDeadReckoning
    from stario.network.model import load_model

    if name == NAME:
        return PedestrianDeadReckoning()
    return load_model(name)


def _for_group(name: str, group: str) -> DisplacementModel | PedestrianDeadReckoning:
    """Load weights by name; `{group}` in it stands for the group, with underscores for blanks.

    `{set}` stands for the group's first word.
    """
    name = name.replace(_SET, group.partition(" ")[0])
    return _loaded(name.replace(_GROUP, group.replace(" ", "_")))
