"""The table: scores of completed runs, means over seeds, ranks; Markdown, JSON, CSV, figures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from stario.fusion.evaluation.bootstrap import Interval, ranks
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.scores import LABELS, joined, over_seeds, scored
from stario.fusion.paper_table.figures import write_figures
from stario.fusion.paper_table.runs import (
    FILTERED,
    OWN_ATTITUDE,
    TRUE_ATTITUDE,
    Drawn,
    Run,
    completed_runs,
)
from stario.fusion.paper_table.sets import DataSet, published
from stario.network.architectures import ARCHITECTURES
from stario.network.runtime.survey import BATCHES, ModelRow, survey
from stario.network.training.config import TrainingConfig
from stario.sequences.accuracy.metrics import CONVENTIONS
from stario.sequences.drawing.text_table import figure, markdown
from stario.sequences.files import atomic_write, write_json

REFERENCE_NETWORK = "StarIO"
"""Reference network that the others' errors are compared with."""

Completed = Sequence[Mapping[str, Any]]
"""Results (`completed_runs`) of a set's runs."""

COLUMNS = {
    "ate": ("ATE [m]", TRUE_ATTITUDE, "ate_m"),
    "rte": ("RTE [m]", TRUE_ATTITUDE, "rte_m"),
    "pde": ("PDE [%]", TRUE_ATTITUDE, "pde"),
    "own_ate": ("own attitude: ATE [m]", OWN_ATTITUDE, "ate_m"),
    "own_rte": ("own attitude: RTE [m]", OWN_ATTITUDE, "rte_m"),
    "filtered_ate": ("filtered: ATE [m]", FILTERED, "ate_m"),
    "filtered_rte": ("filtered: RTE [m]", FILTERED, "rte_m"),
    "waypoints_m": ("waypoints [m]", "waypoints", "ate_fit_m"),
    "waypoints_percent": ("waypoints [%]", "waypoints", "ate_fit_percent"),
    "waypoints_length": ("length ratio", "waypoints", "length_ratio"),
    "positions_percent": ("positions, 20 s [%]", "positions", "stretch_percent"),
    "training_error": ("training error", "trained", "training_error_m2"),
    "validation_error": ("validation error", "trained", "validation_error_m2"),
}
"""Title, track and metric of the table's columns, in order; one without any value on a set is
omitted there."""

_MEASURES = {
    "ate": "position error under the paper's protocol",
    "rms_10s_m": "displacement error over 10 s along the own attitude (waypoint residuals where "
    "there are waypoints)",
}
"""Errors that networks may be ranked by, in words."""


@dataclass(frozen=True, eq=False)
class SetTable:
    """A data set's part of the table.

    Attributes:
        dataset: name, recordings and split.
        scores: errors of every run, as of `test_scores`, PDE in %; those of the training are those
            of a track "trained".
        rows: networks, in order, with their `seeds`, the number of test recordings that given
            weights were trained on (`learned`), mean and standard error over seeds of each of
            `COLUMNS` ("ate", "ate_sem"; NaN if unknown), and the columns of `bootstrap.ranks`.
        about: the split in words, numbers of recordings, the length of the tested paths [m], the
            error that networks are ranked by, and the reasons why recordings were skipped.
    """

    dataset: DataSet
    scores: pd.DataFrame
    rows: pd.DataFrame
    about: dict[str, Any]


def set_table(
    dataset: DataSet, completed: Completed, learned: Mapping[str, frozenset[Path]]
) -> SetTable:
    """Return a set's table, given the recordings that packaged weights have `learned`, by name."""
    scores = _scores(completed)
    paths = scores.dropna(subset="path_m")
    measure = "ate" if set(paths["track"]) <= {"poses"} else "rms_10s_m"
    names = [content["network"] for content in completed]
    tested = paths.drop_duplicates("recording")
    test = {entry.path for entry in dataset.test}
    means = over_seeds(scores)
    blocks = joined(pd.DataFrame(content["blocks"]) for content in completed)
    ranked = ranks(blocks[blocks["metric"] == measure], REFERENCE_NETWORK)
    ranked.loc[ranked["network"] == REFERENCE_NETWORK, "ratio"] = None
    rows = pd.DataFrame(
        {"network": name, "seeds": sorted(c["seed"] for c in completed if c["network"] == name)}
        | {"learned": len(test & learned.get(name, set()))}
        | {
            f"{key}{suffix}": means[of].get((name, track, metric), np.nan)
            for key, (_, track, metric) in COLUMNS.items()
            for suffix, of in (("", "mean"), ("_sem", "sem"))
        }
        for name in sorted(set(names), key=[PDR, *ARCHITECTURES, *names].index)
    )
    failures = [
        failure
        for content in completed
        for failure in [*content["skipped"], *content.get("trained", {}).get("skipped", [])]
    ]
    about = {
        "split": dataset.words,
        "training": len(dataset.training),
        "validation": len(dataset.validation),
        "tested": len(tested),
        "path_m": float(tested["path_m"].sum()),
        "ranks_by": _MEASURES[measure],
        "skipped": [*dict.fromkeys(f"{each['item']}: {each['reason']}" for each in failures)],
    }
    return SetTable(dataset, scores, rows.merge(ranked, "left"), about)


def _scores(completed: Completed) -> pd.DataFrame:
    found = []
    for content in completed:
        found.append(pd.DataFrame(content["scores"]))
        if trained := content.get("trained"):
            errors = {key: trained[key] for key in ("training_error_m2", "validation_error_m2")}
            run = {key: content[key] for key in ("network", "seed")}
            found.append(scored("", {"trained": errors}, **run))
    table = joined(found).set_index([*LABELS, "network", "seed"]).astype(float)
    if "pde" in table:
        table["pde"] *= 100.0
    return table.reset_index()


def work_of(tables: Iterable[Completed]) -> pd.DataFrame:
    """Return computing time of training and of evaluation [s], and windows per second of training.

    The index is the network; its times are added up over sets and seeds, its speed is their mean.
    """
    rows = [
        {
            "network": content["network"],
            "training_s": trained.get("seconds", 0.0),
            "evaluation_s": content["seconds"],
            "windows_per_s": trained.get("windows_per_s"),
        }
        for completed in tables
        for content in completed
        for trained in [content.get("trained", {})]
    ]
    over = {"training_s": "sum", "evaluation_s": "sum", "windows_per_s": "mean"}
    return pd.DataFrame(rows, columns=["network", *over]).groupby("network").agg(over)


def known_costs(names: Sequence[str], out: Path) -> list[ModelRow]:
    """Return parameters, FLOPs, memory and time, measured once per folder and network."""
    path = out / "costs.json"
    rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    columns = {column.name for column in fields(ModelRow)}
    # Rows of an earlier version counted otherwise.
    measured = {row["name"]: ModelRow(**row) for row in rows if row.keys() == columns}
    if missing := [name for name in names if name not in measured]:
        measured |= {row.name: row for row in survey(missing)}
        write_json(path, list(measured.values()))
    return [measured[name] for name in names]


def write_results(
    runs: Sequence[Run],
    out: Path,
    costs: Sequence[ModelRow],
    learned: Mapping[str, frozenset[Path]],
    drawn: bool = True,
) -> str:
    """Write `table.md`, `table.json`, `table.csv` and the figures of each set; return the text.

    Runs need not be completed; `learned` is as for `set_table`; figures are slow (`drawn`).
    """
    completed = completed_runs(runs, out)
    datasets = {run.dataset.name: run.dataset for run in runs}
    tables = {name: set_table(datasets[name], c, learned) for name, c in completed.items()}
    recipe = next(run.recipe for run in runs if run.recipe is not None)
    work = work_of(completed.values())
    text = table_text(list(tables.values()), costs, work, recipe)
    with atomic_write(out / "table.md") as file:
        file.write(text)
    content = {
        "recipe": asdict(recipe),
        "sets": {
            name: table.about | {"rows": table.rows.to_dict("records")}
            for name, table in tables.items()
        },
        "costs": [asdict(row) for row in costs],
        "work": work.to_dict("index"),
        "conventions": WORDS,
    }
    write_json(out / "table.json", content)
    rows = pd.concat({name: table.rows for name, table in tables.items()}, names=["set"])
    means = rows.assign(seeds=rows["seeds"].map(len))[["network", "rank", *COLUMNS, "seeds"]]
    with atomic_write(out / "table.csv") as file:
        means.dropna(axis=1, how="all").droplevel(1).to_csv(file)
    for name, table in tables.items() if drawn else ():
        scores = table.scores
        known = set(scores.loc[scores["track"] == TRUE_ATTITUDE, "network"])
        parameters = {row.name: row.parameters for row in costs if row.name in known}
        if parameters:
            samples = _samples(completed[name])
            write_figures(out / name / "figures", scores, parameters, samples)
    return text


def _samples(completed: Completed) -> dict[str, dict[str, Drawn]]:
    """Return the tracks to draw, of networks trained with the first seed."""
    samples: dict[str, dict[str, Drawn]] = {}
    for content in completed:
        chosen = content["network"] in ARCHITECTURES and content["seed"] == 0
        for recording, drawn in content["drawn"].items() if chosen else ():
            arrays = {key: np.array(values) for key, values in drawn.items()}
            samples.setdefault(recording, {})[content["network"]] = arrays
    return samples


def table_text(
    tables: Sequence[SetTable],
    costs: Sequence[ModelRow],
    work: pd.DataFrame,
    recipe: TrainingConfig,
) -> str:
    """Return the tables of all sets, the costs and the conventions as Markdown.

    The recipe is common to all networks except for its network and seed.
    """
    words = (
        f"All networks: {recipe.steps} training steps of {recipe.batch} windows, peak learning "
        f"rate {recipe.rate:g}, {recipe.precision}, {recipe.attitude} attitude. On sets with weak "
        f"truth, each step also learns from stretches of {recipe.waypoint_seconds} s between "
        f"waypoints ({recipe.waypoint_stretches} per step) and of {recipe.track_seconds} s along "
        f"positions ({recipe.track_stretches} per step)."
    )
    sets = [_set_text(table) for table in tables]
    return "\n\n".join([words, *sets, _cost_text(costs, work), WORDS]) + "\n"


def _set_text(table: SetTable) -> str:
    about, known = table.about, table.rows[[*COLUMNS]].notna().any()
    columns = [key for key in COLUMNS if known[key]]
    titles = ["network", *(COLUMNS[key][0] for key in columns), "seeds", "rank"]
    lines = [[*titles, f"error / {REFERENCE_NETWORK}'s", "paper: ATE, RTE [m]"]]
    for row in table.rows.to_dict("records"):
        rank, ratio, errors = "-", "-", "-"
        if not np.isnan(row["rank"]):
            rank = "{rank:.0f} [{rank_low:.0f}, {rank_high:.0f}]".format(**row)
        if isinstance(row["ratio"], Interval):
            ratio = f"{row['ratio']:.2f}"
        if paper := published(table.dataset.name, row["network"]):
            errors = "{:.3f}, {:.3f}".format(*paper)
        cells = [_mean(row[key], row[f"{key}_sem"]) for key in columns]
        title = _title(row, about["tested"])
        lines.append([title, *cells, str(len(row["seeds"])), rank, ratio, errors])
    words = (
        "{training} recordings for training, {validation} for validation, {tested} for testing "
        "({path_m:.0f} m); {split}. Ranks and ratios are based on the geometric mean over "
        "recordings of the {ranks_by}."
    ).format(**about)
    text = [f"### {table.dataset.title}", "", words, "", *markdown(lines)]
    if skipped := about["skipped"]:
        text += ["", f"Skipped: {len(skipped)} recordings, listed in `table.json`."]
    return "\n".join(text)


def _mean(mean: float, error: float) -> str:
    return figure(mean) if np.isnan(error) else f"{figure(mean)} +- {figure(error)}"


def _title(row: Mapping[str, Any], tested: int) -> str:
    if row["network"] == PDR:
        return "pedestrian dead reckoning (`pdr`)"
    if row["network"] in ARCHITECTURES:
        return str(row["network"])
    note = f", trained on {row['learned']} of these {tested}" if row["learned"] else ""
    return f"weights `{row['network']}`{note}"


def _cost_text(costs: Sequence[ModelRow], work: pd.DataFrame) -> str:
    times = [f"ms per window, batch {batch}" for batch in BATCHES]
    titles = ["network", "parameters [10^6] (paper)", "FLOPs [10^6] (paper)", "memory [MB]", *times]
    rows = [[*titles, "core hours", "training windows / s"]]
    done = work.reindex([row.name for row in costs])
    for row, (_, spent) in zip(costs, done.iterrows(), strict=True):
        milliseconds = row.milliseconds["torch"] or {}
        hours = spent[["training_s", "evaluation_s"]].sum() / 3600.0
        speed = spent["windows_per_s"]
        cells = [f"{milliseconds[str(batch)]:.2f}" for batch in BATCHES]
        cells = [f"{row.peak_memory_mb:.1f}", *cells, f"{hours:.2f}", figure(speed, ".0f")]
        rows.append([row.name, *row.counts(), *cells])
    training, testing = work[["training_s", "evaluation_s"]].sum() / 3600.0
    return "\n".join(
        [
            *("### Costs", "", *markdown(rows), ""),
            f"Total: {training + testing:.2f} core hours, {training:.2f} for training and "
            f"{testing:.2f} for evaluation. Time per window: on this machine, one thread per core "
            "that PyTorch uses; memory: weights and results of one inference "
            "(`stario check models`).",
        ]
    )


WORDS = (
    "ATE, RTE and PDE: horizontal, means over recordings, first poses aligned in yaw and position; "
    f"{CONVENTIONS['ate_m']}; {CONVENTIONS['rte_m']}; {CONVENTIONS['pde']}. "
    "Squares are also averaged over coordinates, as in RoNIN's code and the paper: multiply by "
    "sqrt(2) for the norm. The first three columns follow the paper's protocol: windows turned "
    "by the true attitude. Waypoints: residual after a fit in yaw and position, in m and in % "
    "of the path, and the length of the track over that of the truth. Positions: error within "
    "stretches of 20 s, each fitted, in % of the path. Training and validation error: mean "
    "squared displacement error of windows [m^2] in the last epoch and in the best one, whose "
    "weights are kept (in validation, legs count in m^2/s). +-: standard error over training "
    "seeds, for one split. Ranks and ratios: equal weights of sets and of the groups (people, "
    "places) in a set. Intervals (95 %): bootstrap over groups, recordings and blocks of 30 s, "
    "with the same draws for all networks; seeds are averaged."
)
