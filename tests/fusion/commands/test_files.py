import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stario.network.architectures import build_network
from stario.network.card import Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import load_model, save_model
from stario.sequences import (
    ImuSequence,
    PositionTrack,
    find_recordings,
    generate_walk,
    read_tum,
    simulate_imu,
)
from stario.sequences.readers.archive import write_archive
from stario.sequences.readers.generic_csv import read_generic_csv


@pytest.mark.usefixtures("no_figures")
def test_a_converted_recording_gives_the_same_track(stario, recording, tmp_path):
    assert stario("convert", recording, "there").code == 0
    done = stario("convert", "there", "back.csv")
    assert done.code == 0
    assert "there: EuRoC layout, 12.0 s at 100.0 Hz, no magnetometer" in done.out
    assert "truth: 1201 poses\nwritten: back.csv" in done.out
    for path, out in ((recording, "a"), ("back.csv", "b")):
        assert stario("run", path, "--out", out).code == 0
    a, b = (read_tum(tmp_path / out / "track.tum") for out in "ab")
    np.testing.assert_allclose(a.position_W, b.position_W, atol=0.01)  # times are rounded to 1 ns
    stario("convert", recording, "there").assert_one_line_error("there", "exists")


@pytest.mark.usefixtures("no_figures")
def test_recordings_are_archived_and_selected_from_the_archive(stario, recording, tmp_path):
    (tmp_path / "again").mkdir()
    (tmp_path / "again/walk.csv").write_bytes(recording.read_bytes())
    done = stario("convert", recording, "again", "all.h5")
    assert done.code == 0, done.err
    assert "walk is stored as walk-2\nwritten: all.h5, 2 recordings" in done.out
    done = stario("run", "all.h5", "--where", "name=*-2", "--out", "two")
    assert done.code == 0, done.err
    assert (tmp_path / "two/track.tum").exists()
    assert stario("convert", "all.h5:walk", "one.csv").code == 0
    there, here = read_generic_csv(tmp_path / "one.csv"), read_generic_csv(recording)
    np.testing.assert_array_equal(there.accel, here.accel)
    for arguments in (["run", "all.h5"], ["convert", "all.h5", "out.csv"]):
        stario(*arguments, "--where", "person=eve").assert_one_line_error("person=eve", "none")
    stario("run", "all.h5", "--where", "eve").assert_one_line_error("--where", "attribute=value")
    stario("convert", "all.h5", "out.csv").assert_one_line_error("2 recordings", "all.h5:walk")


def test_an_archive_of_nothing_is_not_written_and_the_reason_is_told(stario, tmp_path):
    (tmp_path / "bad.csv").write_text("t,gx,gy,gz,ax,ay,az\n0,0,0,x,0,0,9.8\n")
    done = stario("convert", "bad.csv", "out.h5")
    done.assert_one_line_error("bad.csv: line 2, gz: found 'x'")
    assert not (tmp_path / "out.h5").exists()


def test_overwrite_replaces_an_euroc_folder_and_nothing_else(stario, recording, tmp_path):
    assert stario("convert", recording, "there").code == 0
    imu = tmp_path / "there/mav0/imu0/data.csv"
    written = imu.read_text()
    imu.write_text("old")
    again = stario("convert", recording, "there")
    again.assert_one_line_error("there, which already exists", "or pass --overwrite")
    assert stario("convert", recording, "there", "--overwrite").code == 0
    assert imu.read_text() == written
    (tmp_path / "there/mav0/cam0.png").touch()
    lost = stario("convert", recording, "there", "--overwrite")
    lost.assert_one_line_error("there/mav0/cam0.png, which would be lost")
    part = stario("convert", "there", imu, "--overwrite")
    part.assert_one_line_error("data.csv, which is also an input")
    assert imu.read_text() == written


def tapped(time: np.ndarray, kind: str) -> ImuSequence:
    """A walk of eight seconds of which no poses are known, but positions at these times."""
    walk = simulate_imu(generate_walk(3, 8.0), 100.0, seed=1, name="taps")
    position_W = walk.truth.at(time).position_W
    known = position_W[:, :2] if kind == "waypoints" else position_W
    return replace(walk, truth=None, positions=PositionTrack(time, known, kind))


@pytest.mark.usefixtures("no_figures")
def test_every_track_is_compared_with_positions_half_a_second_apart(stario, tmp_path):
    write_archive(tmp_path / "taps.h5", [tapped(np.arange(1.0, 7.0, 0.5), "positions")])
    first, head, *rows = stario("compare", "taps.h5", "--tracks", "all").out.splitlines()[:7]
    assert "12 of 12 positions lie within the track" in first
    assert head.split()[:2] == ["positions", "[m]"]
    errors = {row.split()[0]: float(row.split()[1]) for row in rows}
    assert {"track", "pdr", "dead_reckoning"} <= set(errors)
    assert errors["track"] < 2.0


@pytest.mark.usefixtures("no_figures")
def test_waypoints_are_reported_and_do_not_count_as_poses(stario, tmp_path):
    write_archive(tmp_path / "taps.h5", [tapped(np.array([1.0, 6.0]), "waypoints")])
    done = stario("run", "taps.h5")
    assert done.code == 0, done.err
    assert "truth: 2 waypoints" in done.out
    assert done.out.count("2 of 2 waypoints lie within the track") == 1
    stario("evaluate", "taps.h5").assert_one_line_error("2 waypoints, no poses")
    done = stario("convert", "taps.h5", "taps.csv")
    assert done.code == 0
    assert stario("convert", "taps.h5", "again.h5").code == 0
    assert find_recordings(tmp_path / "again.h5") == [Path(f"{tmp_path / 'again.h5'}:taps")]


def test_a_simulated_house_has_floors_pressure_and_satellites(stario, tmp_path):
    done = stario("simulate", "h.csv", "--floors", "--seconds", 180, "--rate", 50, "--json")
    assert done.code == 0
    stays = json.loads(done.out)["stays"]
    sequence = read_generic_csv(tmp_path / "h.csv")
    assert sequence.satellites is not None
    height = sequence.truth.position_W[:, 2]
    assert np.ptp(height) > 2.9 * max(abs(stay["floor"]) for stay in stays) > 0.0
    pressure = 8.43 * np.ptp(sequence.barometer.pressure_hPa)
    assert pressure == pytest.approx(np.ptp(height), abs=2.0)


def test_export_accepts_the_name_of_a_network(stario, tmp_path, monkeypatch):
    """Of its run; without one, StarIO is the default and others require training first."""
    pytest.importorskip("onnx")
    exported = []  # tracing others than StarIO takes seconds
    export_onnx = "stario.network.runtime.export.export_onnx"
    monkeypatch.setattr(export_onnx, lambda *given: exported.append(given))
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
