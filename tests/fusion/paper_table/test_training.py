"""What a run's training passes on: the recipe's shares, the error of the epoch that is kept."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stario.fusion.paper_table import training
from stario.fusion.paper_table.sets import DataSet
from stario.fusion.paper_table.training import ReaderConfig, run_recipe, train_run
from stario.network.training.history import EpochReport
from stario.sequences.files import write_json
from stario.sequences.readers import read_recording
from stario.sequences.readers.csv_writer import write_csv


@pytest.fixture
def dataset(make_walk: Any, tmp_path: Path) -> DataSet:
    files = [tmp_path / f"{name}.csv" for name in "abc"]
    for seed, path in enumerate(files):
        write_csv(path, make_walk(seed=seed, seconds=8.0))
    return DataSet("own", tuple(files[:2]), (files[2],), (), "")


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Replace training by a log with three epochs; holds the weight of each stream."""
    found: dict[str, float] = {}

    def trained(
        recipe: Any, streams: Any, weights: Any, held_out: Any, folder: Path, **rest: Any
    ) -> None:
        found.update((s.name, w * len(s)) for s, w in zip(streams, weights, strict=True))
        errors = (0.5, 0.1), (0.4, float("nan")), (0.3, 0.2)
        write_json(
            folder / "log.json",
            [asdict(EpochReport(k, *pair, {})) for k, pair in enumerate(errors, 1)],
        )

    monkeypatch.setattr(training, "train", trained)
    return found


def trained_cell(dataset: DataSet, folder: Path, **values: object) -> dict[str, object]:
    recipe = run_recipe({"likelihood_from": 0.0, "epochs": 3, **values}, "StarIO", 0, None)
    return train_run(dataset, recipe, folder, ReaderConfig(read_recording, {}, folder / "cache"))


def test_the_validation_error_is_that_of_the_epoch_whose_weights_are_kept(
    dataset: DataSet, weights: dict[str, float], tmp_path: Path
) -> None:
    done = trained_cell(dataset, tmp_path)
    assert (done["training_error_m2"], done["validation_error_m2"]) == (0.3, 0.1)


def test_the_shares_of_the_recipe_are_used(
    dataset: DataSet, weights: dict[str, float], tmp_path: Path
) -> None:
    trained_cell(dataset, tmp_path, shares={"a.csv": 0.9}, augmentation={"speeds": [1.0, 1.0]})
    shares = np.array([weights["a"], weights["b"]]) / sum(weights.values())
    assert shares == pytest.approx([0.9, 0.1], abs=0.01)
