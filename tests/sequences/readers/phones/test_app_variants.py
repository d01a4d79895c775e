"""The same apps with other settings, systems and exports: each must be read as the same walk."""

import csv
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import phone_exports
import pytest
from alike import assert_same_samples
from csv_lines import write_lines
from phone_files import ZYX, field, gravity, ns, save, zyx
from scipy.spatial.transform import Rotation

from stario.sequences import (
    ImuSequence,
    InputError,
    check_units,
    find_recordings,
    read_recording,
    with_conventions,
)
from stario.sequences.sequence import STANDARD_GRAVITY

METADATA = (
    "version,device name,recording epoch time,recording time,recording timezone,platform,"
    "appVersion,device id,sensors,sampleRateMs,standardisation,platform version\n"
    '3,"Ana\'s phone, blue",1727600000000,2024-09-29_08-53-20,Europe/Paris,ios,1.43,a-b,'
    "Accelerometer|Gravity|Gyroscope,10|10|10,{standardised},17.4\n"
)
ANDROSENSOR = [
    f"{name} {axis} ({unit})"
    for name, unit in (("ACCELEROMETER", "m/s²"), ("GYROSCOPE", "rad/s"), ("MAGNETIC FIELD", "μT"))
    for axis in "XYZ"
]


def android(folder: Path, walk: ImuSequence) -> None:
    zyx(folder, walk, TotalAcceleration=walk.accel, Gyroscope=walk.gyro, Magnetometer=field(walk))


def readable_times(folder: Path, walk: ImuSequence) -> None:
    texts = [["2024-06-10 14:45:36.872"]] * len(walk)
    for name, values in (("TotalAcceleration", walk.accel), ("Gyroscope", walk.gyro),
                         ("Magnetometer", field(walk))):  # fmt: skip
        header = "time,human_readable_time,seconds_elapsed,z,y,x"
        save(folder / f"{name}.csv", header, ns(walk), texts, walk.time, values[:, ::-1])


def extra_sensors(folder: Path, walk: ImuSequence) -> None:
    """With a watch's motion, other sensors and the files that macOS adds to folders."""
    android(folder, walk)
    few = ns(walk)[:9], walk.time[:9]
    save(folder / "Barometer.csv", "time,seconds_elapsed,relativeAltitude,pressure", *few,
         np.zeros((9, 2)))  # fmt: skip
    save(folder / "Location.csv", "time,seconds_elapsed,speed,longitude,latitude", *few,
         np.zeros((9, 3)))  # fmt: skip
    save(folder / "Annotation.csv", "time,seconds_elapsed,text", *few, [["turn, left"]] * 9)
    save(folder / "WatchMagnetometer.csv", ZYX, ns(walk), walk.time, field(walk) + 300.0)
    watch(folder, walk)
    (folder / "._Gyroscope.csv").write_bytes(b"\0\5\26\7" * 20)
    (folder / ".DS_Store").write_bytes(b"\0\0")
    (folder / "Microphone.csv").write_text("time,seconds_elapsed,dBFS\n")


def watch(folder: Path, walk: ImuSequence) -> None:
    """An Apple Watch only: everything in one file, in g and with Apple's sign."""
    header = "time,seconds_elapsed," + ",".join(
        f"{name}{axis}" for name in ("rotationRate", "gravity", "acceleration") for axis in "XYZ"
    )
    linear = (walk.accel - gravity(walk)) / STANDARD_GRAVITY
    columns = walk.gyro, -gravity(walk) / STANDARD_GRAVITY, -linear, walk.truth.quat_xyzw
    header += ",quaternionX,quaternionY,quaternionZ,quaternionW"
    save(folder / "WristMotion.csv", header, ns(walk), walk.time, *columns)


def iphone(folder: Path, walk: ImuSequence) -> None:
    linear = walk.accel - gravity(walk)
    zyx(folder, walk, Accelerometer=-linear, Gravity=-gravity(walk), Gyroscope=walk.gyro)
    (folder / "Metadata.csv").write_text(METADATA.format(standardised="false"))


def iphone_standardised(folder: Path, walk: ImuSequence) -> None:
    linear = walk.accel - gravity(walk)
    zyx(folder, walk, Accelerometer=linear, Gravity=gravity(walk), Gyroscope=walk.gyro)
    (folder / "Metadata.csv").write_text(METADATA.format(standardised="true"))


def iphone_uncalibrated(folder: Path, walk: ImuSequence) -> None:
    """Gravity was not logged, but the raw accelerometer was, in g."""
    linear = walk.accel - gravity(walk)
    raw = -walk.accel / STANDARD_GRAVITY
    zyx(folder, walk, Accelerometer=-linear, AccelerometerUncalibrated=raw, Gyroscope=walk.gyro)
    (folder / "Metadata.csv").write_text(METADATA.format(standardised="false"))


def json_export(folder: Path, walk: ImuSequence) -> None:
    linear = walk.accel - gravity(walk)
    rows = [
        {"sensor": name, "time": str(stamp), "z": str(z), "y": str(y), "x": str(x)}
        for name, values in (("Accelerometer", linear), ("Gravity", gravity(walk)),
                             ("Gyroscope", walk.gyro), ("Magnetometer", field(walk)))
        for stamp, (x, y, z) in zip(ns(walk), values.tolist(), strict=True)
    ]  # fmt: skip
    metadata = {"sensor": "Metadata", "device name": "Pixel 8", "platform": "android"}
    folder.mkdir()
    (folder / "2024-06-10.json").write_text(json.dumps([metadata, *rows]))


def json_export_of_a_watch(folder: Path, walk: ImuSequence) -> None:
    watch(folder, walk)
    with (folder / "WristMotion.csv").open() as file:
        rows = [{"sensor": "WristMotion", **row} for row in csv.DictReader(file)]
    (folder / "WristMotion.csv").unlink()
    (folder / "2024-06-10.json").write_text(json.dumps(rows))


def zip_in_a_zip(folder: Path, walk: ImuSequence) -> None:
    android(folder / "unpacked", walk)
    with zipfile.ZipFile(folder / "inner.zip", "w") as file:
        for one in (folder / "unpacked").iterdir():
            file.write(one, f"2024-06-10/{one.name}")
            file.writestr(f"__MACOSX/2024-06-10/._{one.name}", b"\0\5\26\7")
            one.unlink()
    (folder / "unpacked").rmdir()
    with zipfile.ZipFile(folder / "outer.zip", "w") as file:
        file.write(folder / "inner.zip", "inner.zip")
    (folder / "inner.zip").unlink()


def phyphox_with_and_without_g(folder: Path, walk: ImuSequence) -> None:
    linear = walk.accel - gravity(walk)
    for name, unit, values in (("Acceleration with g", "m/s^2", walk.accel),
                               ("Acceleration without g", "m/s^2", linear),
                               ("Gyroscope", "rad/s", walk.gyro)):  # fmt: skip
        header = ",".join(['"Time (s)"', *(f'"{axis} ({unit})"' for axis in "XYZ")])
        save(folder / f"{name}.csv", header, walk.time, values)


def phyphox_one_table(folder: Path, walk: ImuSequence) -> None:
    """Each sensor has its own clock; the last rows of the shorter one are blank."""
    header = '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)"'
    header += ',"Acceleration z (m/s^2)","Gyroscope time (s)","Gyroscope x (rad/s)"'
    header += ',"Gyroscope y (rad/s)","Gyroscope z (rad/s)"'
    n = len(walk)
    accel = np.column_stack([walk.time, walk.accel]).tolist()
    longer = np.append(walk.time, walk.time[-1] + 0.01 * np.arange(1, 6))
    gyro = np.column_stack([longer, np.vstack([walk.gyro, np.ones((5, 3))])])
    save(folder / "Raw Data.csv", header, [*accel, *[[""] * 4] * 5], gyro)
    assert (folder / "Raw Data.csv").read_text().count(",,,,") == len(longer) - n


def androsensor_other_units(folder: Path, walk: ImuSequence) -> None:
    header = ",".join(ANDROSENSOR).replace("m/s²", "g").replace("rad/s", "°/s")
    columns = walk.accel / STANDARD_GRAVITY, np.degrees(walk.gyro), field(walk)
    millis = np.round(1e3 * walk.time).astype(int)
    save(folder / "a.csv", header + ",Time since start in ms", *columns, millis)


def androsensor_garbled(folder: Path, walk: ImuSequence) -> None:
    """Unit symbols decoded with another encoding and saved again."""
    header = ",".join(ANDROSENSOR).replace("²", "Â²").replace("μ", "Î¼")
    millis = np.round(1e3 * walk.time).astype(int)
    columns = walk.accel, walk.gyro, field(walk), millis
    save(folder / "a.csv", header + ",Time since start in ms", *columns)


def androsensor_lost_symbols(folder: Path, walk: ImuSequence) -> None:
    androsensor_garbled(folder, walk)
    text = (folder / "a.csv").read_text()
    (folder / "a.csv").write_text(text.replace("Â²", "\ufffd").replace("Î¼", "\ufffd"))


def senslogs_first_version(folder: Path, walk: ImuSequence) -> None:
    """Text above the rows, two clocks, and the bias in separate columns."""
    drift = np.tile([0.01, 0.02, -0.01], (len(walk), 1))
    off = ["estimated-drift-x", "estimated-drift-y", "estimated-drift-z"]
    for name, titles, values in (
        ("accelerometer", [], walk.accel),
        ("gyroscope", off, np.hstack([walk.gyro + drift, drift])),
        ("magnetometer-calibrated", [], field(walk)),
    ):
        words = ["elapsed-time-system", "elapsed-time-sensor", "x", "y", "z", *titles]
        above = f"{name}.txt\n\nAll values are in SI units.\nhttp://example.org\n\n"
        save(folder / f"{name}.txt", above + " ".join(words), walk.time + 0.003, walk.time, values,
             sep=" ")  # fmt: skip


def two_clocks_and_no_header(folder: Path, walk: ImuSequence) -> None:
    for name, values in (("accelerometer", walk.accel), ("gyroscope", walk.gyro),
                         ("magnetometer", field(walk))):  # fmt: skip
        save(folder / f"{name}.txt", "", walk.time + 0.003, walk.time, values, sep=" ")


def senslogs_ios(folder: Path, walk: ImuSequence) -> None:
    """Without its attitude; the description file indicates the operating system."""
    phone_exports.senslogs_ios(folder, walk)
    (folder / "attitude.txt").unlink()
    (folder / "description.txt").write_text("[Time]\nBootTime = 55687.0793")


def ios_logger(folder: Path, walk: ImuSequence) -> None:
    """In g, Apple's sign; `Motion.txt` is the attitude, w first; `MotMagnFull` is calibrated."""
    t = 1.6e9 + walk.time
    save(folder / "Accel.txt", "", t, -walk.accel / STANDARD_GRAVITY)
    save(folder / "Gyro.txt", "", t, walk.gyro)
    save(folder / "Magnet.txt", "", t, field(walk) + 300.0)
    save(folder / "MotMagnFull.txt", "", t, field(walk), np.full(len(walk), 2))
    save(folder / "Motion.txt", "", t, walk.truth.quat_xyzw[:, [3, 0, 1, 2]])
    save(folder / "Frames.txt", "", t[::3], np.ones((len(t[::3]), 5)))


def ios_logger_with_poses(folder: Path, walk: ImuSequence) -> None:
    ios_logger(folder, walk)
    (folder / "Motion.txt").unlink()
    up = Rotation.from_euler("x", -90.0, degrees=True)
    quat = (up * walk.truth.attitude_WB).as_quat()[:, [3, 0, 1, 2]]
    position = up.apply(walk.truth.position_W)
    save(folder / "ARposes.txt", "", 1.6e9 + walk.time[::3], position[::3], quat[::3])


VARIANTS: dict[str, Callable[[Path, ImuSequence], None]] = {
    write.__name__: write
    for write in (
        readable_times, extra_sensors, watch, iphone,
        iphone_standardised, iphone_uncalibrated, json_export, json_export_of_a_watch, zip_in_a_zip,
        phyphox_with_and_without_g, phyphox_one_table, androsensor_other_units,
        androsensor_garbled, androsensor_lost_symbols, senslogs_first_version,
        two_clocks_and_no_header, senslogs_ios, ios_logger, ios_logger_with_poses,
    )
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_is_read_as_the_same_walk(variant, walk, tmp_path):
    VARIANTS[variant](tmp_path / "s", walk)
    (found,) = find_recordings(tmp_path / "s")
    read = read_recording(found)
    assert_same_samples(read, walk)
    if read.magnetometer is not None:
        np.testing.assert_allclose(read.magnetometer.field, field(walk), atol=1e-8)


def test_a_recording_has_a_one_line_summary(walk, tmp_path):
    android(tmp_path / "a", walk)
    ios_logger(tmp_path / "b", walk)
    tail = "15.0 s at 100.0 Hz, magnetometer at 100 Hz"
    assert read_recording(tmp_path / "a").summary() == f"a: Sensor Logger, {tail}, truth: none"
    assert read_recording(tmp_path / "b").summary() == (
        f"b: iOS Logger, {tail}, the device's own attitude, truth: none"
    )


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


def test_sensors_of_different_rates_are_read_at_the_gyroscopes_rate(walk, tmp_path):
    save(tmp_path / "s/Gyroscope.csv", ZYX, ns(walk), walk.time, walk.gyro[:, ::-1])
    rows = slice(None, None, 2)
    force = walk.accel[rows, ::-1]
    save(tmp_path / "s/TotalAcceleration.csv", ZYX, ns(walk)[rows], walk.time[rows], force)
    read = read_recording(tmp_path / "s")
    assert read.rate == pytest.approx(100.0)
    np.testing.assert_array_equal(read.accel[rows], walk.accel[rows])
    halfway = 0.5 * (walk.accel[:-2:2] + walk.accel[2::2])
    np.testing.assert_allclose(read.accel[1::2], halfway, atol=1e-6)


def test_an_undetermined_accelerometer_sign_is_reported(walk, tmp_path, caplog):
    iphone(tmp_path / "s", walk)
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
    ios_logger(tmp_path / "t", walk)
    for name in ("Motion.txt", "MotMagnFull.txt"):
        (tmp_path / "t" / name).unlink()
    with pytest.raises(InputError, match=r"`--accel-unit g`.* `--accel-sign apple`"):
        check_units(read_recording(tmp_path / "t"))
    assert not caplog.text


@pytest.mark.parametrize("code", ["TYPE", "AHRS"])
def test_the_rotation_vector_of_a_trace_is_the_devices_attitude(code, walk, tmp_path):
    """It contains x, y and z of a quaternion whose w is not negative."""
    vector = walk.truth.quat_xyzw[:, :3] * np.sign(walk.truth.quat_xyzw[:, 3:])
    lines = []
    for k, t in enumerate(walk.time.tolist()):
        rows = (("GYROSCOPE", "GYRO", walk.gyro[k]), ("ACCELEROMETER", "ACCE", walk.accel[k]))
        if code == "TYPE":
            stamp = str(1_560_828_400_000 + round(1e3 * t))
            cells = [[stamp, f"TYPE_{name}", *map(str, xyz), "3"] for name, _, xyz in rows]
            cells.append([stamp, "TYPE_ROTATION_VECTOR", *map(str, vector[k]), "3"])
            lines += ["\t".join(row) for row in cells]
        else:
            clock = [f"{t + 5:.3f}", f"{t:.4f}"]
            lines += [";".join([name, *clock, *map(str, xyz), "3"]) for _, name, xyz in rows]
            lines.append(";".join(["AHRS", *clock, "1", "2", "3", *map(str, vector[k]), "3"]))
    write_lines(tmp_path / "trace.txt", *lines)
    attitude = read_recording(tmp_path / "trace.txt").device_attitude
    difference = attitude.attitude_WB * walk.truth.attitude_WB.inv()
    assert difference.magnitude().max() < 1e-6
    cut = (tmp_path / "trace.txt").read_text().replace(";1;2;3;", ";1;2;").replace("\t3\n", "\n")
    (tmp_path / "trace.txt").write_text(cut)
    assert (read_recording(tmp_path / "trace.txt").device_attitude is None) == (code == "AHRS")


@pytest.mark.parametrize("per_second", [10**4, 10**6])  # MT devices and DOTs
def test_the_clock_of_xsens_is_in_ticks_or_microseconds(tmp_path, per_second):
    names = [f"{name}_{axis}" for name in ("Acc", "Gyr") for axis in "XYZ"]
    rows = [f"{k}\t{10**5 + k * per_second // 100}\t0\t0\t9.8\t0\t0\t0" for k in range(200)]
    path = tmp_path / "MT_0.txt"
    lines = [
        "// Update Rate: 100.0Hz",
        "\t".join(["PacketCounter", "SampleTimeFine", *names]),
        *rows,
    ]
    write_lines(path, *lines)
    read = read_recording(path)
    assert read.rate == pytest.approx(100.0)
    assert read.duration == pytest.approx(1.99)


def test_a_file_in_g_is_named_by_its_own_name_and_read_without_advice_on_options(tmp_path, caplog):
    """`check_units` asks for the options, and only if they were not given."""
    names = [
        f"{name}.{axis}"
        for name in ("gravity", "rotationRate", "userAcceleration")
        for axis in "xyz"
    ]
    rows = [f"{0.01 * k:.2f},0,0,-1,0,0,0,0,0,{0.01 * (k % 3)}" for k in range(200)]
    path = write_lines(tmp_path / "walk.csv", ",".join(["timestamp", *names]), *rows)
    with caplog.at_level("INFO"):
        read_recording(path)
    assert "walk.csv: added gravity" in caplog.text
    assert "--accel-unit" not in caplog.text
