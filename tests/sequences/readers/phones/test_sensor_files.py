from pathlib import Path

import numpy as np
import pytest
from phone_exports import save

from stario.sequences import (
    ImuSequence,
    InputError,
    ReadError,
    find_recordings,
    read_recording,
    simulate_imu,
    with_units,
)
from stario.sequences.arrays import interpolated
from stario.sequences.sequence import FloatArray

HEADER = "seconds_elapsed,x,y,z"

# --- which files are one recording -----------------------------------------------------------


def write(folder: Path, walk: ImuSequence, *names: str) -> Path:
    """Write files of gyroscope samples, or of the accelerometer's if the name contains "acc"."""
    for name in names:
        values = walk.accel if "acc" in name.lower() else walk.gyro
        save(folder / f"{name}.csv", "", walk.time, values)
    return folder


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ("walk1_acc", "walk1_gyr", "walk2_acc", "walk2_gyr"),
            r"a folder of 2 recordings, .*; name one, such as .*/walk1_gyr\.csv",
        ),
        (("acc_1", "acc_2", "gyr_3"), r"recordings \(acc_1\.csv, acc_2\.csv, gyr_3"),
        (
            ("left_gyro_1", "right_accel_2"),
            r"different devices .*\(left_gyro_1\.csv, right_accel_2\.csv\)",
        ),
        (("Gyroscope", "WatchAccelerometer"), r"\(Gyroscope\.csv, WatchAccelerometer\.csv\)"),
        (("Gyroscope", "accelerometer", "Gyroscope (1)", "accelerometer (1)"), "2 recordings"),
    ],
)
def test_recordings_that_share_a_folder_are_not_mixed(names, message, walk, tmp_path):
    with pytest.raises(ReadError, match=message):
        read_recording(write(tmp_path / "w", walk, *names))


def test_files_with_two_prefixes_are_two_recordings(walk, tmp_path):
    """Or with the numbers of a browser's copies."""
    folder = write(tmp_path / "s", walk, "one_acc", "one_gyr", "Two_acc", "Two_gyr")
    save(folder / "Two_gyr.csv", "", walk.time, -walk.gyro)
    found = find_recordings(tmp_path)
    assert found == [folder / "Two_gyr.csv", folder / "one_gyr.csv"]
    two, one = map(read_recording, found)
    assert (two.name, one.name) == ("Two", "one")
    np.testing.assert_array_equal(two.gyro, -walk.gyro)
    np.testing.assert_array_equal(one.gyro, walk.gyro)
    write(tmp_path / "c", walk, "Gyroscope", "accelerometer", "accelerometer (1)")
    save(tmp_path / "c/Gyroscope (1).csv", "", walk.time, -walk.gyro)
    copy = read_recording(tmp_path / "c/Gyroscope (1).csv")
    np.testing.assert_array_equal(copy.gyro, -walk.gyro)


@pytest.mark.parametrize(
    ("names", "other"),
    [
        (("watch_acc", "watch_gyr"), "phone_acc"),  # a sensor is paired with its own device's
        (("Gyroscope", "accelerometer"), "Gyroscope (1)"),  # a copy that a browser numbers
        (("left_gyro_1", "left_accel_2"), None),
    ],
)
def test_a_file_of_another_recording_is_left_out(names, other, walk, tmp_path):
    write(tmp_path, walk, *names)
    if other is not None:
        save(tmp_path / f"{other}.csv", "", walk.time, 2.0 * walk.accel)
    read = read_recording(tmp_path)
    np.testing.assert_array_equal(read.accel, walk.accel)
    np.testing.assert_array_equal(read.gyro, walk.gyro)


# --- titles and units ------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [50.0, 1000.0, 1125.0])
@pytest.mark.parametrize("start", [0.0, 12345.678])
def test_the_time_unit_is_determined_at_every_accepted_rate(rate, start, walk, tmp_path):
    short = simulate_imu(walk.truth.slice(0.0, 2.0), rate)
    later = ImuSequence("w", np.round(start + short.time, 6), short.gyro, short.accel)
    read = read_recording(write(tmp_path, later, "acc", "gyr"))
    assert read.rate == pytest.approx(rate, rel=1e-3)


def test_a_unit_named_by_a_logger_is_used_once_or_refused(walk, tmp_path):
    for clock in ("milliseconds", "ticks"):
        for name, unit, values in (
            ("acc", "m/s^2", walk.accel), ("gyr", "deg/s", np.degrees(walk.gyro))
        ):  # fmt: skip
            header = f"time [{clock}],x [{unit}],y,z"
            save(tmp_path / clock / f"{name}.csv", header, 1e3 * walk.time, values)
    named = read_recording(tmp_path / "milliseconds")
    np.testing.assert_allclose(named.time, walk.time)
    with pytest.raises(InputError, match="whose file names its unit"):
        with_units(named, gyro_unit="deg/s")
    with_units(named, accel_unit="-m/s^2")
    with pytest.raises(ReadError, match="time: found unit 'ticks', expected s, ms, us, ns"):
        read_recording(tmp_path / "ticks")


# --- clocks ----------------------------------------------------------------------------------


def written(folder: Path, walk: ImuSequence, gyro_time: FloatArray, accel_time: FloatArray) -> Path:
    """Write samples of a walk at each sensor's times."""
    for name, values, time in (
        ("Gyroscope", walk.gyro, gyro_time), ("Accelerometer", walk.accel, accel_time),
    ):  # fmt: skip
        save(folder / f"{name}.csv", HEADER, time, interpolated(time, walk.time, values))
    return folder


def test_a_second_session_in_the_same_files_does_not_mix_with_the_first(tmp_path, walk, caplog):
    gyro_time, accel_time = walk.time[:500], walk.time[:500] + 0.004
    folder = written(tmp_path, walk, gyro_time, accel_time)
    for file in folder.iterdir():  # the app restarts its clock and appends
        again = file.read_text(encoding="utf-8").splitlines()[1:]
        flat = [f"{float(line.split(',')[0]) + 0.002:.4f},0.0,0.0,0.0" for line in again]
        file.write_text("\n".join([HEADER, *again, *flat]) + "\n", encoding="utf-8")
    read = read_recording(folder)
    first = slice(0, 498)
    force = interpolated(read.time[first] + 0.01, walk.time, walk.accel)
    np.testing.assert_allclose(read.accel[first], force, atol=0.8)  # interpolated twice
    assert "accelerometer: dropped 499 of 1000 samples whose times go back" in caplog.text


def test_odd_times_of_the_accelerometer_are_reported(tmp_path, walk, caplog):
    """In batches, as slow as no IMU, or, which is no fault, each logged twice."""
    in_batches = walk.time[np.arange(len(walk)) // 4 * 4]
    save(tmp_path / "Gyroscope.csv", HEADER, walk.time, walk.gyro)
    for times, accel, words in (
        (in_batches, walk.accel, "accelerometer: found 3.99 samples on average at each time"),
        (walk.time[::6], walk.accel[::6], "found 16.7 samples/s, expected 50 to 1000"),
        (walk.time.repeat(2), walk.accel.repeat(2, axis=0), ""),
    ):
        caplog.clear()
        save(tmp_path / "Accelerometer.csv", HEADER, times, accel)
        read = read_recording(tmp_path)
        assert words in caplog.text
    np.testing.assert_allclose(read.accel, walk.accel)
    assert "samples" not in caplog.text


def test_clocks_of_different_phase_are_interpolated_but_not_across_a_gap(walk, tmp_path):
    t = walk.time
    accel_time = np.delete(t[:-1] + 0.0034, np.arange(400, 500))
    read = read_recording(written(tmp_path / "s", walk, t, accel_time))
    assert len(read) == len(t) - 2 - 101
    assert np.diff(read.time).max() == pytest.approx(1.02, abs=1e-6)
    kept = np.searchsorted(t, read.time + t[1] - 1e-6)
    assert np.array_equal(read.gyro, walk.gyro[kept])
    assert np.abs(read.accel - walk.accel[kept]).max() < 0.8
    late = written(tmp_path / "late", walk, t, t)
    save(late / "Accelerometer.csv", HEADER, t + 100.0, walk.accel)
    with pytest.raises(ReadError, match=r"from 0.000 to 15.000 s, accelerometer from 1"):
        read_recording(late)
