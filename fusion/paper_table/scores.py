"""Scores of completed runs: a frame for each set, means over seeds, ranks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from stario.fusion.evaluation.bootstrap import block_rows, ranks
from stario.fusion.evaluation.networks import FILTERED, OWN_ATTITUDE, TRUE_ATTITUDE
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.scores import Spread, joined, scored
from stario.fusion.paper_table.runs import Run, read_run
from stario.fusion.paper_table.sets import DataSet, set_of
from stario.network.architectures import ARCHITECTURES

REFERENCE_NETWORK = "StarIO"
"""Reference network that the others' errors are compared with."""

Completed = Sequence[Mapping[str, Any]]
"""Results (`read_run`) of a set's runs."""


def _column(title: str, track: str, name: str, scale: float = 1.0) -> Spread:
    where = {"track": track}
    return Spread(title, name, ".3f", where=where, standard_error=True, scale=scale)


COLUMNS = {
    "ate": _column("ATE [m]", TRUE_ATTITUDE, "ate_m"),
    "rte": _column("RTE [m]", TRUE_ATTITUDE, "rte_m"),
    "pde": _column("PDE [%]", TRUE_ATTITUDE, "pde", 100.0),
    "own_ate": _column("own attitude: ATE [m]", OWN_ATTITUDE, "ate_m"),
    "own_rte": _column("own attitude: RTE [m]", OWN_ATTITUDE, "rte_m"),
    "filtered_ate": _column("filtered: ATE [m]", FILTERED, "ate_m"),
    "filtered_rte": _column("filtered: RTE [m]", FILTERED, "rte_m"),
    "waypoints_m": _column("waypoints [m]", "waypoints", "ate_fit_m"),
    "waypoints_percent": _column("waypoints [%]", "waypoints", "ate_fit_percent"),
    "waypoints_length": _column("length ratio", "waypoints", "length_ratio"),
    "positions_percent": _column("positions, 20 s [%]", "positions", "stretch_percent"),
    "training_error": _column("training error", "trained", "training_error_m2"),
    "validation_error": _column("validation error", "trained", "validation_error_m2"),
}
"""Columns of the table, in order; a column without any value on a set is omitted there."""

_MEASURES = {
    "ate": "position error under the paper's protocol",
    "10": "displacement error over 10 s along the own attitude (waypoint residuals where there are "
    "waypoints)",
}
"""Errors that networks may be ranked by, in words."""


@dataclass(frozen=True, eq=False)
class SetTable:
    """A data set's part of the table.

    Attributes:
        dataset: name, recordings and split.
        scores: errors of every run, with labels `path`, `network` and `seed`; figures of the
            network alone are those of a track that is called by the kind of truth, errors of the
            training those of a track "trained".
        rows: networks, in order, with their `seeds`, the number of test recordings that given
            weights were trained on (`learned`), mean and standard error over seeds of each of
            `COLUMNS` ("ate", "ate_sem"; NaN if unknown), and the columns of `bootstrap.ranks`.
        tested: number of tested recordings.
        path_m: total length of their true paths [m].
        measure: the error that networks are ranked by, in words.
        skipped: reasons why recordings were skipped, each once.
    """

    dataset: DataSet
    scores: pd.DataFrame
    rows: pd.DataFrame
    tested: int
    path_m: float
    measure: str
    skipped: list[str]

    def as_dict(self) -> dict[str, object]:
        """Return the set's part of `table.json`."""
        return {
            "split": self.dataset.words,
            "training": len(self.dataset.training),
            "validation": len(self.dataset.validation),
            "tested": self.tested,
            "path_m": self.path_m,
            "ranks_by": self.measure,
            "rows": self.rows.to_dict("records"),
            "skipped": self.skipped,
        }


def completed_runs(runs: Iterable[Run], out: Path) -> dict[str, list[Mapping[str, Any]]]:
    """Return the results of the completed runs, by set.

    Raises:
        ConfigError: a run was completed with another recipe, other weights or other recordings.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for run in runs:
        if (content := read_run(run, out)) is not None:
            found.setdefault(run.dataset.name, []).append(content)
    return found


def set_table(
    dataset: DataSet, completed: Completed, learned: Mapping[str, frozenset[Path]]
) -> SetTable:
    """Return the table of a set.

    `learned` has the recordings that packaged weights were trained on, by the weights' name.
    """
    recordings = completed[0]["recordings"]
    poses = all(one["kind"] == "poses" for content in completed for one in content["recordings"])
    measure = "ate" if poses else "10"
    names = [content["network"] for content in completed]
    test = {entry.path for entry in dataset.test}
    scores = _scores(completed)
    rows = pd.DataFrame(
        {"network": name, "seeds": sorted(c["seed"] for c in completed if c["network"] == name)}
        | {"learned": len(test & learned.get(name, set()))}
        | _means(scores[scores["network"] == name])
        for name in sorted(set(names), key=[PDR, *ARCHITECTURES, *names].index)
    )
    failures = [
        failure
        for content in completed
        for failure in [*content["skipped"], *content.get("trained", {}).get("skipped", [])]
    ]
    return SetTable(
        dataset,
        scores,
        rows.merge(ranks(_blocks(completed, measure, dataset), REFERENCE_NETWORK), "left"),
        len(recordings),
        float(sum(recording["path_m"] for recording in recordings)),
        _MEASURES[measure],
        list(dict.fromkeys(f"{failure['item']}: {failure['reason']}" for failure in failures)),
    )


def _means(scores: pd.DataFrame) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for key, column in COLUMNS.items():
        found[key], found[f"{key}_sem"] = column.mean_and_spread(scores)
    return found


def _scores(completed: Completed) -> pd.DataFrame:
    found = [scored("", {}, path="", network="", seed=0)]
    for content in completed:
        labels: dict[str, Any] = {key: content[key] for key in ("network", "seed")}
        for one in content["recordings"]:
            figures = {**one["tracks"], one["kind"]: one["figures"]}
            labels["path"] = one["path"]
            found.append(scored(one["recording"], figures, one["group"], **labels))
        if trained := content.get("trained"):
            errors = {key: trained[key] for key in ("training_error_m2", "validation_error_m2")}
            found.append(scored("", {"trained": errors}, **labels | {"path": ""}))
    return joined(found)


def _blocks(completed: Completed, measure: str, dataset: DataSet) -> pd.DataFrame:
    """Return the blocks of squared errors of networks that have some with every seed."""
    units = {str(e.path): {"set": set_of(e), "group": e.group} for e in dataset.test}
    found, without = [block_rows([], set="", group="", recording="", network="", seed=0)], set()
    for content in completed:
        run = {key: content[key] for key in ("network", "seed")}
        known = {
            one["path"]: one["blocks"][measure]
            for one in content["recordings"]
            if one["blocks"].get(measure)
        }
        if not known:
            without.add(content["network"])
        found += [block_rows(b, **units[path], recording=path, **run) for path, b in known.items()]
    table = joined(found)
    return table[~table["network"].isin(without)]
