"""Rows of the table from known errors: scales, recordings already learned, hours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from stario.fusion.paper_table.published import published
from stario.fusion.paper_table.sets import DataSet
from stario.fusion.paper_table.table import COLUMNS, set_table, table_text, work_of
from stario.network.runtime.survey import ModelRow
from stario.network.training.config import TrainingConfig
from stario.sequences.datasets.splits import ListEntry

TESTED = tuple(ListEntry(Path(f"ridi.h5:{name}"), "ridi") for name in "ab")
DATASET = DataSet("own", (Path("ridi.h5:c"),), (Path("ridi.h5:d"),), TESTED, "")


def content(ate_m: float, seconds: float = 0.0) -> Mapping[str, Any]:
    """Results on both recordings, the second without a drift."""
    tracks = [
        {"network_true_attitude": {"ate_m": ate_m, "rte_m": 2.0, "pde": pde}}
        for pde in (0.03, None)
    ]
    recordings = [
        {"recording": entry.path.name, "path": str(entry.path), "group": "ridi", "kind": "poses"}
        | {"path_m": 50.0, "figures": {}}
        | {"tracks": found, "blocks": {"ate": [[ate_m**2, 1.0]]}}
        for entry, found in zip(TESTED, tracks, strict=True)
    ]
    return {"recordings": recordings, "skipped": [], "seconds": seconds}


def trained(ate_m: float) -> Mapping[str, Any]:
    work = {"windows_per_s": 200.0, "seconds": 7200.0, "skipped": []}
    errors = {"training_error_m2": 0.1, "validation_error_m2": 0.2}
    return {**content(ate_m, seconds=1800.0), "trained": work | errors}


def test_errors_are_means_over_recordings_in_their_units() -> None:
    rows = set_table(DATASET, {"pdr": {0: content(1.5)}}, {}).rows
    assert rows["ate"].item() == 1.5
    assert rows["pde"].item() == pytest.approx(3.0)  # in %, where it is known
    known = [key for key in COLUMNS if rows[key].notna().any()]
    assert known == ["ate", "rte", "pde"]


def test_recordings_that_weights_have_learned_are_counted_among_the_tested_ones() -> None:
    learned = {"default": frozenset({TESTED[0].path, *DATASET.training, *DATASET.validation})}
    table = set_table(DATASET, {"default": {0: content(1.0)}, "open": {0: content(1.0)}}, learned)
    rows = table.rows.to_dict("records")
    assert [(row["network"], row["learned"]) for row in rows] == [("default", 1), ("open", 0)]


def test_work_is_told_in_core_hours_and_windows_per_second() -> None:
    completed = {"StarIO": {0: trained(1.0), 1: trained(1.2)}}
    work = work_of([completed])
    assert work.loc["StarIO"].tolist() == [14400.0, 3600.0, 200.0]
    times = {"torch": {"1": 1.0, "64": 0.5}}
    costs = [ModelRow("StarIO", 2_761_650, 25_124_210, 2_761_682, times, 11.2)]
    text = table_text([set_table(DATASET, completed, {})], costs, work, TrainingConfig())
    assert "| StarIO | 2.762 (2.762) | 25.124 (25.122) | 11.2 | 1.00 | 0.50 | 5.00 | 200 |" in text
    assert "Total: 5.00 core hours, 4.00 for training and 1.00 for evaluation" in text


def test_published_figures_are_found_by_set_and_network() -> None:
    assert published("ridi", "StarIO") == (2.033, 2.274)
    assert published("oxiod", "R-ResNet") == (4.336, 1.595)
    assert published("ridi", "pdr") is None
    assert published("tyrex", "StarIO") is None
