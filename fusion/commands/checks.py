"""`stario check ...`: estimators and networks checked on this machine."""

from __future__ import annotations

import importlib.resources
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stario.fusion.commands import common, options
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.imu.inference import Predictor
    from stario.fusion.paper_table.sets import DataSet
    from stario.fusion.values.config import NavigatorConfig
    from stario.sequences.sequence import ImuSequence

    Score = Callable[[Predictor, ImuSequence, NavigatorConfig], pd.DataFrame]
    Table = Callable[[pd.DataFrame], str]

_Graph = Annotated[bool, options.flag("--graph", help="Also run the graph (slower).")]


@dataclass(frozen=True, kw_only=True)
class _Check:
    """What a check of tracks is given, and how it is done."""

    context: typer.Context
    paths: options.OptionalPaths = None
    reading: options.Reading
    estimating: options.Estimator
    as_json: options.Json = False

    def run(
        self,
        score: Score,
        table: Table,
        by: str = "",
        walks: Sequence[Callable[[], ImuSequence]] = (),
    ) -> None:
        """Score each recording, or without PATH the simulated walks, and print all.

        With a label, each is one of its group by it, and a walk one of "simulated".
        """
        from stario.fusion.evaluation.groups import labels

        if not self.paths:
            self.refuse(*options.READING)
        model, settings = self.estimating.network(), self.estimating.settings()

        def of_named(path: Path, sequence: ImuSequence) -> pd.DataFrame:
            scores = score(model, sequence, settings)
            return scores.assign(group=labels(path, sequence.attributes)[by]) if by else scores

        files, skipped = self.reading.recordings(self.paths or [])
        found, failed = common.map_recordings("check", self.reading, files, of_named)
        for walk in () if self.paths else common.with_bar("check", walks, len(walks)):
            scores = score(model, walk(), settings)
            found.append(scores.assign(group="simulated") if by else scores)
        self.show(found, skipped + failed, table)

    def refuse(self, *names: str) -> None:
        """Refuse options that do nothing with simulated walks."""
        options.refuse(self.context, "with simulated walks", "use with PATH", *names)

    def show(self, found: Sequence[pd.DataFrame], skipped: Sequence[Skipped], table: Table) -> None:
        """Print scores as a table or JSON, and exit with 1 if any recording was skipped."""
        from stario.fusion.evaluation.scores import joined

        if found:
            scores = joined(found)
            common.print_result(self.as_json, scores.to_dict("records"), table(scores))
        elif self.as_json:
            common.print_result(True, [])
        common.exit_if_skipped(skipped)


@dataclass(frozen=True, kw_only=True)
class _CheckOfRecordings(_Check):
    """A check that has no simulated walks."""

    paths: options.Paths = field()  # required: without the default that it has above


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
def faults(
    context: typer.Context,
    reading: options.Reading,
    estimating: options.Estimator,
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
    as_json: options.Json = False,
) -> None:
    """Inject faults into a recording one at a time; print the resulting error and the report."""
    from stario.fusion.evaluation.checks.faults import fault_table, matched_walk, run_faults

    if not network:
        options.refuse(context, "without --network", "use with --network", "model")
    settings = estimating.settings()
    if path is not None:
        options.refuse(context, "with one recording", "no filter", "where")
        sequence = reading.read(path)
    else:
        unused = (*options.READING, "magnetometer", "declination")
        options.refuse(context, "with the simulated walk", "use with PATH", *unused)
        sequence, matched = matched_walk(seed=seed)
        settings = matched if estimating.config is None else settings
    scores = run_faults(sequence, settings, estimating.network() if network else None, seed)
    named = scores.rename(columns={"group": "fault", "track": "backend"})
    title = f"{sequence.name}: {sequence.duration:.1f} s"
    common.print_result(as_json, named.to_dict("records"), f"{title}\n{fault_table(scores)}")


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
    from stario.fusion.evaluation.scores import joined

    settings, sigma = options.Estimator(config).settings(), max(math.radians(yaw), 1e-6)
    seeds = common.with_bar("consistency", range(seed, seed + runs), runs)
    scores = joined(check.consistency(settings, sigma, seconds, each) for each in seeds)
    found = check.summary(scores, seconds)
    common.print_result(as_json, found, check.consistency_text(found))


def benchmark(as_json: options.Json = False) -> None:
    """Measure the speed of run, filter and stream on this machine; `models` has the networks'."""
    from stario.fusion.evaluation.checks.speed import speed, speed_text
    from stario.network.model import load_model

    found = speed(load_model("default"))
    common.print_result(as_json, found.to_dict(), speed_text(found))


@options.expanded
def fusion(
    check: _Check,
    by: options.By = "set",
    graph: _Graph = False,
    walks: int = typer.Option(20, min=1, help="Number of simulated walks."),
    seconds: float = typer.Option(120.0, min=5.0, help="Duration of each walk in s."),
) -> None:
    """Compare filter, and graphs, with the network alone: error, NIS, NEES, yaw, speed, by group.

    Without PATH, on simulated walks, measured with white noise of known magnitude.
    """
    from stario.fusion.evaluation.checks.fusion import (
        fusion_gain,
        fusion_gain_table,
        simulated_gain,
    )

    if check.paths:
        unused = "walks", "seconds"
        options.refuse(check.context, "with recordings", "use with simulated walks", *unused)
        check.run(partial(fusion_gain, graph=graph), fusion_gain_table, by)
        return
    check.refuse(*options.READING, *options.ESTIMATING, "by")
    seeds = common.with_bar("fusion", range(walks), walks)
    found = [simulated_gain(seed, seconds, graph) for seed in seeds]
    check.show(found, [], fusion_gain_table)


@options.expanded
def fixes(
    check: _CheckOfRecordings,
    every: float = typer.Option(5.0, min=0.1, help="Interval between fixes in s."),
    sigma: float = typer.Option(0.3, min=0.001, help="Fix sigma per axis \\[m]."),
    backend: Literal["ekf", "graph"] = typer.Option("ekf", help="Estimator."),
    by: options.By = "set",
) -> None:
    """Supply periodic true positions; check that position and yaw errors match their sigmas."""
    from stario.fusion.evaluation.checks.fusion import fixes_table, track_with_fixes

    score = partial(track_with_fixes, every=every, sigma=sigma, backend=backend)
    check.run(score, fixes_table, by)


@options.expanded
def heights(
    check: _Check,
    walks: int = typer.Option(40, min=1, help="Number of simulated walks."),
    by: options.By = "set",
) -> None:
    """Compare heights and floors with known ones, by the barometer and without it.

    Without PATH, use simulated walks through a house with stairs and a lift.
    """
    from stario.fusion.evaluation.checks.fusion import heights_table, score_heights
    from stario.sequences.simulation.house import simulate_house

    def house(seed: int) -> ImuSequence:
        return simulate_house(seed, name=f"house-{seed}").sequence

    check.run(score_heights, heights_table, by, [partial(house, k) for k in range(walks)])


@options.expanded
def gaps(check: _CheckOfRecordings, by: options.By = "set") -> None:
    """Remove 0.1 s at one of six instants or 5 % of the samples; report how far the end moves."""
    from stario.fusion.evaluation.checks.fusion import end_shift_table, end_shifts

    check.run(end_shifts, end_shift_table, by)


@options.expanded
def moments(
    check: _Check,
    graph: _Graph = False,
    seed: int = typer.Option(0, min=0, help="Seed of the moments."),
) -> None:
    """Insert bad moments (shake, drop, throw, lift, bus, ...); report what the rest of tracks pays.

    Without PATH, use simulated walks in a building.
    """
    from stario.fusion.evaluation.checks.moments import CARRIES, moment_costs, moment_table
    from stario.fusion.evaluation.checks.simulation import simulated_walk

    walks = [partial(simulated_walk, carry, k) for k, carry in enumerate(CARRIES)]
    check.run(partial(moment_costs, graph=graph, seed=seed), moment_table, walks=walks)


@options.expanded
def simulation(
    check: _Check,
    walks: int = typer.Option(10, min=1, help="Simulated walks of each way."),
    seconds: float = typer.Option(120.0, min=10.0, help="Duration of each walk in s."),
) -> None:
    """Compare simulated walks with recordings by way of carrying: motion by band, steps, errors.

    Without PATH, print those of the simulated walks.
    """
    from stario.fusion.evaluation.checks import simulation as carried

    if not check.paths:
        check.refuse(*options.READING)
    model, settings = check.estimating.network(), check.estimating.settings()
    score = partial(carried.motion_scores, model, config=settings)
    wanted = [(carry, seed) for carry in carried.WAYS for seed in range(walks)]
    found = [
        score(carried.simulated_walk(carry, seed, seconds), carry=carry, kind=carried.SIMULATED)
        for carry, seed in common.with_bar("simulation", wanted, len(wanted))
    ]

    def recorded(path: Path, sequence: ImuSequence) -> pd.DataFrame:
        return score(sequence, carry=carried.carry_of(sequence), kind=carried.RECORDED)

    files, skipped = check.reading.recordings(check.paths or [])
    more, failed = common.map_recordings("simulation", check.reading, files, recorded)
    check.show(found + more, skipped + failed, carried.motion_table)


def table(
    context: typer.Context,
    out: Path = typer.Option(..., help="Folder of the finished runs; a repetition resumes there."),
    data: Path | None = typer.Option(None, help="Folder of the development recordings."),
    sets: str | None = typer.Option(
        None, help="Sets of --data to use. Default: oxiod,ridi,all,tyrex,kipd,ilc."
    ),
    published: list[str] | None = typer.Option(
        None,
        "--set",
        help="Published data set, NAME=FOLDER, such as ronin=/data/RoNIN; repeatable.",
    ),
    networks: str | None = typer.Option(
        None, help="Networks of `stario check models`, comma-separated. Default: all."
    ),
    steps: int | None = typer.Option(
        None, min=1, help="Training steps per network; overrides the recipe."
    ),
    seeds: int = typer.Option(
        3, min=1, help="Seeds for StarIO with and without MSGCU, R-ResNet and DeepILS."
    ),
    split_seed: int = typer.Option(0, min=0, help="Seed of the recording split."),
    per_group: int = typer.Option(
        2, min=1, help="Maximum test recordings per group in the set all."
    ),
    config: Path | None = typer.Option(
        None, help="TOML or JSON file with the recipe. Default: the package's."
    ),
    cache: options.Cache = None,
    jobs: int | None = typer.Option(
        None, help="Runs to run in parallel; -1 for as many as possible."
    ),
    backend: str = typer.Option("loky", help="Where runs run: loky (this machine), dask or ray."),
) -> None:
    """Train and test every network on every data set; a rerun adds only missing runs.

    The paper's protocol: 8:1:1 by recordings, true attitude, same recipe and steps for all.
    """
    from stario.fusion.paper_table.runs import ReaderConfig, complete_run, table_runs
    from stario.fusion.paper_table.runs import backend as on_backend
    from stario.fusion.paper_table.table import known_costs, write_results
    from stario.network.architectures import ARCHITECTURES
    from stario.network.training.splits import learned_from
    from stario.sequences.datasets.stream_cache import cache_folder
    from stario.sequences.files import make_folder
    from stario.sequences.settings import naming, read_settings

    if data is None:
        options.refuse(context, "without --data", "use with --data", "sets", "per_group")
    datasets = _data_sets(data, sets, published or [], split_seed, per_group)
    chosen = None if networks is None else common.names_in(networks)
    packaged = importlib.resources.files("stario.network.weights") / "recipe-table.json"
    recipe = read_settings(config or Path(str(packaged)))
    with naming(config or str(packaged)):
        runs = table_runs(datasets, recipe, steps, chosen, seeds)
    make_folder(out)
    requested = {run.network for run in runs}
    costs = known_costs([name for name in ARCHITECTURES if name in requested], out)
    learned = {} if data is None else learned_from(data)
    usual = options.Reading()
    reading = ReaderConfig(usual.read, usual.as_read(), cache or cache_folder())
    work, skipped = partial(complete_run, out=out, reading=reading), []
    if jobs is None and backend != "loky":
        jobs = -1
    with on_backend(backend):
        for done, outcome in enumerate(each(work, runs, jobs), 1):
            run, status = str(outcome), "done"
            if isinstance(outcome, Skipped):
                skipped.append(outcome)
                run, status = outcome.item, "not done"
            typer.echo(f"{done} of {len(runs)}: {run}: {status}", err=True)
            write_results(runs, out, costs, learned, drawn=False)
    typer.echo(write_results(runs, out, costs, learned), nl=False)
    common.exit_if_skipped(skipped)


def _data_sets(
    data: Path | None, sets: str | None, published: list[str], seed: int, per_group: int
) -> list[DataSet]:
    from stario.fusion.paper_table.sets import development_sets, folder_set

    if data is None and not published:
        raise InputError("data", "none", "recordings", "pass --data or --set NAME=FOLDER")
    datasets: list[DataSet] = []
    if data is not None:
        names = None if sets is None else common.names_in(sets)
        datasets += development_sets(data, seed, per_group, names)
    for word in published:
        name, folder = options.assignment("--set", word, "NAME=FOLDER", "such as ronin=/data/RoNIN")
        if name in {dataset.name for dataset in datasets}:
            raise InputError("--set", repr(name), "a name of its own", f"or drop {name} by --sets")
        datasets.append(folder_set(name, Path(folder), seed))
    return datasets


COMMANDS = (
    *(models, table, fusion, faults, gaps),
    *(moments, heights, simulation, fixes, consistency, benchmark),
)
"""The checks, in the order of the help."""
