"""`stario check ...`: estimators and networks checked on this machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
    READING,
    BackendOption,
    ByOption,
    ConfigOption,
    DataOption,
    EstimatorOptions,
    JsonOption,
    OptionalPathsArgument,
    PathsArgument,
    ReadingOptions,
    expand_option_groups,
    flag,
    refuse,
    refuse_unused_sources,
)

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.backends import BackendName
    from stario.fusion.config import NavigatorConfig
    from stario.fusion.imu.stateful import Predictor
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence

GraphOption = Annotated[bool, flag("--graph", help="Also run the graph (slower).")]


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
    context: typer.Context,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = 20,
    seconds: Annotated[float, typer.Option(min=5.0, help="Duration of each walk in s.")] = 120.0,
    data: DataOption = None,
    split: Annotated[str, typer.Option(help="With --data: split to use.")] = "validation",
    as_json: JsonOption = False,
) -> None:
    """Compare filter, graph and fixed-lag graph: accuracy, consistency, speed, slowest update.

    Without PATH or --data, use simulated walks, measured with white noise of known magnitude.
    """
    from stario.fusion.evaluation.checks.backends import (
        score_recording,
        score_table,
        score_walk,
        summary,
    )
    from stario.fusion.evaluation.scores import records
    from stario.network.training.splits import read_packaged_list

    refuse_unused_sources(context, paths, data)
    found: list[pd.DataFrame] = []
    skipped: list[Skipped] = []
    if paths or data is not None:
        refuse(context, "with recordings", "use with simulated walks", "walks", "seconds")
        files = paths or [entry.path for entry in read_packaged_list(split, data or Path())]
        score = partial(score_recording, estimating.network(), config=estimating.settings())
        found, skipped = map_recordings("backends", reading, files, lambda path, each: score(each))
    else:
        unused = (*READING, "config", "model", "magnetometer", "declination")
        refuse(context, "with simulated walks", "use with PATH or --data", *unused)
        found = [score_walk(seed, seconds) for seed in with_bar("backends", range(walks), walks)]

    def record(scores: pd.DataFrame) -> object:
        return {"summary": summary(scores), "scores": records(scores)}

    _print_scores(found, skipped, score_table, as_json, record)


@expand_option_groups
def faults(
    context: typer.Context,
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
        refuse(context, "without --network", "use with --network", "model")
    settings = estimating.settings()
    if path is not None:
        refuse(context, "with one recording", "no filter", "where")
        sequence = reading.read(path)
    else:
        unused = (*READING, "magnetometer", "declination")
        refuse(context, "with the simulated walk", "use with PATH", *unused)
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
    graph: GraphOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare the filter's error with the network's by group, with NIS and consistency of yaw."""
    from stario.fusion.evaluation.checks.fusion import fusion_gain, fusion_gain_table

    score = partial(fusion_gain, backends=_backends(graph))
    _check_groups(reading, paths, estimating, by, score, fusion_gain_table, as_json)


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
    from stario.fusion.evaluation.checks.fusion import fixes_table, track_with_fixes
    from stario.sequences.arrays import check_choice

    chosen: BackendName = check_choice("--backend", backend, get_args(BackendName))
    score = partial(track_with_fixes, every=every, sigma=sigma, backend=chosen)
    _check_groups(reading, paths, estimating, by, score, fixes_table, as_json)


@expand_option_groups
def heights(
    context: typer.Context,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = 40,
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
    refuse(context, "with simulated walks", "use with PATH", *READING)
    judge = partial(score_house, estimating.network(), config=estimating.settings())
    found = [judge(seed) for seed in with_bar("heights", range(walks), walks)]
    _print_scores(found, [], heights_table, as_json)


@expand_option_groups
def gaps(
    paths: PathsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Remove 0.1 s at one of six instants or 5 % of the samples; report how far the end moves."""
    from stario.fusion.evaluation.checks.fusion import end_shift_table, end_shifts

    _check_groups(reading, paths, estimating, by, end_shifts, end_shift_table, as_json)


@expand_option_groups
def moments(
    context: typer.Context,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    graph: GraphOption = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the moments.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Insert bad moments (shake, drop, table, standing, lift); report what the rest of tracks pays.

    Without PATH, use simulated walks in a building.
    """
    from stario.fusion.evaluation.checks.moments import moment_costs, moment_table, simulated_walks

    skipped: list[Skipped] = []
    model, settings = estimating.network(), estimating.settings()
    score = partial(moment_costs, model, config=settings, backends=_backends(graph), seed=seed)
    if paths:
        found, skipped = map_recordings("moments", reading, paths, lambda path, each: score(each))
    else:
        refuse(context, "with simulated walks", "use with PATH", *READING)
        walks = simulated_walks()
        found = [score(walk) for walk in with_bar("moments", walks, len(walks))]
    _print_scores(found, skipped, moment_table, as_json)


@expand_option_groups
def simulation(
    context: typer.Context,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    walks: Annotated[int, typer.Option(min=1, help="Simulated walks of each way.")] = 10,
    seconds: Annotated[float, typer.Option(min=10.0, help="Duration of each walk in s.")] = 120.0,
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
        refuse(context, "with simulated walks", "use with PATH", *READING)
    score = partial(motion_scores, estimating.network(), config=estimating.settings())
    wanted = [(carry, seed) for carry in SPEEDS for seed in range(walks)]
    found = [
        score(simulated_walk(carry, seed, seconds), carry=carry, kind=SIMULATED)
        for carry, seed in with_bar("simulation", wanted, len(wanted))
    ]

    def recorded(path: Path, sequence: ImuSequence) -> pd.DataFrame:
        return score(sequence, carry=carry_of(sequence), kind=RECORDED)

    more, skipped = map_recordings("simulation", reading, paths or [], recorded)
    _print_scores(found + more, skipped, motion_table, as_json)


def _backends(graph: bool) -> tuple[BackendName, ...]:
    return ("ekf", "graph") if graph else ("ekf",)


def _check_groups(
    reading: ReadingOptions,
    paths: Sequence[Path],
    estimating: EstimatorOptions,
    by: str,
    score: Callable[[Predictor, ImuSequence, NavigatorConfig, str], pd.DataFrame],
    table: Callable[[pd.DataFrame], str],
    as_json: bool,
) -> None:
    """Score each recording as one of its group, and print the table."""
    from stario.fusion.evaluation.benchmark.groups import By, labels
    from stario.sequences.arrays import check_choice

    grouping: By = check_choice("--by", by, get_args(By))
    model, settings = estimating.network(), estimating.settings()

    def of_group(path: Path, sequence: ImuSequence) -> pd.DataFrame:
        return score(model, sequence, settings, labels(path, sequence.attributes)[grouping])

    _print_scores(*map_recordings("check", reading, paths, of_group), table, as_json)


def _print_scores(
    found: Sequence[pd.DataFrame],
    skipped: Sequence[Skipped],
    table: Callable[[pd.DataFrame], str],
    as_json: bool,
    record: Callable[[pd.DataFrame], object] | None = None,
) -> None:
    """Print scores as a table or JSON, and exit with 1 if any recording was skipped."""
    from stario.fusion.evaluation.scores import joined, records

    if found:
        scores = joined(found)
        print_result(as_json, (record or records)(scores), table(scores))
    elif as_json:
        print_result(as_json, [])
    exit_if_skipped(skipped)
