"""OxIOD's unsynchronised files: separate clocks, other captures, the Android phone's rows."""

import logging
from pathlib import Path

import numpy as np
import published_formats as formats
import pytest
from alike import assert_same_poses
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers import find_recordings, read_recording
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

MOUNT_VB = Rotation.from_euler("zyx", [172.0, 3.0, -4.0], degrees=True)
EPOCH_NS = 1_496_840_000_000_000_000


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(4, 60.0, style=WalkStyle("rig")), 100.0, PERFECT_IMU)


def apple_rows(walk: ImuSequence, stamps: list[int]) -> list[str]:
    gravity = walk.truth.attitude_WB.apply([0.0, 0.0, -1.0], inverse=True)
    zeros = np.zeros((len(walk), 3))
    user = walk.accel / -9.81 - gravity
    return formats.text(stamps, np.hstack([zeros, walk.gyro, gravity, user, zeros]))


def capture_rows(
    walk: ImuSequence,
    every: int,
    start: int,
    unit_ns: int,
    ahead: float,
    frame: bool = True,
) -> list[str]:
    """Every `every`-th row of the truth, stamped by a clock `ahead` seconds ahead."""
    rows = slice(300, -200, every)
    truth = walk.truth
    time = truth.time[rows] + ahead
    stamps = [(start + round(t * 1e9)) // unit_ns for t in time.tolist()]
    pose = np.hstack([truth.position_W[rows], (truth.attitude_WB[rows] * MOUNT_VB.inv()).as_quat()])
    frames = [list(range(len(pose)))] if frame else []
    return formats.text(stamps, *frames, pose)


def assert_matches(path: Path, walk: ImuSequence, tolerance_deg: float = 1.0) -> None:
    read = read_recording(path)
    assert read.name.endswith(f"-{path.parent.name}-{path.stem}")
    assert np.abs(read.time - walk.time).max() < 1e-6
    assert np.abs(read.gyro - walk.gyro).max() < 1e-9
    assert np.abs(read.accel - walk.accel).max() < 1e-8
    inside = (walk.time > 3.2) & (walk.time < walk.time[-1] - 2.2)
    assert read.truth.at(walk.time[inside]).valid.mean() > 0.95
    assert_same_poses(read.truth, walk, tolerance_deg, 0.05)


@pytest.mark.parametrize(
    ("name", "unit_ns", "ahead"),
    [("vi1", 1, 0.02), ("hand1", 1000, -1.65), ("tango1", 10**6, 5000.0)],
)
def test_the_capture_is_synchronised_to_the_phones_clock(tmp_path, walk, name, unit_ns, ahead):
    """Nanoseconds, microseconds or milliseconds; seconds apart or of another origin."""
    raw = tmp_path / "pocket/data1/raw"
    formats.save(raw / "imu1.csv", "", apple_rows(walk, formats.stamps_ns(walk.time)))
    every = 3 if name == "tango1" else 1
    start = formats.stamps_ns(np.zeros(1))[0]
    rows = capture_rows(walk, every, start, unit_ns, ahead, frame=name != "tango1")
    formats.save(raw / f"{name}.csv", "", rows)
    assert_matches(raw / "imu1.csv", walk, 3.0 if name == "tango1" else 1.0)


def test_poses_written_while_tracking_was_lost_are_masked(tmp_path, walk):
    stamps = formats.stamps_ns(walk.time)
    formats.save(tmp_path / "raw/imu1.csv", "", apple_rows(walk, stamps))
    rows = capture_rows(walk, 1, stamps[0], 1, 0.0)
    for k in range(1000, 1300):
        rows[k] = ",".join(rows[k].split(",")[:2] + ["0.0"] * 6 + ["1.0"])
    formats.save(tmp_path / "raw/vi1.csv", "", rows)
    truth = read_recording(tmp_path / "raw/imu1.csv").truth
    assert not truth.valid[1000:1300].any()
    assert truth.valid[:990].mean() > 0.95
    assert truth.valid[1310:].mean() > 0.95


def test_swapped_neighbouring_rows_are_put_in_order(tmp_path, walk):
    rows = apple_rows(walk, formats.stamps_ns(walk.time))
    for k in range(100, 5000, 500):
        rows[k], rows[k + 1] = rows[k + 1], rows[k]
    formats.save(tmp_path / "raw/imu1.csv", "", rows)
    read = read_recording(tmp_path / "raw/imu1.csv")
    assert np.array_equal(read.gyro, walk.gyro)
    assert read.truth is None


def test_large_scale_recordings_have_their_truth_in_a_neighbouring_folder(tmp_path, walk):
    floor, start = tmp_path / "large scale/floor4", formats.stamps_ns(np.zeros(1))[0]
    formats.save(floor / "imu/imu2.csv", "", apple_rows(walk, formats.stamps_ns(walk.time)))
    formats.save(floor / "tango/tango2.csv", "", capture_rows(walk, 3, start, 10**6, 0.3))
    assert_matches(floor / "imu/imu2.csv", walk, 3.0)
    assert find_recordings(tmp_path) == [floor / "imu/imu2.csv"]


def test_the_android_phones_rows_hold_one_sensor_each(tmp_path, walk):
    raw = tmp_path / "multi devices/nexus 5/raw"
    stamps = [k // 1000 for k in formats.stamps_ns(walk.time, EPOCH_NS)]
    code = {1: walk.accel, 4: walk.gyro, 2: np.ones((len(walk), 3))}
    rows = [
        row
        for k in range(len(walk))
        for sensor, values in code.items()
        for row in formats.text([stamps[k]], [sensor], values[k : k + 1])
    ]
    formats.save(raw / "imu1.csv", "", rows)
    formats.save(raw / "vi1.csv", "", capture_rows(walk, 1, EPOCH_NS, 1, 0.25))
    assert_matches(raw / "imu1.csv", walk)


def test_a_capture_of_another_motion_is_rejected(tmp_path, walk, caplog):
    formats.save(tmp_path / "raw/imu1.csv", "", apple_rows(walk, formats.stamps_ns(walk.time)))
    rng = np.random.default_rng(0)
    poses = np.hstack([rng.normal(size=(3000, 3)), Rotation.random(3000, rng=rng).as_quat()])
    stamps = formats.stamps_ns(np.arange(3000) / 100.0)
    rows = formats.text(stamps, list(range(3000)), poses)
    formats.save(tmp_path / "raw/vi1.csv", "", rows)
    with caplog.at_level(logging.WARNING):
        assert read_recording(tmp_path / "raw/imu1.csv").truth is None
    assert "ground truth rejected" in caplog.text


def test_times_rounded_too_coarsely_are_refused(tmp_path, walk):
    stamps = formats.stamps_ns(walk.time)
    formats.save(tmp_path / "raw/imu1.csv", "", apple_rows(walk, stamps))
    rows = capture_rows(walk, 1, stamps[0], 1, 0.0)
    rounded = [f"{float(row.split(',')[0]):.4e}," + row.split(",", 1)[1] for row in rows]
    formats.save(tmp_path / "raw/vi1.csv", "", rounded)
    with pytest.raises(ReadError, match=r"vi1\.csv: time: found a step of 0"):
        read_recording(tmp_path / "raw/imu1.csv")
