"""`stario check ...`: estimators and networks checked on this machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from stario.fusion.commands import common, options
from stario.fusion.commands.table import table

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.backends import BackendName
    from stario.fusion.imu.stateful import Predictor
    from stario.fusion.values.config import NavigatorConfig
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence

    Score = Callable[[Predictor, ImuSequence, NavigatorConfig], pd.DataFrame]
    Found = tuple[Sequence[pd.DataFrame], Sequence[Skipped]]

_Graph = Annotated[bool, options.flag("--graph", help="Also run the graph (slower).")]


@dataclass(frozen=True)
class _Scoring:
    """Options of a check that scores recordings or simulated walks, and prints the scores."""

    reading: options.Reading
    estimating: options.Estimator
    as_json: options.Json = False

    def of_recordings(self, paths: Sequence[Path], score: Score, by: str = "") -> Found:
        """Score each recording, as one of its group if they are grouped by a label."""
        from stario.fusion.evaluation.groups import By, labels
        from stario.sequences.arrays import check_choice

        if by:
            check_choice("--by", by, get_args(By))
        model, settings = self.estimating.network(), self.estimating.settings()

        def of_named(path: Path, sequence: ImuSequence) -> pd.DataFrame:
            scores = score(model, sequence, settings)
            return scores.assign(group=labels(path, sequence.attributes)[by]) if by else scores

        return common.map_recordings("check", self.reading, paths, of_named)

    def of_walks(
        self, context: typer.Context, walks: Iterable[ImuSequence], count: int, score: Score
    ) -> Found:
        """Score simulated walks, for which nothing is read."""
        options.refuse(context, "with simulated walks", "use with PATH", *options.READING)
        model, settings = self.estimating.network(), self.estimating.settings()
        walks = common.with_bar("check", walks, count)
        return [score(model, walk, settings) for walk in walks], []

    def print(
        self,
        found: Found,
        table: Callable[[pd.DataFrame], str],
        record: Callable[[pd.DataFrame], object] | None = None,
    ) -> None:
        """Print scores as a table or JSON, and exit with 1 if any recording was skipped."""
        from stario.fusion.evaluation.scores import joined, records

        tables, skipped = found
        if tables:
            scores = joined(tables)
            common.print_result(self.as_json, (record or records)(scores), table(scores))
        elif self.as_json:
            common.print_result(True, [])
        common.exit_if_skipped(skipped)


def models(
    names: list[str] | None = typer.Argument(
        None, help="Networks. Default: all of the paper's table."
    ),
    as_json: options.Json = False,
) -> None:
    """List parameters, FLOPs, time and memory of each network next to the paper's values."""
    from stario.network.architectures import ARCHITECTURES
    from stario.network.runtime.survey import survey, survey_table

    rows = survey(names or list(ARCHITECTURES))
    common.print_result(as_json, rows, survey_table(rows))


@options.expanded
def backends(
    context: typer.Context,
    paths: options.OptionalPaths = None,
    walks: int = typer.Option(20, min=1, help="Number of simulated walks."),
    seconds: float = typer.Option(120.0, min=5.0, help="Duration of each walk in s."),
    data: options.Data = None,
    split: str = typer.Option("validation", help="With --data: split to use."),
    *,
    scoring: _Scoring,
) -> None:
    """Compare filter, graph and fixed-lag graph: accuracy, consistency, speed, slowest update.

    Without PATH or --data, use simulated walks, measured with white noise of known magnitude.
    """
    from stario.fusion.evaluation.checks import backends as check
    from stario.fusion.evaluation.scores import records
    from stario.network.training.splits import read_packaged_list

    def record(scores: pd.DataFrame) -> object:
        return {"summary": check.summary(scores), "scores": records(scores)}

    options.refuse_unused_sources(context, paths, data)
    found: Found
    if paths or data is not None:
        options.refuse(context, "with recordings", "use with simulated walks", "walks", "seconds")
        files = paths or [entry.path for entry in read_packaged_list(split, data or Path())]
        found = scoring.of_recordings(files, check.score_recording)
    else:
        unused = (*options.READING, "config", "model", "magnetometer", "declination")
        options.refuse(context, "with simulated walks", "use with PATH or --data", *unused)
        seeds = common.with_bar("backends", range(walks), walks)
        found = [check.score_walk(seed, seconds) for seed in seeds], []
    scoring.print(found, check.score_table, record)


@options.expanded
def faults(
    context: typer.Context,
    path: Path | None = typer.Argument(
        None, help="Recording with true poses. Default: a simulated walk."
    ),
    network: bool = options.flag(
        False,
        "--network",
        help="Use the network's displacements instead of true ones with white noise.",
    ),
    seed: int = typer.Option(
        0, min=0, help="Seed of the faults and of the simulated walk, if any."
    ),
    *,
    scoring: _Scoring,
) -> None:
    """Inject faults into a recording one at a time; print the resulting error and the report."""
    from stario.fusion.evaluation.checks.faults import fault_table, matched_walk, run_faults
    from stario.fusion.evaluation.scores import records

    if not network:
        options.refuse(context, "without --network", "use with --network", "model")
    estimating = scoring.estimating
    settings = estimating.settings()
    if path is not None:
        options.refuse(context, "with one recording", "no filter", "where")
        sequence = scoring.reading.read(path)
    else:
        unused = (*options.READING, "magnetometer", "declination")
        options.refuse(context, "with the simulated walk", "use with PATH", *unused)
        sequence, matched = matched_walk(seed=seed)
        settings = matched if estimating.config is None else settings
    scores = run_faults(sequence, settings, estimating.network() if network else None, seed)
    named = scores.rename(columns={"group": "fault", "track": "backend"})
    title = f"{sequence.name}: {sequence.duration:.1f} s"
    common.print_result(scoring.as_json, records(named), f"{title}\n{fault_table(scores)}")


def consistency(
    config: options.Config = None,
    yaw: float = typer.Option(10.0, min=0.0, help="Sigma of the initial yaw in deg."),
    runs: int = typer.Option(20, min=1, help="Number of simulated walks."),
    seconds: float = typer.Option(300.0, min=2.0, help="Duration of each walk in s."),
    seed: int = typer.Option(0, min=0, help="Seed of the first walk."),
    as_json: options.Json = False,
) -> None:
    """Run a Monte Carlo test on simulated walks: are NEES, NIS and yaw error consistent?"""
    from stario.fusion.evaluation.checks import consistency as check

    settings, sigma = options.Estimator(config).settings(), max(math.radians(yaw), 1e-6)
    with common.progress_bar("consistency") as progress:
        scores = check.consistency(settings, sigma, runs, seconds, seed, progress)
    found = check.summary(scores, seconds)
    common.print_result(as_json, found, check.consistency_text(found))


def benchmark(as_json: options.Json = False) -> None:
    """Measure speed on this machine: filter against dense algebra, network, whole run."""
    from stario.fusion.evaluation.checks.backends import speed_report, speed_table
    from stario.network.model import load_model

    report = speed_report(load_model("default"))
    common.print_result(as_json, report, speed_table(report))


@options.expanded
def fusion(
    paths: options.Paths,
    by: options.By = "set",
    graph: _Graph = False,
    *,
    scoring: _Scoring,
) -> None:
    """Compare the filter's error with the network's by group, with NIS and consistency of yaw."""
    from stario.fusion.evaluation.checks.fusion import fusion_gain, fusion_gain_table

    score = partial(fusion_gain, backends=_backends(graph))
    scoring.print(scoring.of_recordings(paths, score, by), fusion_gain_table)


@options.expanded
def fixes(
    paths: options.Paths,
    every: float = typer.Option(5.0, min=0.1, help="Interval between fixes in s."),
    sigma: float = typer.Option(0.3, min=0.001, help="Fix sigma per axis \\[m]."),
    backend: str = typer.Option("ekf", help="Estimator: ekf or graph."),
    by: options.By = "set",
    *,
    scoring: _Scoring,
) -> None:
    """Supply periodic true positions; check that position and yaw errors match their sigmas."""
    from stario.fusion.backends import BackendName
    from stario.fusion.evaluation.checks.fusion import fixes_table, track_with_fixes
    from stario.sequences.arrays import check_choice

    chosen: BackendName = check_choice("--backend", backend, get_args(BackendName))
    score = partial(track_with_fixes, every=every, sigma=sigma, backend=chosen)
    scoring.print(scoring.of_recordings(paths, score, by), fixes_table)


@options.expanded
def heights(
    context: typer.Context,
    paths: options.OptionalPaths = None,
    walks: int = typer.Option(40, min=1, help="Number of simulated walks."),
    by: options.By = "set",
    *,
    scoring: _Scoring,
) -> None:
    """Compare heights and floors with known ones, by the barometer and without it.

    Without PATH, use simulated walks through a house with stairs and a lift.
    """
    from stario.fusion.evaluation.checks.fusion import heights_table, score_heights
    from stario.sequences.simulation.house import simulate_house

    if paths:
        found = scoring.of_recordings(paths, score_heights, by)
    else:
        houses = (simulate_house(k, name=f"house-{k}").sequence for k in range(walks))
        tables, _ = scoring.of_walks(context, houses, walks, score_heights)
        found = [scores.assign(group="simulated") for scores in tables], []
    scoring.print(found, heights_table)


@options.expanded
def gaps(
    paths: options.Paths,
    by: options.By = "set",
    *,
    scoring: _Scoring,
) -> None:
    """Remove 0.1 s at one of six instants or 5 % of the samples; report how far the end moves."""
    from stario.fusion.evaluation.checks.fusion import end_shift_table, end_shifts

    scoring.print(scoring.of_recordings(paths, end_shifts, by), end_shift_table)


@options.expanded
def moments(
    context: typer.Context,
    paths: options.OptionalPaths = None,
    graph: _Graph = False,
    seed: int = typer.Option(0, min=0, help="Seed of the moments."),
    *,
    scoring: _Scoring,
) -> None:
    """Insert bad moments (shake, drop, table, standing, lift); report what the rest of tracks pays.

    Without PATH, use simulated walks in a building.
    """
    from stario.fusion.evaluation.checks.moments import CARRIES, moment_costs, moment_table
    from stario.fusion.evaluation.checks.simulation import simulated_walk

    score = partial(moment_costs, backends=_backends(graph), seed=seed)
    if paths:
        found = scoring.of_recordings(paths, score)
    else:
        walks = (simulated_walk(carry, k) for k, carry in enumerate(CARRIES))
        found = scoring.of_walks(context, walks, len(CARRIES), score)
    scoring.print(found, moment_table)


@options.expanded
def simulation(
    context: typer.Context,
    paths: options.OptionalPaths = None,
    walks: int = typer.Option(10, min=1, help="Simulated walks of each way."),
    seconds: float = typer.Option(120.0, min=10.0, help="Duration of each walk in s."),
    *,
    scoring: _Scoring,
) -> None:
    """Compare simulated walks with recordings by way of carrying: motion by band, steps, errors.

    Without PATH, print those of the simulated walks.
    """
    from stario.fusion.evaluation.checks import simulation as check

    if not paths:
        options.refuse(context, "with simulated walks", "use with PATH", *options.READING)
    model, settings = scoring.estimating.network(), scoring.estimating.settings()
    score = partial(check.motion_scores, model, config=settings)
    wanted = [(carry, seed) for carry in check.SPEEDS for seed in range(walks)]
    found = [
        score(check.simulated_walk(carry, seed, seconds), carry=carry, kind=check.SIMULATED)
        for carry, seed in common.with_bar("simulation", wanted, len(wanted))
    ]

    def recorded(path: Path, sequence: ImuSequence) -> pd.DataFrame:
        return score(sequence, carry=check.carry_of(sequence), kind=check.RECORDED)

    more, skipped = common.map_recordings("simulation", scoring.reading, paths or [], recorded)
    scoring.print((found + more, skipped), check.motion_table)


def _backends(graph: bool) -> tuple[BackendName, ...]:
    return ("ekf", "graph") if graph else ("ekf",)


COMMANDS = (
    *(models, table, fusion, backends, faults, gaps),
    *(moments, heights, simulation, fixes, consistency, benchmark),
)
"""The checks, in the order of the help."""
