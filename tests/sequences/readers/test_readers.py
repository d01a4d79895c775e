import logging
from pathlib import Path

import numpy as np
import published_formats as formats
import pytest
from alike import assert_same_poses, turned_and_measured
from recorded import DATA
from scipy.spatial.transform import Rotation

from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers import find_recordings, read_recording, write_csv
from stario.sequences.readers.published.euroc import read_euroc
from stario.sequences.readers.published.oxiod import read_oxiod
from stario.sequences.sequence import BoolArray, ImuSequence
from stario.sequences.simulation.imu import PERFECT_IMU, PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}")

EUROC_IMU = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
EUROC_TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
)
TUMVI_TRUTH = EUROC_TRUTH.split(", v_RS")[0]
MOUNT_VB = Rotation.from_euler("zyx", [172.0, 3.0, -4.0], degrees=True)
TILT_WW = Rotation.from_euler("xy", [0.5, -0.6], degrees=True)


@pytest.fixture(scope="module")
def walk():
    style = WalkStyle(carry="handheld", preferred_speed=1.0)
    return simulate_imu(generate_walk(4, 40.0, style=style), rate=200.0, errors=PHONE_IMU)


@pytest.fixture(scope="module")
def phone_walk():
    return simulate_imu(generate_walk(4, 60.0, style=WalkStyle("rig")), 100.0, PERFECT_IMU)


def write_euroc(
    folder: Path, imu: ImuSequence, velocity: bool, keep: BoolArray | None = None
) -> None:
    """Write EuRoC (with velocity) or TUM-VI; truth at 100 Hz without the first 2 s and last 3 s."""
    rows = formats.text(formats.stamps_ns(imu.time), imu.gyro, imu.accel)
    formats.save(folder / "mav0/imu0/data.csv", EUROC_IMU, rows)
    truth = imu.truth
    part = slice(400, -600, 2)
    quat_wxyz = truth.quat_xyzw[:, [3, 0, 1, 2]]
    table = np.hstack([truth.position_W, quat_wxyz])
    if velocity:
        assert truth.velocity_W is not None
        table = np.hstack([table, truth.velocity_W])
    rows = formats.text(formats.stamps_ns(truth.time[part]), table[part])
    rows = rows if keep is None else [row for row, kept in zip(rows, keep, strict=True) if kept]
    name = "state_groundtruth_estimate0" if velocity else "mocap0"
    formats.save(folder / f"mav0/{name}/data.csv", EUROC_TRUTH if velocity else TUMVI_TRUTH, rows)


def write_oxiod(
    folder: Path, imu: ImuSequence, lag_rows: int = 3, flip_row: int | None = None
) -> Path:
    """Write OxIOD files: Apple's signs, a mounted and lagging tracked body, a tilted world."""
    truth = imu.truth
    force = imu.accel / -9.81
    gravity = truth.attitude_WB.apply([0.0, 0.0, -1.0], inverse=True)
    angles = np.zeros((len(imu), 3))
    table = np.hstack([angles, imu.gyro, gravity, force - gravity, angles])
    first = ["1.4955e+11"] * len(imu)
    formats.save(folder / "syn/imu1.csv", "", formats.text(first, table))
    rows = np.minimum(np.arange(len(imu)) + lag_rows, len(imu) - 1)
    attitude_WV = TILT_WW * truth.attitude_WB[rows] * MOUNT_VB.inv()
    quat = attitude_WV.as_quat()
    position = TILT_WW.apply(truth.position_W[rows])
    if flip_row is not None:
        flipped = attitude_WV[flip_row:] * Rotation.from_euler("x", 178.0, degrees=True)
        quat[flip_row:] = flipped.as_quat()
    quat[700:705] = Rotation.from_rotvec([1.0, 2.0, -1.0]).as_quat()
    position[900:904] += 0.5
    frames = np.arange(12071.0, 12071.0 + len(imu))[:, None]
    table = np.hstack([frames, position, quat]).round(7)
    formats.save(folder / "syn/vi1.csv", "", formats.text(first, table))
    return folder / "syn/imu1.csv"


@pytest.mark.parametrize("velocity", [True, False], ids=["euroc", "tumvi"])
def test_euroc_and_tumvi_are_read_back(tmp_path, walk, velocity):
    write_euroc(tmp_path / "room", walk, velocity)
    read = read_recording(tmp_path / "room")
    truth, given = read.truth, walk.truth
    assert read.name == "room"
    assert np.abs(read.time - walk.time).max() < 2e-9
    assert np.abs(read.gyro - walk.gyro).max() < 1e-10
    assert np.abs(read.accel - walk.accel).max() < 1e-10
    assert np.abs(truth.time - given.time[400:-600:2]).max() < 2e-9
    assert np.abs(truth.position_W - given.position_W[400:-600:2]).max() < 1e-6
    assert (truth.attitude_WB.inv() * given.attitude_WB[400:-600:2]).magnitude().max() < 1e-6
    assert truth.valid.all()
    assert (truth.velocity_W is not None) == velocity
    if truth.velocity_W is not None and given.velocity_W is not None:
        assert np.abs(truth.velocity_W - given.velocity_W[400:-600:2]).max() < 1e-6


def test_euroc_is_found_by_folder_mav0_and_file(tmp_path, walk):
    write_euroc(tmp_path / "room", walk, velocity=False)
    for inner in ("", "mav0", "mav0/imu0/data.csv"):
        read = read_recording(tmp_path / "room" / inner)
        assert read.name == "room"
        assert read.truth is not None


def test_a_gap_in_the_truth_stays_a_gap(tmp_path, walk):
    keep = np.ones(len(walk.time[400:-600:2]), dtype=np.bool_)
    keep[1000:1500] = False
    write_euroc(tmp_path, walk, velocity=False, keep=keep)
    pose = read_euroc(tmp_path).truth.at(walk.time)
    lost = (walk.time > 11.991) & (walk.time < 16.999)
    outside = (walk.time < 1.999) | (walk.time > walk.time[-600] + 0.01)
    assert not pose.valid[lost].any()
    assert not pose.valid[outside].any()
    assert pose.valid[~lost & (walk.time > 2.001) & (walk.time < walk.time[-604])].all()


def test_truth_that_is_not_the_imus_pose_is_ignored(tmp_path, walk):
    write_euroc(tmp_path, walk, velocity=False)
    (tmp_path / "mav0/mocap0").rename(tmp_path / "mav0/vicon0")
    assert read_euroc(tmp_path).truth is None


def test_oxiod_returns_the_imus_pose_in_a_level_world(tmp_path, phone_walk):
    read = read_recording(write_oxiod(tmp_path / "handheld/data9", phone_walk))
    truth = read.truth
    assert read.name == "handheld-data9-imu1"
    assert np.abs(read.time - phone_walk.time).max() < 1e-9
    assert np.abs(read.gyro - phone_walk.gyro).max() < 1e-9
    assert np.abs(read.accel - phone_walk.accel).max() < 1e-8
    assert truth.time[0] - read.time[0] == pytest.approx(0.03, abs=0.002)
    assert_same_poses(truth, phone_walk, 2.0, 0.1)
    assert not truth.valid[700:705].any()
    assert not truth.valid[900:904].any()
    assert truth.valid.mean() > 0.97


def test_oxiod_flip_of_the_tracked_body_is_undone(tmp_path, phone_walk):
    truth = read_oxiod(write_oxiod(tmp_path, phone_walk, flip_row=3000)).truth
    assert truth.valid[3100:-20].mean() > 0.95
    assert_same_poses(truth, phone_walk, 2.0, 0.1)


def test_oxiod_without_a_capture_file_has_no_truth(tmp_path, phone_walk):
    imu = write_oxiod(tmp_path, phone_walk)
    (tmp_path / "syn/vi1.csv").unlink()
    assert read_recording(imu).truth is None
    renamed = imu.rename(tmp_path / "phone.csv")
    assert read_recording(renamed).truth is None  # a file is not taken as its own truth


def test_oxiod_gaps_in_the_imu_do_not_affect_the_truth(tmp_path, phone_walk):
    imu = write_oxiod(tmp_path, phone_walk)
    lines = imu.read_text().splitlines()
    lines[2000] = ",".join(["1.4955e+11", *["nan"] * 15])
    imu.write_text("\n".join(lines))
    read = read_oxiod(imu)
    assert np.isnan(read.gyro[2000]).all()
    assert_same_poses(read.truth, phone_walk, 2.0, 0.1)


def test_oxiod_poses_next_to_missing_ones_are_used(tmp_path, phone_walk):
    imu = write_oxiod(tmp_path, phone_walk)
    vicon = tmp_path / "syn/vi1.csv"
    rows = [line.split(",") for line in vicon.read_text().splitlines()]
    for row in rows[7::10]:
        row[-7:] = ["nan"] * 7
    vicon.write_text("\n".join(",".join(row) for row in rows))
    read = read_oxiod(imu)
    assert read.truth.covers(read.time[50:-50]).mean() > 0.97
    assert_same_poses(read.truth, phone_walk, 2.0, 0.1)


@pytest.mark.parametrize("rows", [1, 20, 500])
def test_oxiod_too_short_to_determine_the_mount_has_no_truth(tmp_path, phone_walk, rows, caplog):
    imu = write_oxiod(tmp_path, phone_walk)
    for path in (imu, tmp_path / "syn/vi1.csv"):
        path.write_text("\n".join(path.read_text().splitlines()[:rows]))
    with caplog.at_level(logging.WARNING):
        read = read_oxiod(imu)
    assert len(read) == rows
    assert read.truth is None
    assert "to find the mount" in caplog.text


def test_oxiod_requires_as_many_truth_rows_as_imu_rows(tmp_path, phone_walk):
    imu = write_oxiod(tmp_path, phone_walk)
    vicon = tmp_path / "syn/vi1.csv"
    vicon.write_text("\n".join(vicon.read_text().splitlines()[:-100]))
    with pytest.raises(ReadError, match=r"vi1\.csv: rows: found 5901, expected 6001"):
        read_oxiod(imu)


@pytest.mark.parametrize(
    ("corrupt", "message"),
    [
        (lambda lines: [*lines[:50], lines[50].rsplit(",", 4)[0]], "line 51: found 3 values"),
        (lambda lines: [row.rsplit(",", 1)[0] for row in lines], "line 2: found 6 values"),
        (lambda lines: [*lines[:9], lines[9].replace(".", "x", 1)], "line 10, column 2: found '"),
        (lambda lines: [*lines[:9], "soon" + lines[9][4:]], "line 10, column 1: found 'soon"),
        (lambda lines: [*lines[:9], "nan" + lines[9][19:]], "line 10, time: found 'nan'"),
        (lambda lines: lines[:1], "rows: found none below the header"),
        (lambda lines: [], "file: found no line"),
    ],
    ids=["truncated", "missing column", "not a number", "no time", "nan time", "header", "empty"],
)
def test_malformed_files_are_named_in_one_line(tmp_path, walk, corrupt, message):
    write_euroc(tmp_path, walk, velocity=False)
    imu = tmp_path / "mav0/imu0/data.csv"
    imu.write_text("\n".join(corrupt(imu.read_text().splitlines())))
    with pytest.raises(ReadError) as caught:
        read_recording(tmp_path)
    assert "imu0/data.csv" in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_formats_are_recognised_by_content(tmp_path, walk, phone_walk):
    write_csv(tmp_path / "imu7.csv", walk.without_truth())  # named like OxIOD's
    assert np.array_equal(read_recording(tmp_path / "imu7.csv").gyro, walk.gyro)
    oxiod = write_oxiod(tmp_path, phone_walk).rename(tmp_path / "mine.csv")
    assert np.abs(read_recording(str(oxiod)).gyro - phone_walk.gyro).max() < 1e-9
    with pytest.raises(ReadError, match="header"):
        read_recording(oxiod, format="csv")


def test_unknown_content_is_shown_with_where_to_find_the_known_formats(tmp_path):
    path = tmp_path / "imu.csv"
    for text, seen in (
        ("0.0,1,2,3,4,5,6\n", "0.0,1,2,3,4,5,6"),
        ("PK\x00\x01", "no line of text"),
        ("", "no line of text"),
        ("seconds;speed\n", "seconds;speed"),
    ):
        path.write_text(text)
        with pytest.raises(ReadError) as caught:
            read_recording(path)
        assert seen in str(caught.value)
        assert "--help" in str(caught.value)
    with pytest.raises(ReadError, match="no such file"):
        read_recording(tmp_path / "none.csv")
    with pytest.raises(ReadError, match=r"a folder with imu\.csv; imu\.csv holds 'seconds;"):
        read_recording(tmp_path)
    with pytest.raises(
        InputError, match=r"format: found 'bags', expected one of auto, archive, ronin, .*, csv"
    ):
        read_recording(path, format="bags")


def test_find_recordings_searches_folders_in_order(tmp_path, walk, phone_walk):
    imu = write_oxiod(tmp_path / "b/data1", phone_walk)
    raw = tmp_path / "b/data1/raw"
    raw.mkdir()
    (raw / "imu1.csv").write_bytes(imu.read_bytes())
    write_euroc(tmp_path / "a", walk, velocity=False)
    write_csv(tmp_path / "c.csv", walk)
    (tmp_path / "notes.csv").write_text("day,who\n1,me\n")
    (tmp_path / ".hidden").mkdir()
    write_csv(tmp_path / ".hidden/d.csv", walk)
    assert find_recordings(tmp_path) == [tmp_path / "a", imu, tmp_path / "c.csv"]
    assert find_recordings(imu) == [imu]
    assert find_recordings(str(tmp_path / "a")) == [tmp_path / "a"]
    (tmp_path / "nothing").mkdir()
    with pytest.raises(ReadError, match="a folder with nothing"):
        find_recordings(tmp_path / "nothing")
    with pytest.raises(ReadError, match="no such file"):
        find_recordings(tmp_path / "none")


RECORDED = [
    ("tumvi/dataset-room3_512_16", 0.95, 1.0),  # an accelerometer bias appears as tilt here
    ("euroc/V1_02_medium", 0.95, 1.0),
]


@needs_data
@pytest.mark.parametrize(("name", "least", "tilt_deg"), RECORDED)
def test_recorded_truth_agrees_with_the_sensors(name, least, tilt_deg):
    """The gyroscope is the derivative of the attitude; the mean force is gravity, pointing up."""
    sequence = read_recording(DATA / name)
    truth = sequence.truth
    inside = (sequence.time >= truth.time[0]) & (sequence.time <= truth.time[-1])
    pose = truth.at(sequence.time[inside])
    stride = round(0.04 * sequence.rate)
    turned, measured = turned_and_measured(sequence, pose, stride)
    good = pose.valid[:-stride] & pose.valid[stride:]
    pair = np.corrcoef(turned[good].ravel(), measured[good].ravel())
    assert pair[0, 1] > least
    assert pose.valid.mean() > 0.85
    up = pose.attitude_WB.apply(sequence.accel[inside])[pose.valid].mean(axis=0)
    assert np.degrees(np.arctan2(np.hypot(up[0], up[1]), up[2])) < tilt_deg
    assert np.linalg.norm(up) == pytest.approx(9.8, abs=0.05)
