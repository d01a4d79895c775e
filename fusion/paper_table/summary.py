"""The rows of the table, computed from its cells: means, standard errors, ranks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from stario.fusion.evaluation.bootstrap import Rank, block_rows, ranks
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.scores import joined
from stario.fusion.evaluation.tables import EKF, OWN_ATTITUDE, TRUE_ATTITUDE
from stario.fusion.paper_table.cells import Cell, read_cell
from stario.fusion.paper_table.sets import DataSet, set_of
from stario.network.architectures import ARCHITECTURES

REFERENCE_NETWORK = "StarIO"
"""Reference network that the others' errors are compared with."""

Content = Mapping[str, Any]
"""Result of `read_cell`."""

Recording = Mapping[str, Any]


class Column(NamedTuple):
    """A quantity of each recording, averaged over recordings.

    Attributes:
        title: title of the column.
        source: track that it is an error of, or kind of ground truth whose figure it is.
        name: name of the error or figure.
        scale: factor of the error.
    """

    title: str
    source: str
    name: str
    scale: float = 1.0

    def value(self, recording: Recording) -> float:
        """Return a recording's value; NaN if it has none."""
        if recording["kind"] == self.source:
            found = recording["figures"].get(self.name)
        else:
            found = recording["tracks"].get(self.source, {}).get(self.name)
        return float("nan") if found is None else self.scale * float(found)


COLUMNS = {
    "ate": Column("ATE [m]", TRUE_ATTITUDE, "ate_m"),
    "rte": Column("RTE [m]", TRUE_ATTITUDE, "rte_m"),
    "pde": Column("PDE [%]", TRUE_ATTITUDE, "pde", 100.0),
    "own_ate": Column("own attitude: ATE [m]", OWN_ATTITUDE, "ate_m"),
    "own_rte": Column("own attitude: RTE [m]", OWN_ATTITUDE, "rte_m"),
    "ekf_ate": Column("EKF: ATE [m]", EKF, "ate_m"),
    "ekf_rte": Column("EKF: RTE [m]", EKF, "rte_m"),
    "waypoints_m": Column("waypoints [m]", "waypoints", "ate_fit_m"),
    "waypoints_percent": Column("waypoints [%]", "waypoints", "ate_fit_percent"),
    "waypoints_length": Column("length ratio", "waypoints", "length_ratio"),
    "positions_percent": Column("positions, 20 s [%]", "positions", "stretch_percent"),
}
"""Columns of the table, in order; a column without any value on a set is omitted there."""


@dataclass(frozen=True)
class Mean:
    """Mean over seeds of means over recordings, with its standard error if there are several."""

    value: float
    error: float | None


@dataclass(frozen=True)
class Row:
    """A network on a data set.

    Attributes:
        network: name of the network or of the weights.
        seeds: filled seeds.
        figures: means by column key.
        training_error: mean squared error of the last epoch's windows [m^2]; None for weights.
        validation_error: that of the best epoch, whose weights are kept, on the validation
            recordings.
        rank: rank among the networks of the set; None without an error in the measure.
        learned: number of test recordings that given weights were trained on.
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
        dataset: name, recordings and split.
        tested: number of tested recordings.
        path_m: total length of their true paths [m].
        rows: networks with at least one filled seed.
        measure: the error that networks are ranked by, in words.
        skipped: reasons why recordings were skipped, each once.
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
    """Return the contents of the filled cells, by set.

    Raises:
        ConfigError: a cell was filled with another recipe, other weights or other recordings.
    """
    found: dict[str, Filled] = {}
    for cell in cells:
        content = read_cell(cell, out)
        if content is not None:
            networks = found.setdefault(cell.dataset.name, {})
            networks.setdefault(cell.network, {})[cell.seed] = content
    return found


def set_table(dataset: DataSet, filled: Filled, learned: Mapping[str, frozenset[Path]]) -> SetTable:
    """Return the table of a set.

    `learned` has the recordings that packaged weights were trained on, by the weights' name.
    """
    contents = [content for seeds in filled.values() for content in seeds.values()]
    poses = all(recording["kind"] == "poses" for c in contents for recording in c["recordings"])
    measure = "ate" if poses else "10"
    blocks = _blocks(filled, measure, dataset)
    network_ranks = ranks(joined(blocks), REFERENCE_NETWORK) if blocks else {}
    order = [name for name in [PDR, *ARCHITECTURES] if name in filled]
    order += [name for name in filled if name not in order]
    test = {entry.path for entry in dataset.test}
    rows = [
        _row(name, filled[name], network_ranks.get(name), len(test & learned.get(name, set())))
        for name in order
    ]
    recordings = contents[0]["recordings"]
    skipped = [
        f"{failure['item']}: {failure['reason']}"
        for c in contents
        for failure in [*c["skipped"], *c.get("trained", {}).get("skipped", [])]
    ]
    return SetTable(
        dataset,
        len(recordings),
        float(sum(recording["path_m"] for recording in recordings)),
        rows,
        "position error under the paper's protocol"
        if poses
        else "displacement error over 10 s along the own attitude (waypoint residuals where "
        "there are waypoints)",
        list(dict.fromkeys(skipped)),
    )


def seconds_by_network(tables: Iterable[Filled]) -> dict[str, tuple[float, float, float]]:
    """Return seconds of training and of evaluation, and training windows per second, by network."""
    contents: dict[str, list[Content]] = {}
    for filled in tables:
        for name, seeds in filled.items():
            contents.setdefault(name, []).extend(seeds.values())
    work = {}
    for name, found in contents.items():
        trained = [content["trained"] for content in found if "trained" in content]
        speeds = [t["windows"] / t["step_seconds"] for t in trained if t["step_seconds"]]
        training = sum((t["seconds"] for t in trained), 0.0)
        testing = sum(content["seconds"] for content in found)
        work[name] = training, testing, sum(speeds) / len(speeds) if speeds else float("nan")
    return work


def _row(name: str, seeds: Mapping[int, Content], rank: Rank | None, learned: int) -> Row:
    figures = {}
    for key, column in COLUMNS.items():
        found = _over_seeds(
            [_mean([column.value(one) for one in c["recordings"]]) for c in seeds.values()]
        )
        if found is not None:
            figures[key] = found
    trained = [c["trained"] for c in seeds.values() if "trained" in c]
    training, validation = (
        _over_seeds([one[key] for one in trained])
        for key in ("training_error_m2", "validation_error_m2")
    )
    return Row(name, sorted(seeds), figures, training, validation, rank, learned)


def _mean(values: Sequence[float]) -> float:
    found = _over_seeds(values)
    return float("nan") if found is None else found.value


def _over_seeds(values: Sequence[float]) -> Mean | None:
    finite = [value for value in values if np.isfinite(value)]
    if not finite:
        return None
    error = float(np.std(finite, ddof=1) / np.sqrt(len(finite))) if len(finite) > 1 else None
    return Mean(float(np.mean(finite)), error)


def _blocks(filled: Filled, measure: str, dataset: DataSet) -> list[pd.DataFrame]:
    """Return the blocks of squared errors of networks that have some with every seed."""
    units = {
        str(entry.path): {"set": set_of(entry), "group": entry.group} for entry in dataset.test
    }
    found = []
    for network, seeds in filled.items():
        runs = [
            [
                block_rows(sums, **units[path], recording=path, network=network, seed=seed)
                for one in content["recordings"]
                for path in [one["path"]]
                if (sums := one["blocks"].get(measure))
            ]
            for seed, content in seeds.items()
        ]
        if all(runs):
            found += [table for run in runs for table in run]
    return found
