"""Tables and figures written next to the runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
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
from stario.fusion.paper_table.errors import CONVENTION, Shown
from stario.fusion.paper_table.runs import Run, read_tracks
from stario.fusion.paper_table.summary import (
    COLUMNS,
    Completed,
    SetTable,
    completed_runs,
    scores_of,
    seconds_by_network,
    set_table,
)
from stario.fusion.paper_table.text import table_dict, table_text
from stario.network.architectures import ARCHITECTURES
from stario.network.runtime.cost import table_cost
from stario.network.runtime.survey import ModelRow, survey
from stario.sequences.files import atomic_write, write_json, write_rows
from stario.sequences.sequence import FloatArray, Trajectory


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
    tables = [set_table(datasets[name], found, learned) for name, found in completed.items()]
    recipe = next(run.recipe for run in runs if run.recipe is not None)
    work = seconds_by_network(completed.values())
    text = table_text(tables, costs, work, recipe)
    with atomic_write(out / "table.md") as file:
        file.write(text)
    write_json(out / "table.json", table_dict(tables, costs, work, recipe))
    write_rows(out / "table.csv", _rows(tables))
    for name, found in completed.items() if drawn else ():
        samples = _samples([run for run in runs if run.dataset.name == name], found, out)
        table = _network_table(found, samples)
        if table is not None:
            write_table(out / name / "figures", table)
    return text


def _rows(tables: Sequence[SetTable]) -> list[dict[str, object]]:
    """Return a row for each network on each set: means over seeds."""
    return [
        {"set": table.dataset.name, "network": row.network, "seeds": len(row.seeds)}
        | {key: row.figures[key].value if key in row.figures else "" for key in COLUMNS}
        | {"rank": "" if row.rank is None else row.rank.rank}
        for table in tables
        for row in table.rows
    ]


def _network_table(completed: Completed, samples: list[Sample]) -> NetworkTable | None:
    """Return the networks' errors on recordings with poses, for the figures; None without any."""
    parameters = {name: table_cost(name).parameters for name in ARCHITECTURES if name in completed}
    scores = scores_of(completed)
    chosen = scores["network"].isin(parameters) & scores["track"].isin(PROTOCOLS)
    chosen &= scores["metric"].isin(METRICS)
    if not chosen.any():
        return None
    found = scores[chosen].rename(columns={"seed": "weights"})
    found["weights"] = "seed " + found["weights"].astype(str)
    return NetworkTable(CONVENTION, parameters, found, samples)


def _samples(runs: Sequence[Run], completed: Completed, out: Path) -> list[Sample]:
    """Return tracks of some recordings, by each network's first seed."""
    samples: dict[str, Sample] = {}
    for run in runs:
        content = completed.get(run.network, {}).get(run.seed)
        if run.recipe is None or run.seed != 0 or content is None:
            continue
        found = {recording["recording"]: recording["tracks"] for recording in content["recordings"]}
        for name, shown in read_tracks(run, out).items():
            sample = samples.setdefault(name, Sample(name, _level(shown, shown.truth_W), {}, {}))
            track = _level(shown, shown.position_W)
            add_track(sample, run.network, track, found[name][TRUE_ATTITUDE])
    return list(samples.values())


def _level(shown: Shown, xy: FloatArray) -> Trajectory:
    flat = np.column_stack([xy, np.zeros(len(xy))])
    return Trajectory(shown.time, flat, Rotation.identity(len(xy)))
