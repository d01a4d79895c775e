"""From cells to the rows of the table: means, standard errors, ranks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.table.cells import Cell, read_cell
from stario.fusion.table.errors import EKF, OWN_ATTITUDE, TRUE_ATTITUDE
from stario.fusion.table.ranks import Rank, Recordings, ranks
from stario.fusion.table.sets import DataSet
from stario.network.architectures import ARCHITECTURES

AGAINST = "StarIO"
"""The network that the others' errors are compared with."""

Content = Mapping[str, Any]
"""What `read_cell` returns."""

Recording = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A figure of every recording, averaged over them, or one of the training.

    Attributes:
        title: of the column.
        value: of a recording; nan where it has none.
    """

    title: str
    value: Callable[[Recording], float]


def _track(track: str, metric: str, scale: float = 1.0) -> Callable[[Recording], float]:
    def value(one: Recording) -> float:
        found = one["tracks"].get(track, {}).get(metric)
        return float("nan") if found is None else scale * float(found)

    return value


def _figure(kind: str, figure: str) -> Callable[[Recording], float]:
    def value(one: Recording) -> float:
        found = one["figures"].get(figure) if one["kind"] == kind else None
        return float("nan") if found is None else float(found)

    return value


COLUMNS = {
    "ate": Column("ATE [m]", _track(TRUE_ATTITUDE, "ate_m")),
    "rte": Column("RTE [m]", _track(TRUE_ATTITUDE, "rte_m")),
    "pde": Column("PDE [%]", _track(TRUE_ATTITUDE, "pde", 100.0)),
    "own_ate": Column("own attitude: ATE [m]", _track(OWN_ATTITUDE, "ate_m")),
    "own_rte": Column("own attitude: RTE [m]", _track(OWN_ATTITUDE, "rte_m")),
    "ekf_ate": Column("EKF: ATE [m]", _track(EKF, "ate_m")),
    "ekf_rte": Column("EKF: RTE [m]", _track(EKF, "rte_m")),
    "waypoints_m": Column("waypoints [m]", _figure("waypoints", "ate_fit_m")),
    "waypoints_percent": Column("waypoints [%]", _figure("waypoints", "ate_fit_percent")),
    "waypoints_length": Column("length ratio", _figure("waypoints", "length_ratio")),
    "positions_percent": Column("positions, 20 s [%]", _figure("positions", "stretch_percent")),
}
"""Of the table, in its order; one without any value on a set is left out there."""


@dataclass(frozen=True)
class Mean:
    """A mean over seeds of means over recordings; its standard error where there are several."""

    value: float
    error: float | None


@dataclass(frozen=True)
class Row:
    """A network on a data set.

    Attributes:
        network: its name, or that of weights.
        seeds: that are filled.
        figures: by the name of the column.
        training_error: mean squared error of the last epoch's windows [m^2]; None of weights.
        validation_error: likewise, of the recordings that validate.
        rank: among the networks of the set; None where it has no error of the measure.
        learned: test recordings that given weights have learned from.
    """

    network: str
    seeds: list[int]
    figures: dict[str, Mean]
    training_error: Mean | None
    validation_error: Mean | None
    rank: Rank | None
    learned: int = 0


@dataclass(frozen=True)
class SetTable:
    """A data set's part of the table.

    Attributes:
        dataset: its name, recordings and split.
        tested: recordings that the rows tell of.
        path_m: their true paths together [m].
        rows: networks with at least one seed filled.
        measure: what ranks are of.
        skipped: why recordings could not be used, each reason once.
    """

    dataset: DataSet
    tested: int
    path_m: float
    rows: list[Row]
    measure: str
    skipped: list[str] = field(default_factory=list)


Filled = dict[str, dict[int, Content]]
"""Contents of a set's cells, by network and seed."""


def filled_cells(cells: Iterable[Cell], out: Path) -> dict[str, Filled]:
    """What is filled of the cells, by set.

    Raises:
        ConfigError: a cell was filled with another recipe or other recordings.
    """
    found: dict[str, Filled] = {}
    for cell in cells:
        content = read_cell(cell, out)
        if content is not None:
            networks = found.setdefault(cell.dataset.name, {})
            networks.setdefault(cell.network, {})[cell.seed] = content
    return found


def set_table(dataset: DataSet, filled: Filled, learned: Mapping[str, frozenset[Path]]) -> SetTable:
    """The rows of a set.

    Args:
        dataset: the set.
        filled: its cells.
        learned: recordings that weights of the package have learned from, by their name.
    """
    poses = all(one["kind"] == "poses" for c in _contents(filled) for one in c["recordings"])
    measure = "ate" if poses else "10"
    blocks = {name: _blocks(seeds, measure) for name, seeds in filled.items()}
    placed = ranks({name: runs for name, runs in blocks.items() if all(runs)}, AGAINST)
    order = [name for name in [PDR, *ARCHITECTURES] if name in filled]
    order += [name for name in filled if name not in order]
    test = {one.path for one in dataset.test}
    rows = [
        _row(name, filled[name], placed.get(name), len(test & learned.get(name, frozenset())))
        for name in order
    ]
    first = next(iter(_contents(filled)), None)
    recordings = first["recordings"] if first else []
    skipped = [
        f"{one['item']}: {one['reason']}"
        for c in _contents(filled)
        for one in [*c["skipped"], *c.get("trained", {}).get("skipped", [])]
    ]
    return SetTable(
        dataset,
        len(recordings),
        float(sum(one["path_m"] for one in recordings)),
        rows,
        "position error under the paper's protocol"
        if poses
        else "displacement error over 10 s, "
        "waypoint residuals instead where there are waypoints, along the own attitude",
        list(dict.fromkeys(skipped)),
    )


def seconds_by_network(tables: Iterable[Filled]) -> dict[str, tuple[float, float, float]]:
    """Seconds of training, of evaluation, and windows per second of a training step, by network."""
    sums: dict[str, list[float]] = {}
    for filled in tables:
        for name, seeds in filled.items():
            total = sums.setdefault(name, [0.0, 0.0, 0.0, 0.0])
            for content in seeds.values():
                trained = content.get("trained", {})
                total[0] += trained.get("seconds", 0.0)
                total[1] += content["seconds"]
                step = trained.get("step_seconds")
                if step:
                    total[2] += trained["windows"] / step
                    total[3] += 1
    return {
        name: (training, testing, speeds / count if count else float("nan"))
        for name, (training, testing, speeds, count) in sums.items()
    }


def _contents(filled: Filled) -> Iterable[Content]:
    return (content for seeds in filled.values() for content in seeds.values())


def _row(name: str, seeds: Mapping[int, Content], rank: Rank | None, learned: int) -> Row:
    figures = {}
    for key, column in COLUMNS.items():
        means = [_mean([column.value(one) for one in c["recordings"]]) for c in seeds.values()]
        found = _over_seeds(means)
        if found is not None:
            figures[key] = found
    trained = [c["trained"] for c in seeds.values() if "trained" in c]
    errors = [
        _over_seeds([one[key] for one in trained])
        for key in ("training_error_m2", "validation_error_m2")
    ]
    return Row(name, sorted(seeds), figures, errors[0], errors[1], rank, learned)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def _over_seeds(values: Sequence[float]) -> Mean | None:
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return None
    error = float(np.std(known, ddof=1) / np.sqrt(len(known))) if len(known) > 1 else None
    return Mean(float(np.mean(known)), error)


def _blocks(seeds: Mapping[int, Content], measure: str) -> list[Recordings]:
    return [
        [
            (one["group"], one["path"], np.array(one["blocks"][measure]))
            for one in content["recordings"]
            if one["blocks"].get(measure)
        ]
        for content in seeds.values()
    ]
