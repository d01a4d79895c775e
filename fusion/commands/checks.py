"""`stario check ...`: estimators and networks checked on this machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from stario.fusion.commands.common import (
    exit_if_skipped,
    map_recordings,
    print_result,
    progress_bar,
    with_bar,
)
from stario.fusion.commands.options import (
    BackendOption,
    ByOption,
    ConfigOption,
    DataOption,
    EstimatorOptions,
    JsonOption,
    OptionalPathsArgument,
    PathsArgument,
    ReadingOptions,
    changed,
    expand_option_groups,
    flag,
    refuse_unused,
    refuse_unused_sources,
)

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.backends import BackendName
    from stario.fusion.config import NavigatorConfig
    from stario.fusion.imu.stateful import Predictor
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence

_WALKS, _SECONDS, _SPLIT = 20, 120.0, "validation"


def models(
    names: Annotated[
        list[str] | None, typer.Argument(help="Networks. Default: all of the paper's table.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List parameters, FLOPs, time and memory of each network next to the paper's values."""
    from stario.network.architectures import ARCHITECTURES
    from stario.network.runtime.survey import survey, survey_table
    from stario.sequences.datasets.cache_files import cache_folder

    with progress_bar("models") as progress:
        rows = survey(names or list(ARCHITECTURES), cache_folder(), progress)
    print_result(as_json, rows, survey_table(rows))


@expand_option_groups
def backends(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = _WALKS,
    seconds: Annotated[float, typer.Option(min=5.0, help="Duration of each walk in s.")] = _SECONDS,
    data: DataOption = None,
    split: Annotated[str, typer.Option(help="With --data: split to use.")] = _SPLIT,
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
    from stario.fusion.evaluation.scores import joined, records
    from stario.network.training.splits import read_packaged_list

    refuse_unused_sources(reading, paths, data, split != _SPLIT)
    simulated = {"--walks": walks != _WALKS, "--seconds": seconds != _SECONDS}
    if paths or data is not None:
        refuse_unused(simulated, "with recordings", "use with simulated walks")
    else:
        unused = changed(reading) | changed(estimating)
        refuse_unused(unused, "with simulated walks", "use with PATH or --data")
    scores: list[pd.DataFrame] = []
    skipped: list[Skipped] = []
    if paths or data is not None:
        settings, network = estimating.settings(), estimating.network()
        scores, skipped = _score_each(
            "backends",
            reading,
            paths or [entry.path for entry in read_packaged_list(split, data or Path())],
            lambda path, sequence: score_recording(network, sequence, settings),
        )
    else:
        for seed in with_bar("backends", range(walks), walks):
            scores.append(score_walk(seed, seconds))
    if scores:
        found = joined(scores)
        record = {"summary": summary(found), "scores": records(found)}
        print_result(as_json, record, score_table(found))
    exit_if_skipped(skipped)


@expand_option_groups
def faults(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    path: Annotated[
        Path | None,
        typer.Argument(help="Recording with true poses. Default: a simulated walk."),
    ] = None,
    network: Annotated[
        bool,
        flag(
            "--network",
            help="Use the network's displacements instead of true ones with white noise.",
        ),
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the faults and of the simulated walk, if any.")
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Inject faults into a recording one at a time; print the resulting error and the report."""
    from stario.fusion.evaluation.checks.faults import fault_table, matched_walk, run_faults
    from stario.fusion.evaluation.scores import records

    if not network:
        refuse_unused(changed(estimating, "model"), "without --network", "use with --network")
    settings = estimating.settings()
    if path is not None:
        refuse_unused(changed(reading, "where"), "with one recording", "no filter")
        sequence = reading.read(path)
    else:
        unused = changed(reading) | changed(estimating, "magnetometer", "declination")
        refuse_unused(unused, "with the simulated walk", "use with PATH")
        sequence, matched = matched_walk(seed=seed)
        settings = matched if estimating.config is None else settings
    scores = run_faults(sequence, settings, estimating.network() if network else None, seed)
    named = scores.rename(columns={"group": "fault", "track": "backend"})
    title = f"{sequence.name}: {sequence.duration:.1f} s"
    print_result(as_json, records(named), f"{title}\n{fault_table(scores)}")


def consistency(
    config: ConfigOption = None,
    yaw: Annotated[float, typer.Option(min=0.0, help="Sigma of the initial yaw in deg.")] = 10.0,
    runs: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = 20,
    seconds: Annotated[float, typer.Option(min=2.0, help="Duration of each walk in s.")] = 300.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first walk.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Run a Monte Carlo test on simulated walks: are NEES, NIS and yaw error consistent?"""
    from stario.fusion.config import NavigatorConfig, read_config
    from stario.fusion.evaluation.checks.consistency import consistency as monte_carlo
    from stario.fusion.evaluation.checks.consistency import consistency_text, summary

    checked = read_config(config) if config else NavigatorConfig()
    with progress_bar("consistency") as progress:
        scores = monte_carlo(checked, max(math.radians(yaw), 1e-6), runs, seconds, seed, progress)
    print_result(as_json, summary(scores, seconds), consistency_text(scores, seconds))


def benchmark(as_json: JsonOption = False) -> None:
    """Measure speed on this machine: filter against dense algebra, network, whole run."""
    from stario.fusion.evaluation.checks.speed import speed_report, speed_table
    from stario.network.model import load_model

    report = speed_report(load_model("default"))
    print_result(as_json, report, speed_table(report))


@expand_option_groups
def fusion(
    paths: PathsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    by: ByOption = "set",
    graph: Annotated[bool, flag("--graph", help="Also run the graph (slower).")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compare the filter's error with the network's by group, with NIS and consistency of yaw."""
    from stario.fusion.evaluation.checks.fusion_gain import fusion_gain, fusion_gain_table

    backends: tuple[BackendName, ...] = ("ekf", "graph") if graph else ("ekf",)
    judge = partial(fusion_gain, backends=backends)
    _check_groups(reading, paths, estimating, by, judge, fusion_gain_table, as_json)


@expand_option_groups
def fixes(
    paths: PathsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    every: Annotated[float, typer.Option(min=0.1, help="Interval between fixes in s.")] = 5.0,
    sigma: Annotated[float, typer.Option(min=0.001, help="Fix sigma per axis \\[m].")] = 0.3,
    backend: BackendOption = "ekf",
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Supply periodic true positions; check that position and yaw errors match their sigmas."""
    from stario.fusion.backends import BackendName
    from stario.fusion.evaluation.checks.with_fixes import fixes_table, track_with_fixes
    from stario.sequences.arrays import check_choice

    chosen: BackendName = check_choice("--backend", backend, get_args(BackendName))
    judge = partial(track_with_fixes, every=every, sigma=sigma, backend=chosen)
    _check_groups(reading, paths, estimating, by, judge, fixes_table, as_json)


@expand_option_groups
def heights(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = 2 * _WALKS,
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Compare heights and floors with known ones, by the barometer and without it.

    Without PATH, use simulated walks through a house with stairs and a lift.
    """
    from stario.fusion.evaluation.checks.heights import heights_table, score_heights, score_house

    if paths:
        _check_groups(reading, paths, estimating, by, score_heights, heights_table, as_json)
        return
    refuse_unused(changed(reading), "with simulated walks", "use with PATH")
    model, settings = estimating.network(), estimating.settings()
    found = [
        score_house(model, seed, settings)
        for seed in with_bar("check heights", range(walks), walks)
    ]
    _print_table(found, [], heights_table, as_json)


@expand_option_groups
def gaps(
    paths: PathsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Remove 0.1 s at one of six instants or 5 % of the samples; report how far the end moves."""
    from stario.fusion.evaluation.checks.sample_loss import end_shift_table, end_shifts

    _check_groups(reading, paths, estimating, by, end_shifts, end_shift_table, as_json)


@expand_option_groups
def moments(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    graph: Annotated[bool, flag("--graph", help="Also run the graph (slower).")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the moments.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Insert bad moments (shake, drop, table, standing, lift); report what the rest of tracks pays.

    Without PATH, use simulated walks in a building.
    """
    from stario.fusion.evaluation.checks.moments import (
        moment_costs,
        moment_table,
        simulated_walks,
    )

    backends: tuple[BackendName, ...] = ("ekf", "graph") if graph else ("ekf",)
    model, settings = estimating.network(), estimating.settings()
    skipped: list[Skipped] = []
    judge = partial(moment_costs, model, config=settings, backends=backends, seed=seed)
    if paths:
        found, skipped = _score_each(
            "check moments", reading, paths, lambda path, sequence: judge(sequence)
        )
    else:
        refuse_unused(changed(reading), "with simulated walks", "use with PATH")
        walks = simulated_walks()
        found = [judge(walk) for walk in with_bar("check moments", walks, len(walks))]
    _print_table(found, skipped, moment_table, as_json)


@expand_option_groups
def simulation(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Simulated walks of each way.")] = 10,
    seconds: Annotated[
        float, typer.Option(min=10.0, help="Duration of each walk in s.")
    ] = _SECONDS,
    as_json: JsonOption = False,
) -> None:
    """Compare simulated walks with recordings by way of carrying: motion by band, steps, errors.

    Without PATH, print those of the simulated walks.
    """
    from stario.fusion.evaluation.checks.simulation import (
        RECORDED,
        SIMULATED,
        SPEEDS,
        carry_of,
        motion_scores,
        motion_table,
        simulated_walk,
    )

    if not paths:
        refuse_unused(changed(reading), "with simulated walks", "use with PATH")
    model, settings = estimating.network(), estimating.settings()
    wanted = [(carry, seed) for carry in SPEEDS for seed in range(walks)]
    found = [
        motion_scores(model, simulated_walk(carry, seed, seconds), settings, carry, SIMULATED)
        for carry, seed in with_bar("check simulation", wanted, len(wanted))
    ]
    skipped: list[Skipped] = []
    if paths:
        recorded, skipped = _score_each(
            "check simulation",
            reading,
            paths,
            lambda path, sequence: motion_scores(
                model, sequence, settings, carry_of(sequence), RECORDED
            ),
        )
        found += recorded
    _print_table(found, skipped, motion_table, as_json)


def _check_groups(
    reading: ReadingOptions,
    paths: Sequence[Path],
    estimating: EstimatorOptions,
    by: str,
    judge: Callable[[Predictor, ImuSequence, NavigatorConfig, str], pd.DataFrame],
    table: Callable[[pd.DataFrame], str],
    as_json: bool,
) -> None:
    """Score each recording as one of its group, and print the table."""
    from stario.fusion.evaluation.benchmark.groups import By, labels
    from stario.sequences.arrays import check_choice

    grouping: By = check_choice("--by", by, get_args(By))
    model, settings = estimating.network(), estimating.settings()

    def judged(path: Path, sequence: ImuSequence) -> pd.DataFrame:
        return judge(model, sequence, settings, labels(path, sequence.attributes)[grouping])

    _print_table(*_score_each("check", reading, paths, judged), table, as_json)


def _score_each(
    title: str,
    reading: ReadingOptions,
    paths: Sequence[Path],
    score: Callable[[Path, ImuSequence], pd.DataFrame],
) -> tuple[list[pd.DataFrame], list[Skipped]]:
    """Score each recording, under a name of its own; return the scores and what was skipped."""
    from stario.fusion.evaluation.compare import distinct_name

    names: set[str] = set()

    def named(path: Path, sequence: ImuSequence) -> pd.DataFrame:
        return score(path, replace(sequence, name=distinct_name(sequence.name, names)))

    return map_recordings(title, reading, paths, named)


def _print_table(
    found: Sequence[pd.DataFrame],
    skipped: Sequence[Skipped],
    table: Callable[[pd.DataFrame], str],
    as_json: bool,
) -> None:
    """Print scores as a table or JSON, and exit with 1 if any recording was skipped."""
    from stario.fusion.evaluation.scores import joined, records

    if found:
        scores = joined(found)
        print_result(as_json, records(scores), table(scores))
    elif as_json:
        print_result(as_json, [])
    exit_if_skipped(skipped)
