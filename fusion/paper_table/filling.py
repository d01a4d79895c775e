"""Cells of the table, the most important first, and their filling in parallel."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from itertools import product
from pathlib import Path

from stario.fusion.paper_table.cells import LEADING, Cell, fill_cell, reference_rows
from stario.fusion.paper_table.sets import FIRST, DataSet
from stario.fusion.paper_table.training import ReaderConfig, cell_recipe
from stario.network.architectures import ARCHITECTURES, architecture
from stario.sequences.arrays import check_choice
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError
from stario.sequences.lazy import optional_package


def table_cells(
    sets: Sequence[DataSet],
    recipe: dict[str, object],
    steps: int | None = None,
    networks: Sequence[str] | None = None,
    seeds: int = 3,
) -> list[Cell]:
    """Return the cells: the sets of `FIRST` with one seed, their other seeds, the other sets.

    Args:
        sets: data sets.
        recipe: training settings common to all cells.
        steps: steps of every training; None for the recipe's.
        networks: networks to train; None for all of the paper's table.
        seeds: number of seeds for the networks of `LEADING`; the others have one.

    Raises:
        InputError: a network is unknown.
        ConfigError: a setting of the recipe is unknown or out of range.
    """
    names = list(networks or [*LEADING, *(n for n in ARCHITECTURES if n not in LEADING)])
    for name in names:
        architecture(name)

    first = [dataset for dataset in sets if dataset.name in FIRST]
    others = [dataset for dataset in sets if dataset.name not in FIRST]
    leading = [name for name in names if name in LEADING]
    cells = []
    for part in (first, others):
        for seed, dataset in product(range(seeds), part):
            if seed == 0:
                cells += [Cell(dataset, name, 0, None) for name in reference_rows(dataset)]
            for name in leading if seed else names:
                cells.append(Cell(dataset, name, seed, cell_recipe(recipe, name, seed, steps)))
    return cells


def fill(
    cells: Sequence[Cell], out: Path, reading: ReaderConfig, jobs: int | None = 1
) -> Iterator[Cell | Skipped]:
    """Fill what is missing; yield each cell once it is filled, or the reason why it is not.

    Cells are started in their order; `out` must be writable by every process that takes part.
    `jobs` is as for `stario.sequences.datasets.batch.each`.
    """
    yield from each(partial(fill_cell, out=out, reading=reading), cells, jobs)


def backend(name: str) -> AbstractContextManager[object]:
    """Select joblib's backend within a block: "loky" (processes on this machine), "dask" or "ray".

    Dask uses the scheduler named in its configuration (`DASK_SCHEDULER_ADDRESS`), Ray the cluster
    at `RAY_ADDRESS`; without these, both start on this machine.

    Raises:
        InputError: the name is unknown, or the backend's package is not installed.
    """
    backends: dict[str, Callable[[], AbstractContextManager[object]]] = {
        "loky": nullcontext,
        "dask": _dask,
        "ray": _ray,
    }
    check_choice("--backend", name, backends)
    return backends[name]()


@contextmanager
def _dask() -> Iterator[None]:
    from joblib import parallel_config

    distributed = optional_package("distributed", "cluster")
    logging.getLogger("distributed").setLevel(logging.WARNING)
    with distributed.Client(), parallel_config("dask"):
        yield


@contextmanager
def _ray() -> Iterator[None]:
    from joblib import parallel_config

    try:
        importlib.import_module("ray.util.joblib").register_ray()
    except ImportError as error:
        raise InputError("--backend", "ray, not installed", "ray", "pip install ray") from error
    with parallel_config("ray"):
        yield
