"""Layouts of other people's files that were once refused or read wrongly.

Their samples are simulated; the folder beside the project says what each is and what is right.
"""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from recorded import CASES

from stario.fusion.values.config import read_config
from stario.fusion.values.fix_file import read_fixes
from stario.sequences import StarioError, find_recordings, read_recording


def case(name: str) -> Path:
    path = CASES / name
    if not path.exists():
        pytest.skip(f"{path} is missing")
    return path


@pytest.mark.parametrize(
    ("name", "seconds", "rate"),
    [
        ("filetime_100ns/hololens.csv", 15.0, 1000.0),
        ("mars_logger/gyro_accel.csv", 15.0, 100.0),
        ("uzh_fpv_imu_txt/imu.txt", 15.0, 100.0),
        ("euroc_float_seconds", 15.0, 100.0),
        ("realsense_split_topics/realsense_split.bag", 60.0, 100.0),
        ("crash_ten_minutes/first_three_samples_lost_30s.csv", 30.0, 100.0),
        ("compare_pdr_positions/walk.csv", None, None),
    ],
)
def test_a_layout_is_read_at_its_rate(name, seconds, rate):
    path = case(name)
    if path.suffix == ".bag":
        pytest.importorskip("rosbags")
    sequence = read_recording(path)
    assert 5.0 < np.median(np.linalg.norm(sequence.accel, axis=1)) < 15.0
    assert not (sequence.gyro == 0.0).all(axis=1).any()
    if seconds is not None and rate is not None:
        assert sequence.duration == pytest.approx(seconds, abs=0.15)
        assert 1.0 / np.median(np.diff(sequence.time)) == pytest.approx(rate, rel=0.01)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rostopic_echo_text/echo.txt", "rostopic echo -p"),
        ("rostopic_echo_text", "rostopic echo -p"),
        ("folder_of_CalInertialAndMag/walk_CalInertialAndMag.csv", "--rate"),
    ],
)
def test_a_file_is_refused_with_what_to_do(name, words):
    path = case(name)
    for read in (read_recording, *([find_recordings] if path.is_dir() else [])):
        with pytest.raises(StarioError, match=words):
            read(path)


def test_two_exports_without_times_are_two_recordings_at_the_rate_given():
    """Gauss, g and deg/s are named by the titles; a packet counter is no time."""
    found = find_recordings(case("folder_of_CalInertialAndMag"))
    assert [path.stem.split("_")[0] for path in found] == ["stairs", "walk"]
    for path in found:
        read = read_recording(path, rate="256")
        assert 1.0 / np.median(np.diff(read.time)) == pytest.approx(256.0)
        assert np.median(np.linalg.norm(read.accel, axis=1)) == pytest.approx(9.8, rel=0.05)
        assert 20.0 < np.linalg.norm(read.magnetometer.field[0]) < 80.0


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_no_entrance_waits_for_a_pipe(tmp_path):
    for name in ("walk.csv", "gyro.csv", "walk.json", "walk.h5", "walk.zip", "walk.toml"):
        os.mkfifo(tmp_path / name)
    with pytest.raises(StarioError):
        find_recordings(tmp_path)
    for read, name, words in (
        (read_recording, "walk.csv", "found a pipe or device, expected a recording"),
        (find_recordings, "walk.csv", "found a pipe or device, expected a recording"),
        (read_fixes, "walk.csv", r"(?i)pipe or device"),
        (read_config, "walk.toml", r"(?i)pipe or device"),
    ):
        with pytest.raises(StarioError, match=words):
            read(tmp_path / name)


def test_a_zip_of_very_many_files_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "many.zip"
    with zipfile.ZipFile(path, "w") as file:
        for k in range(5001):
            file.writestr(f"{k}.csv", "")
    with pytest.raises(StarioError, match="5001 files"):
        read_recording(path)


def test_times_of_no_possible_year_are_refused(tmp_path):
    """Steps of 10 us in a unit of which the first time lies after the year 2100."""
    rows = [f"{9 * 10**18 + 10**4 * k},0,0,0,0,0,9.8" for k in range(100)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["t,gx,gy,gz,ax,ay,az", *rows]))
    with pytest.raises(StarioError, match="time"):
        read_recording(path)
