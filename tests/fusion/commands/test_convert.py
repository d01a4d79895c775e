"""The command `convert`: layouts, archives, and waypoints that survive them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.sequences.readers import find_recordings
from stario.sequences.readers.archive import write_archive
from stario.sequences.readers.generic_csv import read_generic_csv
from stario.sequences.readers.tum import read_tum
from stario.sequences.sequence import PositionTrack
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import generate_walk


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


@pytest.mark.usefixtures("no_figures")
def test_every_track_is_compared_with_positions_half_a_second_apart(stario, tmp_path):
    walk = simulate_imu(generate_walk(3, 8.0), 100.0, seed=1, name="taps")
    time = np.arange(1.0, 7.0, 0.5)
    known = PositionTrack(time, walk.truth.at(time).position_W, "positions")
    write_archive(tmp_path / "taps.h5", [replace(walk, truth=None, positions=known)])
    head, *rows = stario("compare", "taps.h5", "--tracks", "all").out.splitlines()[1:7]
    assert head.split()[:2] == ["positions", "[m]"]
    errors = {row.split()[0]: float(row.split()[1]) for row in rows}
    assert {"track", "pdr", "dead_reckoning"} <= set(errors)
    assert errors["track"] < 2.0


@pytest.mark.usefixtures("no_figures")
def test_waypoints_are_reported_and_do_not_count_as_poses(stario, tmp_path):
    walk = simulate_imu(generate_walk(3, 8.0), 100.0, seed=1, name="taps")
    taps = PositionTrack(np.array([1.0, 6.0]), np.zeros((2, 2)), "waypoints")
    write_archive(tmp_path / "taps.h5", [replace(walk, truth=None, positions=taps)])
    for command, tracks in (("run", 1), ("inspect", 0), ("compare", 1)):
        done = stario(command, "taps.h5")
        assert done.code == 0, done.err
        assert command == "compare" or "truth: 2 waypoints" in done.out
        assert done.out.count("2 of 2 waypoints lie within the track") == tracks
    stario("evaluate", "taps.h5").assert_one_line_error("2 waypoints, no poses")
    done = stario("convert", "taps.h5", "taps.csv")
    assert done.code == 0
    assert stario("convert", "taps.h5", "again.h5").code == 0
    assert find_recordings(tmp_path / "again.h5") == [Path(f"{tmp_path / 'again.h5'}:taps")]
