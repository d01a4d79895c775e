"""Comparison table of networks, for tracks with known errors."""

import csv
import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from stario.fusion.evaluation.figures import figures, write_table
from stario.fusion.evaluation.networks import (
    METRICS,
    PROTOCOLS,
    NetworkTable,
    network_table,
    networks_on,
)
from stario.fusion.evaluation.scores import scored, values
from stario.fusion.values.config import NavigatorConfig
from stario.network.model import weights_named
from stario.sequences.errors import InputError, WeightsError


class ConstantDisplacement:
    """A model that predicts a displacement of `drift` metres along x for every window."""

    def __init__(self, name: str, drift: float) -> None:
        self.name, self.drift = name, drift

    def predict(self, windows):
        mean = np.tile([self.drift, 0.0, 0.0], (len(windows), 1))
        return mean, np.tile(0.01 * np.eye(3), (len(windows), 1, 1))


MODELS = [
    ("a", ConstantDisplacement("StarIO", 0.1)),
    ("b", ConstantDisplacement("StarIO", 0.3)),
    ("c", ConstantDisplacement("R-ResNet", 1.0)),
]


@pytest.fixture(scope="module")
def compared(make_walk):
    """Return a function that compares models on simulated walks of some seeds."""

    def compared(seeds, models=MODELS, convention="rms"):
        found = [
            networks_on(
                Path("walk"),
                models,
                NavigatorConfig(),
                lambda path, seed=seed: make_walk(seed=seed, seconds=12.0),
                convention,
            )
            for seed in seeds
        ]
        return network_table(found, models, convention)

    return compared


@pytest.fixture(scope="module")
def table(compared):
    return compared([1, 2])


def test_a_recording_without_true_poses_is_refused(make_walk):
    blind = make_walk(seed=3, seconds=12.0).without_truth()
    with pytest.raises(InputError, match="truth"):
        networks_on(Path("blind"), MODELS, NavigatorConfig(), lambda path: blind)


def test_every_network_has_every_track_of_every_recording(table):
    assert list(table.parameters) == ["StarIO", "R-ResNet"]
    assert table.parameters["R-ResNet"] == 4_634_882
    for protocol, (weights, count) in product(PROTOCOLS, {"a": 2, "b": 2, "c": 2}.items()):
        found = values(table.scores, "ate_m", track=protocol, weights=weights)
        assert found.shape == (count,)


def test_mean_and_spread_are_taken_over_weights_of_recording_means(table):
    a, b = (
        values(table.scores, "ate_m", track="network", weights=weights).mean() for weights in "ab"
    )
    mean, spread = table.column("StarIO", "network", "ate_m").mean_and_spread(table.scores)
    assert mean == pytest.approx((a + b) / 2)
    assert spread == pytest.approx(abs(a - b) / np.sqrt(2))
    other = table.column("R-ResNet", "network", "ate_m")
    single, no_spread = other.mean_and_spread(table.scores)
    assert no_spread is None
    assert single == pytest.approx(
        values(table.scores, "ate_m", track="network", weights="c").mean()
    )


def test_a_recording_at_rest_has_no_share_of_its_path_and_no_warning():
    figures = {"ate_m": 0.1, "rte_m": 0.1, "pde": None}
    scores = scored("rest", dict.fromkeys(PROTOCOLS, figures), network="StarIO", weights="a")
    known = NetworkTable("rms", {"StarIO": 1}, scores, [])
    rows = {tuple(line.split()) for line in known.text().splitlines()}
    assert {("rest", "0.100"), ("rest", "-"), ("mean", "-")} < rows


def test_the_ronin_convention_is_smaller_by_the_square_root_of_two(table, compared):
    ronin = compared([1], MODELS[2:], "ronin")
    ours, theirs = (
        values(found.scores, "ate_m", track="network", network="R-ResNet")[0]
        for found in (table, ronin)
    )
    assert theirs == pytest.approx(ours / np.sqrt(2))
    assert "convention ronin" in ronin.text()


def test_text_names_networks_recordings_convention_and_units(table):
    text = table.text()
    for word in ("StarIO", "R-ResNet", "walk-1", "walk-2", "+-", "convention rms", "RTE [m]"):
        assert word in text


def test_csv_and_json_hold_the_same_figures(table, tmp_path):
    write_table(tmp_path, table)
    assert {path.name for path in tmp_path.iterdir()} == {
        "networks.csv",
        "networks.json",
        "ate_parameters.png",
        "distributions.png",
        "pde.png",
        "trajectories.png",
    }
    with (tmp_path / "networks.csv").open() as file:
        rows = list(csv.DictReader(file))
    content = json.loads((tmp_path / "networks.json").read_text())
    assert content == json.loads(json.dumps(table.as_dict()))
    for row, entry in zip(rows, content["entries"], strict=True):
        assert row["recording"] == entry["recording"]
        for metric in METRICS:
            assert float(row[metric]) == pytest.approx(entry[metric])
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")


def test_no_panel_of_the_drift_cuts_its_boxes(table):
    for axes in figures(table)["pde.png"].axes:
        assert axes.get_ylim()[0] == 0.0
        assert axes.dataLim.y1 <= axes.get_ylim()[1]


def test_weights_are_found_by_network_name_in_the_runs_folder(tmp_path):
    assert weights_named("StarIO", tmp_path) == "default"
    assert weights_named("some/file.onnx", tmp_path) == "some/file.onnx"
    with pytest.raises(WeightsError, match=r"stario train --model 'RNIN'"):
        weights_named("RNIN", tmp_path)
    (tmp_path / "RNIN").mkdir()
    (tmp_path / "RNIN" / "model.safetensors").touch()
    assert weights_named("RNIN", tmp_path) == tmp_path / "RNIN" / "model.safetensors"
