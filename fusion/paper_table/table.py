"""The table's files: Markdown, JSON, CSV and figures, all from the scores of completed runs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.bootstrap import Interval
from stario.fusion.evaluation.figures import write_table
from stario.fusion.evaluation.networks import METRICS, PROTOCOLS, NetworkTable, Sample
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.paper_table.runs import CONVENTION, Run
from stario.fusion.paper_table.scores import (
    COLUMNS,
    REFERENCE_NETWORK,
    Completed,
    SetTable,
    completed_runs,
    set_table,
)
from stario.fusion.paper_table.sets import published
from stario.network.architectures import ARCHITECTURES
from stario.network.runtime.cost import table_cost
from stario.network.runtime.survey import BATCHES, ModelRow, survey
from stario.network.training.config import TrainingConfig
from stario.sequences.accuracy.metrics import CONVENTIONS
from stario.sequences.files import atomic_write, write_json, write_rows
from stario.sequences.sequence import Trajectory


def work_of(tables: Iterable[Completed]) -> pd.DataFrame:
    """Return computing time of training and of evaluation [s], and windows per second of training.

    The index is the network; its times are added up over sets and seeds, its speed is their mean.
    """
    rows = [
        {
            "network": content["network"],
            "training_s": content.get("trained", {}).get("seconds", 0.0),
            "evaluation_s": content["seconds"],
            "windows_per_s": content.get("trained", {}).get("windows_per_s"),
        }
        for completed in tables
        for content in completed
    ]
    over = {"training_s": "sum", "evaluation_s": "sum", "windows_per_s": "mean"}
    return pd.DataFrame(rows, columns=["network", *over]).groupby("network").agg(over)


def known_costs(names: Sequence[str], out: Path) -> list[ModelRow]:
    """Return parameters, FLOPs, memory and time, measured once per folder and network."""
    path = out / "costs.json"
    measured = {}
    if path.exists():
        rows = [ModelRow(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
        measured = {row.name: row for row in rows}
    missing = [name for name in names if name not in measured]
    if missing:
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
        "sets": {name: table.as_dict() for name, table in tables.items()},
        "costs": [asdict(row) for row in costs],
        "work": work.to_dict("index"),
        "conventions": WORDS,
    }
    write_json(out / "table.json", content)
    means = [
        {"set": name, **row[["network", "rank", *COLUMNS]].dropna(), "seeds": len(row["seeds"])}
        for name, table in tables.items()
        for _, row in table.rows.iterrows()
    ]
    write_rows(out / "table.csv", means)
    for name, table in tables.items() if drawn else ():
        found = _for_figures(table, completed[name])
        if found is not None:
            write_table(out / name / "figures", found)
    return text


def _for_figures(table: SetTable, completed: Completed) -> NetworkTable | None:
    """Return the networks' errors on recordings with poses, for the figures; None without any."""
    scores = table.scores
    parameters = {
        name: table_cost(name).parameters for name in table.rows["network"] if name in ARCHITECTURES
    }
    chosen = scores["network"].isin(parameters) & scores["track"].isin(PROTOCOLS)
    chosen &= scores["metric"].isin(METRICS)
    if not chosen.any():
        return None
    found = scores[chosen].rename(columns={"seed": "weights"})
    found["weights"] = "seed " + found["weights"].astype(str)
    samples: dict[str, Sample] = {}
    firsts = {content["network"]: content for content in completed if content["seed"] == 0}
    for network in parameters:
        for one in firsts[network]["recordings"] if network in firsts else ():
            if drawn := one.get("drawn"):
                truth = np.pad(np.array(drawn["truth"]), ((0, 0), (0, 1)))
                path = Trajectory(np.array(drawn["time"]), truth, Rotation.identity(len(truth)))
                sample = samples.setdefault(one["recording"], Sample(one["recording"], path, {}))
                sample.tracks[network] = np.array(drawn["track"])
    return NetworkTable(CONVENTION, parameters, found, list(samples.values()))


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
    dataset, known = table.dataset, table.rows[[*COLUMNS]].notna().any()
    columns = [column for key, column in COLUMNS.items() if known[key]]
    titles = ["network", *(column.title for column in columns), "seeds", "rank"]
    lines = [[*titles, f"error / {REFERENCE_NETWORK}'s", "paper: ATE, RTE [m]"]]
    for row in table.rows.to_dict("records"):
        part = table.scores[table.scores["network"] == row["network"]]
        rank, ratio, errors = "-", "-", "-"
        if not np.isnan(row["rank"]):
            rank = "{rank:.0f} [{rank_low:.0f}, {rank_high:.0f}]".format(**row)
        if isinstance(row["ratio"], Interval):
            ratio = f"{row['ratio']:.2f}"
        if paper := published(dataset.name, row["network"]):
            errors = "{:.3f}, {:.3f}".format(*paper)
        cells = [column.text(part) for column in columns]
        title = _title(row, table.tested)
        lines.append([title, *cells, str(len(row["seeds"])), rank, ratio, errors])
    return "\n".join(
        [
            f"### {dataset.title}",
            "",
            f"{len(dataset.training)} recordings for training, {len(dataset.validation)} for "
            f"validation, {table.tested} for testing ({table.path_m:.0f} m); {dataset.words}. "
            "Ranks and ratios are based on the geometric mean over recordings of the "
            f"{table.measure}.",
            "",
            *_markdown(lines),
            *(["", f"Skipped: {len(table.skipped)} recordings, listed in `table.json`."]
              if table.skipped else []),
        ]
    )  # fmt: skip


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
        cells = [f"{row.peak_memory_mb:.1f}", *cells, f"{hours:.2f}"]
        rows.append([row.name, *row.counts(), *cells, "-" if np.isnan(speed) else f"{speed:.0f}"])
    training, testing = work[["training_s", "evaluation_s"]].sum() / 3600.0
    return "\n".join(
        [
            *("### Costs", "", *_markdown(rows), ""),
            f"Total: {training + testing:.2f} core hours, {training:.2f} for training and "
            f"{testing:.2f} for evaluation. Time per window: on this machine, one thread per core "
            "that PyTorch uses; memory: weights and results of one inference "
            "(`stario check models`).",
        ]
    )


def _markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table's lines without columns that have no value; the first row holds the titles."""
    columns = [c for c in zip(*rows, strict=True) if any(cell != "-" for cell in c[1:])]
    head, *body = (f"| {' | '.join(cells)} |" for cells in zip(*columns, strict=True))
    return [head, f"|{'---|' * len(columns)}", *body]


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
