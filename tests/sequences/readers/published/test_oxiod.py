from pathlib import Path

import numpy as np
import published_formats as formats
import pytest
from alike import assert_same_poses, assert_upright, turned_and_measured
from recorded import DATA
from scipy.spatial.transform import Rotation

from stario.sequences import ImuSequence, ReadError, WalkStyle, generate_walk
from stario.sequences.readers import find_recordings, read_recording
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu

MOUNT_VB = Rotation.from_euler("zyx", [172.0, 3.0, -4.0], degrees=True)
TILT_WW = Rotation.from_euler("xy", [0.5, -0.6], degrees=True)
EPOCH_NS = 1_496_840_000_000_000_000
OXIOD = DATA / "oxiod"


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(4, 60.0, style=WalkStyle("rig")), 100.0, PERFECT_IMU)


def apple_rows(walk: ImuSequence, stamps: list[int] | list[str] | None = None) -> list[str]:
    stamps = stamps or formats.stamps_ns(walk.time)
    gravity = walk.truth.attitude_WB.apply([0.0, 0.0, -1.0], inverse=True)
    zeros = np.zeros((len(walk), 3))
    user = walk.accel / -9.81 - gravity
    return formats.text(stamps, np.hstack([zeros, walk.gyro, gravity, user, zeros]))


def capture_rows(
    walk: ImuSequence, every: int = 1, unit_ns: int = 1, ahead: float = 0.0, frame: bool = True,
    start: int = formats.START_NS,
) -> list[str]:  # fmt: skip
    """Every `every`-th row of the truth, stamped by a clock `ahead` seconds ahead."""
    rows = slice(300, -200, every)
    truth = walk.truth
    time = truth.time[rows] + ahead
    stamps = [(start + round(t * 1e9)) // unit_ns for t in time.tolist()]
    pose = np.hstack([truth.position_W[rows], (truth.attitude_WB[rows] * MOUNT_VB.inv()).as_quat()])
    frames = [list(range(len(pose)))] if frame else []
    return formats.text(stamps, *frames, pose)


def write_raw(folder: Path, imu: list[str], capture: list[str], name: str = "vi1") -> Path:
    """Write rows with clocks of their own; return the path of the IMU's."""
    formats.save(folder / "raw/imu1.csv", "", imu)
    if capture:
        formats.save(folder / f"raw/{name}.csv", "", capture)
    return folder / "raw/imu1.csv"


# --- rows in step ----------------------------------------------------------------------------


def write_syn(folder: Path, walk: ImuSequence, flip_row: int | None = None) -> tuple[Path, Path]:
    """Write rows in step, whose times are useless: a lagging body that glitches, a tilted world."""
    stamps, rows = ["1.4955e+11"] * len(walk), np.minimum(np.arange(len(walk)) + 3, len(walk) - 1)
    imu, capture = folder / "syn/imu1.csv", folder / "syn/vi1.csv"
    formats.save(imu, "", apple_rows(walk, stamps))
    attitude_WV = TILT_WW * walk.truth.attitude_WB[rows] * MOUNT_VB.inv()
    quat, position = attitude_WV.as_quat(), TILT_WW.apply(walk.truth.position_W[rows])
    if flip_row is not None:
        half_turn = Rotation.from_euler("x", 178.0, degrees=True)
        quat[flip_row:] = (attitude_WV[flip_row:] * half_turn).as_quat()
    quat[700:705] = Rotation.from_rotvec([1.0, 2.0, -1.0]).as_quat()
    position[900:904] += 0.5
    frames = np.arange(12071.0, 12071.0 + len(walk))[:, None]
    formats.save(capture, "", formats.text(stamps, np.hstack([frames, position, quat]).round(7)))
    return imu, capture


def test_the_imus_pose_is_returned_in_a_level_world(tmp_path, walk):
    imu, capture = write_syn(tmp_path / "handheld/data9", walk)
    read = read_recording(imu)
    truth = read.truth
    assert read.name == "handheld-data9-imu1"
    assert np.abs(read.time - walk.time).max() < 1e-9
    assert np.abs(read.gyro - walk.gyro).max() < 1e-9
    assert np.abs(read.accel - walk.accel).max() < 1e-8
    assert truth.time[0] - read.time[0] == pytest.approx(0.03, abs=0.002)
    assert_same_poses(truth, walk, 2.0, 0.1)
    assert not truth.valid[[*range(700, 705), *range(900, 904)]].any()
    assert truth.valid.mean() > 0.97
    capture.unlink()
    assert read_recording(imu).truth is None
    renamed = imu.rename(imu.with_name("phone.csv"))
    assert read_recording(renamed).truth is None  # a file is not taken as its own truth


def test_a_flip_of_the_tracked_body_is_undone(tmp_path, walk):
    truth = read_recording(write_syn(tmp_path, walk, flip_row=3000)[0]).truth
    assert truth.valid[3100:-20].mean() > 0.95
    assert_same_poses(truth, walk, 2.0, 0.1)


def test_missing_samples_and_poses_do_not_spoil_the_truth_around_them(tmp_path, walk):
    imu, capture = write_syn(tmp_path, walk)
    lines = imu.read_text().splitlines()
    lines[2000] = ",".join(["1.4955e+11", *["nan"] * 15])
    imu.write_text("\n".join(lines))
    rows = [line.split(",") for line in capture.read_text().splitlines()]
    for row in rows[7::10]:
        row[-7:] = ["nan"] * 7
    capture.write_text("\n".join(",".join(row) for row in rows))
    read = read_recording(imu)
    assert np.isnan(read.gyro[2000]).all()
    assert read.truth.covers(read.time[50:-50]).mean() > 0.97
    assert_same_poses(read.truth, walk, 2.0, 0.1)


@pytest.mark.parametrize("rows", [1, 20, 500])
def test_too_short_a_recording_to_determine_the_mount_has_no_truth(tmp_path, walk, rows, caplog):
    imu, capture = write_syn(tmp_path, walk)
    for path in (imu, capture):
        path.write_text("\n".join(path.read_text().splitlines()[:rows]))
    read = read_recording(imu)
    assert len(read) == rows
    assert read.truth is None
    assert "to find the mount" in caplog.text
    imu.write_text("\n".join([imu.read_text()] * 2))
    with pytest.raises(ReadError, match=rf"vi1\.csv: rows: found {rows}, expected {2 * rows}"):
        read_recording(imu)


# --- clocks of their own ---------------------------------------------------------------------


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
    tango = name == "tango1"
    rows = capture_rows(walk, 3 if tango else 1, unit_ns, ahead, frame=not tango)
    path = write_raw(tmp_path / "pocket/data1", apple_rows(walk), rows, name)
    assert_matches(path, walk, 3.0 if tango else 1.0)


def test_poses_written_while_tracking_was_lost_are_masked(tmp_path, walk):
    rows = capture_rows(walk)
    for k in range(1000, 1300):
        rows[k] = ",".join(rows[k].split(",")[:2] + ["0.0"] * 6 + ["1.0"])
    truth = read_recording(write_raw(tmp_path, apple_rows(walk), rows)).truth
    assert not truth.valid[1000:1300].any()
    assert truth.valid[:990].mean() > 0.95
    assert truth.valid[1310:].mean() > 0.95


def test_swapped_neighbouring_rows_are_put_in_order(tmp_path, walk):
    rows = apple_rows(walk)
    for k in range(100, 5000, 500):
        rows[k], rows[k + 1] = rows[k + 1], rows[k]
    read = read_recording(write_raw(tmp_path, rows, []))
    assert np.array_equal(read.gyro, walk.gyro)
    assert read.truth is None


def test_large_scale_recordings_have_their_truth_in_a_neighbouring_folder(tmp_path, walk):
    floor = tmp_path / "large scale/floor4"
    formats.save(floor / "imu/imu2.csv", "", apple_rows(walk))
    formats.save(floor / "tango/tango2.csv", "", capture_rows(walk, 3, 10**6, 0.3))
    assert_matches(floor / "imu/imu2.csv", walk, 3.0)
    assert find_recordings(tmp_path) == [floor / "imu/imu2.csv"]


def test_the_android_phones_rows_hold_one_sensor_each(tmp_path, walk):
    stamps = [k // 1000 for k in formats.stamps_ns(walk.time, EPOCH_NS)]
    code = {1: walk.accel, 4: walk.gyro, 2: np.ones((len(walk), 3))}
    rows = [
        row
        for k in range(len(walk))
        for sensor, values in code.items()
        for row in formats.text([stamps[k]], [sensor], values[k : k + 1])
    ]
    capture = capture_rows(walk, ahead=0.25, start=EPOCH_NS)
    assert_matches(write_raw(tmp_path / "multi devices/nexus 5", rows, capture), walk)


def test_a_capture_of_another_motion_is_rejected(tmp_path, walk, caplog):
    rng = np.random.default_rng(0)
    poses = np.hstack([rng.normal(size=(3000, 3)), Rotation.random(3000, rng=rng).as_quat()])
    stamps = formats.stamps_ns(np.arange(3000) / 100.0)
    rows = formats.text(stamps, list(range(3000)), poses)
    assert read_recording(write_raw(tmp_path, apple_rows(walk), rows)).truth is None
    assert "ground truth rejected" in caplog.text


def test_times_rounded_too_coarsely_are_refused(tmp_path, walk):
    cells = [row.split(",", 1) for row in capture_rows(walk)]
    rounded = [f"{float(stamp):.4e},{others}" for stamp, others in cells]
    with pytest.raises(ReadError, match=r"vi1\.csv: time: found a step of 0"):
        read_recording(write_raw(tmp_path, apple_rows(walk), rounded))


# --- recordings ------------------------------------------------------------------------------

SELECTED = (
    OXIOD / "handheld/data1/syn/imu2.csv",  # flips at 149 s
    OXIOD / "multi users/user2/syn/imu6.csv",  # flips at 252 s
    OXIOD / "trolley/data2/syn/imu1.csv",  # turns about the vertical only
)


def assert_consistent(path: Path) -> None:
    sequence = read_recording(path)
    truth = sequence.truth
    stride = 10
    true, measured = turned_and_measured(sequence, truth, stride)
    inside = (truth.time > sequence.time[0]) & (truth.time < sequence.time[-1]) & truth.valid
    good = inside[:-stride] & inside[stride:]
    true, measured = true[good], measured[good]
    assert np.corrcoef(true.ravel(), measured.ravel())[0, 1] > 0.95
    # No flip or glitch remains: over 0.1 s the two rotations agree to a few degrees.
    difference = np.degrees(np.linalg.norm(true - measured, axis=1))
    assert np.percentile(difference, 99.9) < 15.0
    assert truth.valid.mean() > 0.97
    steps = np.linalg.norm(np.diff(truth.position_W, axis=0), axis=1)
    assert steps[truth.valid[:-1] & truth.valid[1:]].max() < 0.05  # 5 m/s
    assert_upright(sequence, 0.1, 0.15)
    field = sequence.magnetometer
    inside = (field.time >= truth.time[0]) & (field.time <= truth.time[-1])
    pose = truth.at(field.time[inside])
    field_W = pose.attitude_WB.apply(field.field[inside])[pose.valid]
    assert 10.0 < np.linalg.norm(field_W.mean(axis=0)) < 60.0
    assert np.linalg.norm(field_W.std(axis=0)) < 0.6 * np.linalg.norm(field_W.mean(axis=0))


@pytest.mark.skipif(not OXIOD.is_dir(), reason=f"no recordings at {OXIOD}")
@pytest.mark.parametrize(
    "path",
    [
        path if path in SELECTED else pytest.param(path, marks=pytest.mark.slow)
        for path in (find_recordings(OXIOD) if OXIOD.is_dir() else SELECTED)
    ],
    ids=str,
)
def test_recordings_are_self_consistent(path):
    assert_consistent(path)
