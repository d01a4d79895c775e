"""The commands that write recordings and networks: simulate and export."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from stario.network.architectures import build_network
from stario.network.card import Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import load_model, save_model
from stario.sequences.readers.generic_csv import read_generic_csv


def test_simulate_writes_a_recording_with_truth(stario, tmp_path):
    done = stario("simulate", "w.csv", "--seconds", 5, "--rate", 50, "--seed", 7, "--json")
    assert done.code == 0
    figures = json.loads(done.out)
    sequence = read_generic_csv(tmp_path / "w.csv")
    assert figures["samples"] == len(sequence) == 251
    assert figures["duration_s"] == pytest.approx(5.0)
    assert sequence.truth is not None
    stario("simulate", "again.csv", "--seconds", 5, "--rate", 50, "--seed", 7)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "w.csv").read_bytes()


def test_a_simulated_house_has_floors_pressure_and_satellites(stario, tmp_path):
    done = stario("simulate", "h.csv", "--floors", "--seconds", 120, "--rate", 50, "--json")
    assert done.code == 0
    stays = json.loads(done.out)["stays"]
    sequence = read_generic_csv(tmp_path / "h.csv")
    assert sequence.satellites is not None
    height = sequence.truth.position_W[:, 2]
    assert np.ptp(height) > 2.9 * max(abs(stay["floor"]) for stay in stays) > 0.0
    pressure = 8.43 * np.ptp(sequence.barometer.pressure_hPa)
    assert pressure == pytest.approx(np.ptp(height), abs=2.0)


def test_simulate_replaces_a_recording_only_on_request(stario, tmp_path):
    own = tmp_path / "own.csv"
    own.write_text("own")
    refused = stario("simulate", "own.csv", "--seconds", 5)
    assert refused.code == 1
    assert "--overwrite" in refused.err
    assert own.read_text() == "own"
    assert stario("simulate", "own.csv", "--seconds", 5, "--overwrite").code == 0
    assert len(read_generic_csv(own)) == 1001


def test_export_accepts_the_name_of_a_network(stario, tmp_path, monkeypatch):
    """Of its run; without one, StarIO is the default and others require training first."""
    pytest.importorskip("onnx")
    exported = []  # tracing others than StarIO takes seconds
    monkeypatch.setattr(
        "stario.network.runtime.export.export_onnx", lambda *given: exported.append(given)
    )
    done = stario("export", "--model", "StarIO")
    assert (done.code, done.out) == (0, "StarIO.onnx\n")
    [(model, path)] = exported
    assert (model.card, path) == (load_model("default").card, Path("StarIO.onnx"))
    stario("export", "--model", "R-ResNet").assert_one_line_error(
        "runs/R-ResNet/model.safetensors", "stario train --model 'R-ResNet'"
    )
    torch.manual_seed(0)
    network = DisplacementNetwork(build_network("R-ResNet"))
    save_model(tmp_path / "mine/R-ResNet/model.safetensors", network, Card(architecture="R-ResNet"))
    done = stario("export", "--model", "R-ResNet", "--runs", "mine", "--out", "r.onnx")
    assert done.code == 0, done.err
    assert [(model.name, path) for model, path in exported[1:]] == [("R-ResNet", Path("r.onnx"))]


def test_an_exported_graph_cannot_be_trained(stario):
    pytest.importorskip("onnx")
    assert stario("export", "--out", "exported.onnx").code == 0
    done = stario("train", "nowhere.csv", "--start-from", "exported.onnx")
    done.assert_one_line_error("an exported graph")
    assert "nowhere.csv" not in done.err  # nothing is read first
