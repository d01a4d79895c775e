"""What a format leaves open: attitude sources, quaternion orders, frames, topics, clocks."""

import dataclasses
import json
import sys

import numpy as np
import published_formats as formats
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.conventions import with_conventions
from stario.sequences.errors import InputError, ReadError
from stario.sequences.inspection.checks import check_units
from stario.sequences.readers import find_recordings, read_recording, write_csv
from stario.sequences.readers.bag import read_bag
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.units import with_units


def max_angle(a: Rotation, b: Rotation) -> float:
    return float((a.inv() * b).magnitude().max())


def relative_to_first(attitude: Rotation) -> Rotation:
    """Attitude relative to its first sample."""
    return attitude[0].inv() * attitude


@pytest.mark.parametrize(
    ("errors", "source"),
    [
        ({"grv_ori_error": 19.9, "ekf_ori_error": 1.0}, "game_rv"),
        ({"grv_ori_error": 20.1, "ekf_ori_error": 5.0}, "ekf"),
        ({"grv_ori_error": 25.0, "ekf_ori_error": 30.0, "gyro_integration_error": 40.0}, "game_rv"),
        ({"grv_ori_error": 25.0, "ekf_ori_error": 30.0, "gyro_integration_error": 10.0}, "gyro"),
    ],
)
def test_ronin_uses_the_attitude_source_that_its_authors_use(tmp_path, walks, errors, source):
    walk = walks(200.0)
    recording = formats.ronin(tmp_path / "a000_1", walk, **errors)
    attitude = read_recording(recording.path).truth.attitude_WB
    true = walk.truth.attitude_WB
    if source == "ekf":  # the writer makes it drift about the vertical
        drift = Rotation.from_rotvec(np.outer(walk.time, [0.0, 0.0, 0.01]))
        true = drift * true
    limit = 2e-3 if source == "gyro" else 1e-6
    assert max_angle(attitude, true[100:]) < limit
    if source == "gyro":
        assert max_angle(relative_to_first(attitude), relative_to_first(true[100:])) > 1e-9


def test_ronin_without_an_ekf_uses_the_other_sources(tmp_path, walks):
    h5py = pytest.importorskip("h5py")
    recording = formats.ronin(tmp_path / "a", walks(200.0), grv_ori_error=30.0)
    with h5py.File(recording.path / "data.hdf5", "a") as data:
        del data["pose/ekf_ori"]
    read = read_recording(recording.path / "data.hdf5")
    assert max_angle(read.truth.attitude_WB, recording.expected.truth.attitude_WB) < 2e-3


def test_rnin_without_motion_capture_uses_the_odometry(tmp_path, walks):
    recording = formats.rnin(tmp_path, walks(200.0), captured=False)
    truth, expected = read_recording(recording.path).truth, recording.expected.truth
    assert np.abs(truth.position_W - expected.position_W).max() < 1e-6
    assert max_angle(truth.attitude_WB, expected.attitude_WB) < 1e-6
    csv = recording.path / "SenseINS.csv"
    csv.write_text(csv.read_text().replace("times,", "time,", 1))
    assert np.array_equal(read_recording(csv).gyro, read_recording(recording.path).gyro)


def test_tlio_quaternion_order_is_that_of_the_column_name(tmp_path, walks):
    recording = formats.tlio(tmp_path / "7", walks(200.0), order="wxyz")
    read = read_recording(recording.path)
    assert max_angle(read.truth.attitude_WB, recording.expected.truth.attitude_WB) < 1e-6
    assert np.abs(read.accel - recording.expected.accel).max() < 1e-9


def test_tlio_raw_poses_are_in_the_imus_axes(tmp_path, walks):
    """The calibration rotates a pose of the device, but not a pose of the IMU."""
    R_DI = Rotation.from_euler("zyx", [90.0, 10.0, -170.0], degrees=True)
    recording = formats.tlio_raw(tmp_path / "7", walks(1000.0), R_DI)
    truth, expected = read_recording(recording.path).truth, recording.expected.truth
    assert np.abs(truth.position_W - expected.position_W).max() < 1e-6
    assert max_angle(truth.attitude_WB, expected.attitude_WB) < 1e-6
    (recording.path.parent / "imu0_resampled.npy").unlink()
    alone = read_recording(recording.path.parent)
    assert alone.truth is None
    assert np.abs(alone.accel - recording.expected.accel).max() < 1e-9


def test_raw_poses_in_a_world_with_z_up_are_kept(tmp_path, walks):
    """RIDI's raw folders contain IMUNet's files, from a Tango."""
    recording = formats.imunet_raw(tmp_path / "seq", walks(200.0), world=Rotation.identity())
    truth, expected = read_recording(recording.path).truth, recording.expected.truth
    assert np.abs(truth.position_W - expected.position_W).max() < 1e-6
    assert max_angle(truth.attitude_WB, expected.attitude_WB) < 1e-6


def test_a_processed_recording_is_preferred_to_the_raw_files_next_to_it(tmp_path, walks):
    walk = walks(200.0)
    formats.imunet_raw(tmp_path / "seq", walk)
    formats.ridi(tmp_path / "seq", walk)
    assert len(read_recording(tmp_path / "seq")) == len(walk)
    assert len(read_recording(tmp_path / "seq", format="imunet")) == len(walk)
    assert find_recordings(tmp_path) == [tmp_path / "seq"]


@pytest.mark.parametrize("version", ["ros1", "sqlite3"])
@pytest.mark.parametrize(
    "kind",
    [
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
        "nav_msgs/msg/Odometry",
    ],
)
def test_each_type_of_pose_message_is_read_as_truth(tmp_path, version, kind):
    walk = formats.walk_of(100.0, 3.0)
    path = formats.bag(tmp_path / "b", walk, version, pose_topics=(("/pose", kind),))
    read = read_recording(path)
    assert np.abs(read.truth.position_W - walk.truth.position_W).max() < 1e-9
    assert max_angle(read.truth.attitude_WB, walk.truth.attitude_WB) < 1e-9
    assert np.abs(read.truth.time - walk.time).max() < 2e-9


@pytest.mark.parametrize("version", ["ros1", "sqlite3", "mcap"])
def test_pressure_and_satellites_of_a_bag_are_read(tmp_path, version):
    walk = formats.walk_of(100.0, 3.0)
    topics = (("/air", "sensor_msgs/msg/FluidPressure"), ("/fix", "sensor_msgs/msg/NavSatFix"))
    read = read_recording(formats.bag(tmp_path / "b", walk, version, other_topics=topics))
    rows = np.arange(len(walk))
    assert read.truth is not None
    np.testing.assert_allclose(read.barometer.pressure_hPa, 1013.25 - 0.01 * rows)
    np.testing.assert_allclose(read.barometer.time, walk.time, atol=2e-9)
    found = read.satellites
    place = np.stack([np.full(len(rows), 48.0), 11.0 + 1e-5 * rows], axis=1)
    np.testing.assert_allclose(found.latlon_deg, place)
    np.testing.assert_array_equal(found.altitude_m, 500.0)
    np.testing.assert_allclose(found.radius_m, 1.51 * 3.0)


def test_several_topics_are_named_with_the_option_that_selects_one(tmp_path):
    walk = formats.walk_of(100.0, 3.0)
    kind = "geometry_msgs/msg/PoseStamped"
    path = formats.bag(
        tmp_path / "b", walk, imu_topics=("/imu", "/imu_old"),
        pose_topics=(("/mocap", kind), ("/vio", kind)),
    )  # fmt: skip
    with pytest.raises(ReadError, match=r"found /imu, /imu_old, .*--imu-topic /imu"):
        read_recording(path)
    with pytest.raises(ReadError, match=r"found /mocap, /vio, .*--truth-topic /mocap, or .*none"):
        read_recording(path, imu_topic="/imu")
    read = read_recording(path, imu_topic="/imu_old", truth_topic="/vio")
    assert np.array_equal(read.gyro, walk.gyro)
    assert read.truth is not None
    assert read_bag(path, "/imu", "none").truth is None
    with pytest.raises(ReadError, match="imu topic: found '/vio', expected one of /imu, /imu_old"):
        read_recording(path, imu_topic="/vio")
    (tmp_path / "a.csv").write_text("t,gx,gy,gz,ax,ay,az\n")
    with pytest.raises(InputError, match="imu_topic: found an option that format csv does"):
        read_recording(tmp_path / "a.csv", imu_topic="/imu")


def test_a_bag_without_an_imu_is_refused_with_its_topics(tmp_path):
    path = formats.bag(tmp_path / "b", formats.walk_of(100.0, 1.0), imu_topics=())
    with pytest.raises(
        ReadError, match=r"found /odom \(Odometry\), /mag .*, expected one topic with sens"
    ):
        read_recording(path)


def write_phone_files(folder, accel: str, gyro: str, names=("accel.csv", "gyro.csv")) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in zip(names, (accel, gyro), strict=True):
        (folder / name).write_text(text)


def rows(time, values, sep=",", last=False) -> str:
    return "\n".join(
        sep.join(map(repr, [*v, t] if last else [t, *v]))
        for t, v in zip(time.tolist(), values.tolist(), strict=True)
    )


def test_loggers_with_different_conventions_are_read(tmp_path):
    """Seconds with units in a header; milliseconds without any; the time after the values."""
    walk = formats.walk_of(200.0, 5.0)
    t, gyro, accel = walk.time, walk.gyro, walk.accel
    header = '"Time (s)","Gyroscope x (deg/s)","Gyroscope y (deg/s)","Gyroscope z (deg/s)"\n'
    g_header = "timestamp [s];ax [g];ay [g];az [g]\n"
    blanks = "# a logger\n"
    conventions = {
        "phyphox": (
            g_header + rows(t, accel / 9.80665, ";"), header + rows(t, np.degrees(gyro)),
        ),
        "plain": (rows(1000 * t + 5e8, accel), rows(1000 * t + 5e8, gyro)),
        "behind": (rows(t, accel, last=True), rows(t, gyro, last=True)),
        "blanks": (blanks + rows(1e6 * t, accel, " "), blanks + rows(1e6 * t, gyro, " ")),
    }  # fmt: skip
    for name, (accel_text, gyro_text) in conventions.items():
        write_phone_files(tmp_path / name, accel_text, gyro_text)
        read = read_recording(tmp_path / name)
        assert np.abs(read.gyro - gyro).max() < 1e-9, name
        assert np.abs(read.accel - accel).max() < 1e-6, name
        assert np.abs(read.time - t).max() < 1e-7, name
    assert find_recordings(tmp_path) == [tmp_path / name for name in sorted(conventions)]


def write_sensor_files(folder, *names: str) -> None:
    """Write files of gyroscope samples, or of the accelerometer's if the name contains "acc"."""
    walk = formats.walk_of(100.0, 3.0)
    folder.mkdir()
    for name in names:
        values = walk.accel if "acc" in name.lower() else walk.gyro
        (folder / name).write_text(rows(walk.time, values))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ("walk1_acc.csv", "walk1_gyr.csv", "walk2_acc.csv", "walk2_gyr.csv"),
            r"a folder of 2 recordings, .*; name one, such as .*/walk1_gyr\.csv",
        ),
        (("acc_1.csv", "acc_2.csv", "gyr_3.csv"), r"recordings \(acc_1\.csv, acc_2\.csv, gyr_3"),
    ],
)
def test_recordings_that_share_a_folder_are_not_mixed(tmp_path, names, message):
    write_sensor_files(tmp_path / "s", *names)
    with pytest.raises(ReadError, match=message):
        read_recording(tmp_path / "s")


def test_files_with_two_prefixes_are_two_recordings(tmp_path):
    write_sensor_files(tmp_path / "s", "one_acc.csv", "one_gyr.csv", "Two_acc.csv", "Two_gyr.csv")
    (tmp_path / "s/Two_gyr.csv").write_text(rows(np.arange(99) / 100.0, np.ones((99, 3))))
    found = find_recordings(tmp_path)
    assert found == [tmp_path / "s/Two_gyr.csv", tmp_path / "s/one_gyr.csv"]
    two, one = map(read_recording, found)
    assert (two.name, one.name) == ("Two", "one")
    assert (two.gyro == 1.0).all()
    assert np.array_equal(one.gyro, formats.walk_of(100.0, 3.0).gyro)


def test_a_sensor_is_paired_with_the_one_of_its_own_device(tmp_path):
    write_sensor_files(tmp_path / "s", "watch_acc.csv", "watch_gyr.csv")
    expected = read_recording(tmp_path / "s")
    (tmp_path / "s/phone_acc.csv").write_text(rows(expected.time, 2.0 * expected.accel))
    assert np.array_equal(read_recording(tmp_path / "s").accel, expected.accel)


def test_variants_of_a_recordings_files_are_not_other_recordings(tmp_path):
    """Files written alongside the raw sensors; names that differ by more than the sensor."""
    names = ("Accelerometer.csv", "Gyroscope.csv")
    variants = ("AccelerometerUncalibrated.csv", "GyroscopeUncalibrated.csv", "Gravity.csv")
    write_sensor_files(tmp_path / "s", *names, *variants)
    write_sensor_files(tmp_path / "t", "acc_12-00-01.csv", "gyr_12-00-02.csv")
    assert same_samples(read_recording(tmp_path / "s"), read_recording(tmp_path / "t"))
    uncalibrated = tmp_path / "s/AccelerometerUncalibrated.csv"
    uncalibrated.write_text(rows(np.arange(9) / 100.0, np.ones((9, 3))))
    assert len(read_recording(tmp_path / "s")) == len(read_recording(tmp_path / "t"))


@pytest.mark.parametrize("above", ["", "\n", "Device: Pixel\n\n", "# a\n\n# b\n"])
def test_any_text_above_a_loggers_header_is_skipped(tmp_path, above):
    walk = formats.walk_of(100.0, 3.0)
    head = f"{above}time,x,y,z\n"
    write_phone_files(
        tmp_path / "s", head + rows(walk.time, walk.accel), head + rows(walk.time, walk.gyro)
    )
    assert np.array_equal(read_recording(tmp_path / "s").gyro, walk.gyro)


@pytest.mark.parametrize("rate", [50.0, 1000.0, 1125.0])
@pytest.mark.parametrize("start", [0.0, 12345.678])
def test_the_time_unit_is_determined_at_every_accepted_rate(tmp_path, rate, start):
    walk = formats.walk_of(rate, 2.0)
    t = np.round(start + walk.time, 6)
    write_phone_files(tmp_path / "s", rows(t, walk.accel), rows(t, walk.gyro))
    assert read_recording(tmp_path / "s").rate == pytest.approx(rate, rel=1e-3)


def test_units_named_by_a_logger_are_used_or_refused(tmp_path):
    walk = formats.walk_of(100.0, 3.0)

    def read(time, gyro):
        texts = [
            f"time [{time}],x [{unit}],y,z\n" + rows(1e3 * walk.time, values)
            for unit, values in (("m/s^2", walk.accel), (gyro, np.degrees(walk.gyro)))
        ]
        write_phone_files(tmp_path / "s", *texts)
        return read_recording(tmp_path / "s")

    named = read("milliseconds", "deg/s")
    assert np.allclose(named.time, walk.time)
    with pytest.raises(InputError, match="whose file names its unit"):
        with_units(named, gyro_unit="deg/s")
    with_units(named, accel_unit="-m/s^2")
    with pytest.raises(ReadError, match="time: found unit 'ticks', expected s, ms, us, ns"):
        read("ticks", "deg/s")


def test_files_with_both_sensors_are_separate_recordings(tmp_path, walks):
    write_csv(tmp_path / "accel_gyro_1.csv", walks(200.0))
    write_csv(tmp_path / "accel_gyro_2.csv", walks(200.0))
    assert len(find_recordings(tmp_path)) == 2


def test_a_loggers_gravity_is_added_if_it_was_removed(tmp_path):
    walk = formats.walk_of(100.0, 5.0)
    gravity = walk.truth.attitude_WB.apply([0.0, 0.0, 9.80665], inverse=True)
    write_phone_files(
        tmp_path / "s", rows(walk.time, walk.accel - gravity), rows(walk.time, walk.gyro)
    )
    assert np.abs(read_recording(tmp_path / "s").accel).mean() < 3.0
    (tmp_path / "s/Gravity.csv").write_text(rows(walk.time, gravity))
    assert np.abs(read_recording(tmp_path / "s").accel - walk.accel).max() < 1e-9


def test_clocks_of_different_phase_are_interpolated_but_not_across_a_gap(tmp_path):
    walk = formats.walk_of(200.0, 10.0)
    t = walk.time
    accel_time = np.delete(t[:-1] + 0.0017, np.arange(800, 1000))
    force = np.stack([np.interp(accel_time, t, walk.accel[:, k]) for k in range(3)], axis=1)
    write_phone_files(tmp_path / "s", rows(accel_time, force), rows(t, walk.gyro))
    read = read_recording(tmp_path / "s")
    assert len(read) == len(t) - 2 - 201
    assert np.diff(read.time).max() == pytest.approx(1.01, abs=1e-6)
    kept = np.searchsorted(t, read.time + t[1] - 1e-6)
    assert np.array_equal(read.gyro, walk.gyro[kept])
    assert np.abs(read.accel - walk.accel[kept]).max() < 0.3
    write_phone_files(tmp_path / "late", rows(t + 100.0, walk.accel), rows(t, walk.gyro))
    with pytest.raises(ReadError, match=r"gyroscope from 0.000 to 10.000 s, accelerometer from 1"):
        read_recording(tmp_path / "late")


def same_samples(a, b) -> bool:
    arrays = [(x.time, x.gyro, x.accel) for x in (a, b)]
    if (a.truth is None) != (b.truth is None):
        return False
    if a.truth is not None:
        arrays = [(*x, y.truth.position_W) for x, y in zip(arrays, (a, b), strict=True)]
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(*arrays, strict=True))


def test_a_bag_without_gravity_keeps_the_attitude_that_restores_it(tmp_path):
    """As drivers of the BNO055 publish it: linear acceleration beside the sensor's own attitude."""
    walk = formats.walk_of(100.0, 20.0)
    up_B = walk.truth.at(walk.time).attitude_WB.apply([0.0, 0.0, STANDARD_GRAVITY], inverse=True)
    linear = dataclasses.replace(walk, accel=walk.accel - up_B)
    read = read_recording(formats.bag(tmp_path / "b", linear, pose_topics=()))
    with pytest.raises(InputError, match="`--gravity removed`"):
        check_units(read)
    restored = with_conventions(read, gravity="removed")
    check_units(restored)
    np.testing.assert_allclose(restored.accel, walk.accel, atol=1e-6)
    identity = Rotation.identity(len(walk.truth))
    blank = dataclasses.replace(walk, truth=dataclasses.replace(walk.truth, attitude_WB=identity))
    assert (
        read_recording(formats.bag(tmp_path / "c", blank, pose_topics=())).device_attitude is None
    )


def test_large_files_are_read_as_small_ones_are(tmp_path, walks, monkeypatch):
    walk = walks(200.0)
    paths = [
        write(tmp_path / f"seq{k}", walk).path
        for k, write in enumerate((formats.ridi, formats.rnin, formats.imunet_raw, formats.android))
    ]
    write_csv(tmp_path / "own.csv", walk)
    late = dataclasses.replace(walk, time=walk.time + 1.5e9, truth=None)
    write_csv(tmp_path / "late.csv", late)
    sparse = walk.truth.at(walk.time[::2] + 0.001)
    write_csv(tmp_path / "sparse.csv", dataclasses.replace(walk, truth=sparse))
    for path in [*paths, *(tmp_path / f"{name}.csv" for name in ("own", "late", "sparse"))]:
        careful = read_recording(path)
        with monkeypatch.context() as small:
            small.setattr("stario.sequences.readers.text._LARGE_BYTES", 0)
            assert same_samples(read_recording(path), careful), path


def test_an_error_in_a_large_file_is_named_too(tmp_path, walks, monkeypatch):
    monkeypatch.setattr("stario.sequences.readers.text._LARGE_BYTES", 0)
    path = formats.ridi(tmp_path / "seq", walks(200.0)).path
    csv = path / "processed/data.csv"
    lines = csv.read_text().splitlines()
    csv.write_text("\n".join([*lines[:99], lines[99].rsplit(",", 3)[0]]))
    with pytest.raises(ReadError, match="line 100: found 25 values, expected 28"):
        read_recording(path)
    csv.write_text("\n".join([*lines[:99], lines[99].replace(".", "x", 1)]))
    with pytest.raises(ReadError, match="line 100, column "):
        read_recording(path)
    write_csv(tmp_path / "own.csv", walks(200.0).without_truth())
    text = (tmp_path / "own.csv").read_text().rstrip().rsplit(",", 1)[0]
    (tmp_path / "own.csv").write_text(f"{text},-1.#IND\n")
    with pytest.raises(ReadError, match=r"az.*: found '-1\.#IND', expected a number"):
        read_recording(tmp_path / "own.csv")


def test_a_missing_package_is_named_with_what_installs_it(tmp_path, walks, monkeypatch):
    recording = formats.ronin(tmp_path / "a", walks(200.0))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"h5py: found not installed.*pip install 'h5py"):
        read_recording(recording.path)


def test_calibration_is_applied_as_in_the_authors_filter(tmp_path, walks):
    recording = formats.tlio_raw(tmp_path / "7", walks(1000.0))
    calibration = recording.path.with_name("calibration.json")
    fields = json.loads(calibration.read_text())
    fields["Accelerometer"]["Bias"]["Offset"] = [0.0, 0.0, 0.0]
    calibration.write_text(json.dumps(fields))
    off = read_recording(recording.path).accel - recording.expected.accel
    assert np.abs(off - [0.1, 0.05, -0.2]).max() < 1e-9  # R^-1 x - b: the bias, not R^-1 b
