"""The rows of the table, computed from its runs: means, standard errors, ranks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from stario.fusion.evaluation.bootstrap import Rank, block_rows, ranks
from stario.fusion.evaluation.networks import EKF, OWN_ATTITUDE, TRUE_ATTITUDE
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.scores import Spread, joined, scored
from stario.fusion.paper_table.runs import Run, read_run
from stario.fusion.paper_table.sets import DataSet, set_of
from stario.network.architectures import ARCHITECTURES

REFERENCE_NETWORK = "StarIO"
"""Reference network that the others' errors are compared with."""

Content = Mapping[str, Any]
"""Result of `read_run`."""


def _column(title: str, source: str, name: str, scale: float = 1.0) -> Spread:
    """Return a column of an error of a track, or of a figure of recordings with a kind of truth."""
    where = {"track": source}
    return Spread(title, name, ".3f", where=where, standard_error=True, scale=scale)


COLUMNS = {
    "ate": _column("ATE [m]", TRUE_ATTITUDE, "ate_m"),
    "rte": _column("RTE [m]", TRUE_ATTITUDE, "rte_m"),
    "pde": _column("PDE [%]", TRUE_ATTITUDE, "pde", 100.0),
    "own_ate": _column("own attitude: ATE [m]", OWN_ATTITUDE, "ate_m"),
    "own_rte": _column("own attitude: RTE [m]", OWN_ATTITUDE, "rte_m"),
    "ekf_ate": _column("EKF: ATE [m]", EKF, "ate_m"),
    "ekf_rte": _column("EKF: RTE [m]", EKF, "rte_m"),
    "waypoints_m": _column("waypoints [m]", "waypoints", "ate_fit_m"),
    "waypoints_percent": _column("waypoints [%]", "waypoints", "ate_fit_percent"),
    "waypoints_length": _column("length ratio", "waypoints", "length_ratio"),
    "positions_percent": _column("positions, 20 s [%]", "positions", "stretch_percent"),
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
        seeds: completed seeds.
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
        rows: networks with at least one completed seed.
        measure: the error that networks are ranked by, in words.
        skipped: reasons why recordings were skipped, each once.
    """

    dataset: DataSet
    tested: int
    path_m: float
    rows: list[Row]
    measure: str
    skipped: list[str] = field(default_factory=list)


Completed = dict[str, dict[int, Content]]
"""Contents of a set's runs, by network and seed."""


def completed_runs(runs: Iterable[Run], out: Path) -> dict[str, Completed]:
    """Return the contents of the completed runs, by set.

    Raises:
        ConfigError: a run was completed with another recipe, other weights or other recordings.
    """
    found: dict[str, Completed] = {}
    for run in runs:
        content = read_run(run, out)
        if content is not None:
            networks = found.setdefault(run.dataset.name, {})
            networks.setdefault(run.network, {})[run.seed] = content
    return found


def set_table(
    dataset: DataSet, completed: Completed, learned: Mapping[str, frozenset[Path]]
) -> SetTable:
    """Return the table of a set.

    `learned` has the recordings that packaged weights were trained on, by the weights' name.
    """
    contents = [content for seeds in completed.values() for content in seeds.values()]
    poses = all(recording["kind"] == "poses" for c in contents for recording in c["recordings"])
    measure = "ate" if poses else "10"
    blocks = _blocks(completed, measure, dataset)
    network_ranks = ranks(joined(blocks), REFERENCE_NETWORK) if blocks else {}
    order = [name for name in [PDR, *ARCHITECTURES] if name in completed]
    order += [name for name in completed if name not in order]
    test = {entry.path for entry in dataset.test}
    scores = scores_of(completed)
    rows = [
        _row(
            name,
            completed[name],
            scores[scores["network"] == name],
            network_ranks.get(name),
            len(test & learned.get(name, set())),
        )
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


def seconds_by_network(tables: Iterable[Completed]) -> dict[str, tuple[float, float, float]]:
    """Return seconds of training and of evaluation, and training windows per second, by network."""
    contents: dict[str, list[Content]] = {}
    for completed in tables:
        for name, seeds in completed.items():
            contents.setdefault(name, []).extend(seeds.values())
    work = {}
    for name, found in contents.items():
        trained = [content["trained"] for content in found if "trained" in content]
        speeds = [t["windows"] / t["step_seconds"] for t in trained if t["step_seconds"]]
        training = sum((t["seconds"] for t in trained), 0.0)
        testing = sum(content["seconds"] for content in found)
        work[name] = training, testing, sum(speeds) / len(speeds) if speeds else float("nan")
    return work


def scores_of(completed: Completed) -> pd.DataFrame:
    """Return the errors of every run on a set, with labels `path`, `network` and `seed`.

    The figures of the network alone are those of a track that is called by the kind of truth.
    """
    found = [scored("", {}, path="", network="", seed=0)]
    found += [
        scored(
            one["recording"],
            {**one["tracks"], one["kind"]: one["figures"]},
            one["group"],
            path=one["path"],
            network=network,
            seed=seed,
        )
        for network, seeds in completed.items()
        for seed, content in seeds.items()
        for one in content["recordings"]
    ]
    return joined(found)


def _row(
    name: str, seeds: Mapping[int, Content], scores: pd.DataFrame, rank: Rank | None, learned: int
) -> Row:
    figures = {key: _mean(column, scores) for key, column in COLUMNS.items()}
    trained = [
        scored("", {"": {key: c["trained"][key] for key in _TRAINED}}, seed=seed)
        for seed, c in seeds.items()
        if "trained" in c
    ]
    training, validation = (
        _mean(_column("", "", key), joined(trained)) if trained else None for key in _TRAINED
    )
    known = {key: mean for key, mean in figures.items() if mean is not None}
    return Row(name, sorted(seeds), known, training, validation, rank, learned)


_TRAINED = ("training_error_m2", "validation_error_m2")


def _mean(column: Spread, scores: pd.DataFrame) -> Mean | None:
    mean, error = column.mean_and_spread(scores)
    return None if np.isnan(mean) else Mean(mean, error)


def _blocks(completed: Completed, measure: str, dataset: DataSet) -> list[pd.DataFrame]:
    """Return the blocks of squared errors of networks that have some with every seed."""
    units = {
        str(entry.path): {"set": set_of(entry), "group": entry.group} for entry in dataset.test
    }
    found = []
    for network, seeds in completed.items():
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
