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

from stario.fusion.evaluation.figures import write_table
from stario.fusion.evaluation.networks import (
    METRICS,
    PROTOCOLS,
    TRUE_ATTITUDE,
    NetworkTable,
    Sample,
    add_track,
)
from stario.fusion.paper_table.errors import CONVENTION
from stario.fusion.paper_table.runs import Run
from stario.fusion.paper_table.scores import COLUMNS, Completed, SetTable, completed_runs, set_table
from stario.fusion.paper_table.text import WORDS, table_text
from stario.network.architectures import ARCHITECTURES
from stario.network.runtime.cost import table_cost
from stario.network.runtime.survey import ModelRow, survey
from stario.sequences.files import atomic_write, write_json, write_rows
from stario.sequences.sequence import Trajectory


def work_of(tables: Iterable[Completed]) -> pd.DataFrame:
    """Return computing time of training and of evaluation [s], and windows per second of training.

    The index is the network; its times are added up over sets and seeds, its speed is their mean.
    """
    rows = [
        {
            "network": network,
            "training_s": content.get("trained", {}).get("seconds", 0.0),
            "evaluation_s": content["seconds"],
            "windows_per_s": content.get("trained", {}).get("windows_per_s"),
        }
        for completed in tables
        for network, seeds in completed.items()
        for content in seeds.values()
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
    firsts = {network: completed[network].get(0, {}) for network in parameters}
    return NetworkTable(CONVENTION, parameters, found, _samples(firsts))


def _samples(firsts: Mapping[str, Mapping[str, Any]]) -> list[Sample]:
    """Return tracks of some recordings, by the first seed of each network."""
    samples: dict[str, Sample] = {}
    for network, content in firsts.items():
        for one in content.get("recordings", ()):
            name, drawn = one["recording"], one.get("drawn")
            if drawn:
                truth, track = (_level(drawn["time"], drawn[key]) for key in ("truth", "track"))
                sample = samples.setdefault(name, Sample(name, truth, {}, {}))
                add_track(sample, network, track, one["tracks"][TRUE_ATTITUDE])
    return list(samples.values())


def _level(time: Sequence[float], xy: Sequence[Sequence[float]]) -> Trajectory:
    flat = np.column_stack([xy, np.zeros(len(xy))])
    return Trajectory(np.array(time), flat, Rotation.identity(len(xy)))
