"""Files as apps export them (`phone_exports`): each must be read as the walk written."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alike import assert_same_samples, assert_upright
from phone_exports import EXPORTS, Y_UP, ZYX, export, field, gravity, ns, save
from recorded import DATA
from scipy.spatial.transform import Rotation
from walked import walked

from stario.sequences import (
    InputError,
    ReadError,
    check_units,
    find_recordings,
    read_recording,
    with_conventions,
)
from stario.sequences.conventions import with_axes, with_gravity
from stario.sequences.simulation.imu import PERFECT_IMU

RAW = DATA / "raw"


@pytest.mark.parametrize("app", EXPORTS)
def test_an_apps_export_is_read_as_the_walk(app, walk, tmp_path):
    with_field = export(app, tmp_path / "s", walk)
    (found,) = find_recordings(tmp_path / "s")
    read = read_recording(found)
    assert_same_samples(read, walk)
    assert (read.magnetometer is not None) == with_field
    if with_field:
        np.testing.assert_allclose(read.magnetometer.field, field(walk), atol=1e-8)
        np.testing.assert_allclose(read.magnetometer.time, walk.time, atol=1e-3)


def test_a_linear_acceleration_of_about_one_is_not_mistaken_for_gravity_in_g(walk, tmp_path):
    """Its norm is about 1, as in g; the gravity file next to it shows what it is."""
    export("sensor_logger_ios", tmp_path / "s", walk)
    (tmp_path / "s/Metadata.csv").unlink()
    steady = np.tile([0.6, -0.6, 0.5], (len(walk), 1))
    for name, values in (("Accelerometer", steady), ("Gravity", gravity(walk))):
        save(tmp_path / f"s/{name}.csv", ZYX, ns(walk), walk.time, values[:, ::-1])
    read = read_recording(tmp_path / "s")
    np.testing.assert_allclose(read.accel, gravity(walk) + steady, atol=1e-8)


@pytest.mark.parametrize(
    "app", ["sensor_logger_attitude", "senslogs_ios", "trace", "get_sensor_data"]
)
def test_the_phones_own_attitude_is_read_too(app, walk, tmp_path):
    """With quaternions in either order and direction, as determined by the gyroscope."""
    export(app, tmp_path / "s", walk)
    read = read_recording(*find_recordings(tmp_path / "s"))
    np.testing.assert_allclose(read.device_attitude.time, walk.time, atol=1e-3)
    error = (read.device_attitude.attitude_WB * walk.truth.attitude_WB.inv()).magnitude()
    assert error.max() < 1e-6
    bare = replace(read, accel=read.accel - gravity(walk))
    np.testing.assert_allclose(with_gravity(bare).accel, walk.accel, atol=0.02)
    turned = with_axes(read, "y,-x,z").device_attitude
    up = turned.attitude_WB.apply(with_axes(read, "y,-x,z").accel)
    np.testing.assert_allclose(up, walk.truth.attitude_WB.apply(walk.accel), atol=1e-5)


@pytest.mark.parametrize("inner", ["", "walk/"])
@pytest.mark.parametrize("app", ["sensor_logger", "phyphox"])
def test_a_zip_is_read_like_the_folder_in_it(app, inner, walk, tmp_path):
    folder = tmp_path / "s"
    export(app, folder, walk)
    (tmp_path / "zips").mkdir()
    path = tmp_path / "zips/export.zip"
    with zipfile.ZipFile(path, "w") as file:
        for one in folder.rglob("*.csv"):
            file.write(one, inner + str(one.relative_to(folder)))
        file.writestr("__MACOSX/._Gyroscope.csv", "junk")
    assert find_recordings(tmp_path / "zips") == [path]
    read = read_recording(path)
    assert read.name == ("walk" if inner else "export")
    np.testing.assert_array_equal(read.accel, read_recording(folder).accel)
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(ReadError, match=r"export\.zip"):
        read_recording(path)


def test_messages_about_a_zip_name_the_zip_and_the_file(walk, tmp_path, caplog):
    path = tmp_path / "export.zip"

    def zipped(clock: str) -> None:
        with zipfile.ZipFile(path, "w") as file:
            for name, values in (("Gyroscope", walk.gyro), ("TotalAcceleration", walk.accel)):
                one = tmp_path / f"s/{name}.csv"
                save(one, f"{clock},x,y,z", walk.time, values)
                file.writestr(f"walk/{one.name}", one.read_text()[:-20])

    zipped("time [ticks]")
    with pytest.raises(ReadError, match=r"export\.zip/walk/Gyroscope\.csv: time: .*'ticks'"):
        read_recording(path)
    zipped("time")
    read_recording(path)
    assert f"{path}/walk/Gyroscope.csv: skipped the last row, line 1502" in caplog.text
    assert "stario-" not in caplog.text
    caplog.clear()
    read_recording(tmp_path / "s")
    assert "export.zip" not in caplog.text


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
@pytest.mark.parametrize("turn", ["x,y,z", "camera"])
def test_poses_next_to_the_imu_are_read_as_truth_in_its_axes(order, turn, walk, tmp_path):
    """30 Hz, y up, of the camera or the sensor, in either quaternion order despite the header."""
    truth, every = walk.truth, slice(None, None, 3)
    mount = Rotation.from_euler("z", 90.0 if turn == "camera" else 0.0, degrees=True)
    attitude = (Y_UP * truth.attitude_WB * mount.inv())[every].as_quat()
    quat = attitude if order == "xyzw" else attitude[:, [3, 0, 1, 2]]
    stem = tmp_path / "2019-06-18_105450"
    header = "Timestamp,Tx,Ty,Tz,Qw,Qx,Qy,Qz"
    rows = [ns(walk)[every], Y_UP.apply(truth.position_W)[every], quat]
    save(Path(f"{stem}_ARCore.txt"), header, *rows)
    save(Path(f"{stem}_IMU.txt"), "Timestamp,Ax,Ay,Az,Gx,Gy,Gz", ns(walk), walk.accel, walk.gyro)
    (found,) = find_recordings(tmp_path)
    read = read_recording(found)
    assert read.truth.valid.mean() > 0.9
    np.testing.assert_allclose(read.truth.time, truth.time[every], atol=0.01)
    error = (read.truth.attitude_WB * truth.attitude_WB[every].inv()).as_rotvec()
    assert np.degrees(np.abs(error)).max() < 3.0
    np.testing.assert_allclose(read.truth.position_W, truth.position_W[every], atol=0.1)


@pytest.mark.parametrize("columns", [7, 12])
def test_a_pose_file_without_any_rotation_gives_a_warning(columns, walk, tmp_path, caplog):
    rows = np.ones((len(walk), columns))
    for name, values in (("acce", walk.accel), ("gyro", walk.gyro), ("ARKit_pose", rows)):
        save(tmp_path / f"s/{name}.txt", "# a", ns(walk), values, sep=" ")
    assert read_recording(tmp_path / "s").truth is None
    assert "no row in ARKit_pose.txt holds a pose" in caplog.text


def test_a_missing_sensor_is_named(walk, tmp_path):
    save(tmp_path / "s/Accelerometer.csv", "time,x,y,z", walk.time, walk.accel)
    save(tmp_path / "s/Magnetometer.csv", "time,x,y,z", walk.time, field(walk))
    poses = np.hstack([walk.truth.position_W, walk.truth.quat_xyzw])
    save(tmp_path / "p/ARCore_sensor_pose.txt", "# by a logger", ns(walk), poses, sep=" ")
    header = ";".join(f"ACCELEROMETER {axis} (m/s²)" for axis in "XYZ")
    wide = f"{header};Time since start in ms "
    save(tmp_path / "a.csv", wide, walk.accel, np.round(1e3 * walk.time), sep=";")
    for read, name, words in (
        (read_recording, "s", "only accel and mag, expected a gyro"),
        (find_recordings, "s", "only accel and mag, expected a gyro"),
        (read_recording, "p", r"only poses, ARCore_sensor_pose\.txt, expected a gyr"),
        (find_recordings, "p", r"only poses, ARCore_sensor_pose\.txt, expected a gyr"),
        (read_recording, "a.csv", "only accel"),
    ):
        with pytest.raises(ReadError, match=words):
            read(tmp_path / name)


def test_an_accelerometer_in_other_axes_than_the_gyroscope_is_corrected(tmp_path, caplog):
    walk = walked(3, 60.0, PERFECT_IMU, rate=50.0, carry="handheld", mount_rotvec=(0.3, -0.5, 0.4))
    poses = np.hstack(
        [Y_UP.apply(walk.truth.position_W), (Y_UP * walk.truth.attitude_WB).as_quat()]
    )
    wrong = -walk.accel[:, [1, 0, 2]]
    for name, values in (("acce", wrong), ("gyro", walk.gyro), ("ARKit_pose", poses)):
        save(tmp_path / f"s/{name}.txt", "# a", ns(walk), values, sep=" ")
    read = read_recording(tmp_path / "s")
    assert "its -y,-x,-z is used as x,y,z" in caplog.text
    np.testing.assert_allclose(read.accel, walk.accel, atol=1e-9)


def test_waypoints_and_reference_points_are_read_as_positions(walk, tmp_path):
    export("trace", tmp_path / "t", walk)
    waypoints = read_recording(tmp_path / "t/5d07.txt").positions
    np.testing.assert_allclose(waypoints.time, [2.0, 7.0], atol=1e-3)
    np.testing.assert_allclose(waypoints.position_W, [[200.5, 7.25], [700.5, 7.25]])
    export("get_sensor_data", tmp_path / "g", walk)
    points = read_recording(tmp_path / "g/log.txt").positions
    np.testing.assert_allclose(points.time, [2.0, 4.0], atol=1e-3)
    np.testing.assert_allclose(points.position_W, [[0.0, 0.0], [0.0, 11.10]], atol=0.01)
    export("prefixed", tmp_path / "p", walk)
    (tmp_path / "p/Eight_ref.csv").write_text("1606391910305 566578.7 5932830.4 19.6\n" * 2)
    references = read_recording(tmp_path / "p").positions
    np.testing.assert_allclose(references.time, [2.0])


KINDS = {
    "sensor_logger/university_loop": "none", "sensor_logger/shopping_mall_eight": "none",
    "phyphox": "positions (sigma", "canlang_logger": "none", "pyojinkim_android": "none",
    "senslogs_tyrex_android": "none", "senslogs_tyrex_ios": "none", "ipin21_hcu": "waypoints",
    "imunet_txt/Walk7S9": "poses", "tlio_npy_ridi/dan_body1": "poses", "advio/advio-15": "none",
    "imu_pose_android_recorder/2019-06-18_105450_IMU.txt": "poses",
}  # fmt: skip


@pytest.mark.skipif(not RAW.is_dir(), reason="the apps' own files are not here")
@pytest.mark.parametrize("name", KINDS)
def test_the_apps_own_files_contain_gravity_and_the_expected_truth(name):
    read = read_recording(RAW / name)
    assert 9.0 < np.median(np.linalg.norm(read.accel, axis=1)) < 12.0
    assert 0.1 < np.median(np.linalg.norm(read.gyro, axis=1)) < 3.0
    assert KINDS[name] in read.truth_summary()
    logged = ("shopping_mall_eight", "pyojinkim_android", "senslogs_tyrex")
    assert (read.device_attitude is not None) == any(part in name for part in logged)
    if read.truth is not None:
        assert_upright(read, 3.0)


def test_the_summary_names_the_unit_that_times_were_taken_for(walk, tmp_path):
    """Not if the file names it, or if the times are counted from 1970 and fit no other."""
    wide = ",".join(f"{name} {axis}" for name in ("Gyro", "Acc") for axis in "XYZ")
    generic = "gx,gy,gz,ax,ay,az"
    millis = 10 * np.arange(len(walk)) + 7
    for titles, times, words in (
        (f"time,{wide}", millis, ", times taken as ms, 15.0 s"),
        (f"time,{generic}", millis, ", times taken as ms, 15.0 s"),
        (f"time,{generic}", walk.time, ", times taken as s, 15.0 s"),
        (f"time (ms),{wide}", millis, "file, 15.0 s"),
        (f"time [ms],{generic}", millis, "CSV, 15.0 s"),
        (f"time,{wide}", ns(walk), "file, 15.0 s"),
        (f"time,{generic}", ns(walk), "CSV, 15.0 s"),
    ):
        save(tmp_path / "a.csv", titles, times, walk.gyro, walk.accel)
        assert words in read_recording(tmp_path / "a.csv").summary()
    export("ios_logger", tmp_path / "b", walk)
    for words in ("b: iOS Logger, 15.0 s at 100.0 Hz, magnetometer at 100 Hz", "own attitude"):
        assert words in read_recording(tmp_path / "b").summary()


def test_an_undetermined_accelerometer_sign_is_reported(walk, tmp_path, caplog):
    export("sensor_logger_ios", tmp_path / "s", walk)
    (tmp_path / "s/Metadata.csv").unlink()
    undetermined = read_recording(tmp_path / "s")
    for read in (undetermined, with_conventions(undetermined)):
        check_units(read)
        assert "from an iPhone, pass `--accel-sign apple`" in caplog.text
        caplog.clear()
    turned = with_conventions(undetermined, accel_sign="apple")
    np.testing.assert_allclose(turned.accel, walk.accel, atol=1e-8)
    check_units(with_conventions(turned))
    assert not caplog.text
    export("ios_logger", tmp_path / "t", walk)
    for name in ("Motion.txt", "MotMagnFull.txt"):
        (tmp_path / "t" / name).unlink()
    with pytest.raises(InputError, match=r"`--accel-unit g`.* `--accel-sign apple`"):
        check_units(read_recording(tmp_path / "t"))
    assert not caplog.text


def test_lines_of_an_attitude_that_cannot_be_read_cost_no_recording(walk, tmp_path):
    export("get_sensor_data", tmp_path, walk)
    path = tmp_path / "log.txt"
    path.write_text(path.read_text().replace(";1;2;3;", ";1;2;"))
    assert read_recording(path).device_attitude is None


@pytest.mark.parametrize("second_clock", [False, True])
def test_swapped_rows_at_the_start_of_a_file_without_titles(second_clock, walk, tmp_path):
    order = np.arange(len(walk))
    order[[4, 5, 12, 13]] = [5, 4, 13, 12]
    clocks = [[stamp, stamp] if second_clock else [stamp] for stamp in ns(walk)]
    for name, values in (("gyro", walk.gyro), ("acce", walk.accel), ("gyro_uncalib", walk.accel)):
        rows = np.asarray(clocks)[order]
        save(tmp_path / f"s/{name}.txt", "", rows, values[order], sep=" ")
    sequence = read_recording(tmp_path / "s")
    assert_same_samples(sequence.select(np.argsort(sequence.time)), walk)
