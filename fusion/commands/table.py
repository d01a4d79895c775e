"""`stario check table`: the paper's table, every network trained and tested on every data set."""

from __future__ import annotations

import importlib.resources
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands import common, options
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.paper_table.sets import DataSet


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
    from stario.fusion.evaluation.results import make_folder
    from stario.fusion.paper_table.runs import backend as on_backend
    from stario.fusion.paper_table.runs import complete_run, table_runs
    from stario.fusion.paper_table.table import known_costs, write_results
    from stario.fusion.paper_table.training import ReaderConfig
    from stario.network.architectures import ARCHITECTURES
    from stario.network.training.splits import learned_from
    from stario.sequences.datasets.stream_cache import cache_folder
    from stario.sequences.settings import read_settings

    if data is None:
        options.refuse(context, "without --data", "use with --data", "sets", "per_group")
    datasets = _data_sets(data, sets, published or [], split_seed, per_group)
    chosen = None if networks is None else common.names_in(networks)
    packaged = importlib.resources.files("stario.network.weights") / "recipe-table.json"
    recipe = read_settings(config or Path(str(packaged)))
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
