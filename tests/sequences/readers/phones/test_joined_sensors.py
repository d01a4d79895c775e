"""Sensors in files of their own, whose times differ: joined to one recording, or reported."""

from pathlib import Path

import numpy as np
import pytest
from phone_files import save

from stario.sequences import ImuSequence, ReadError, read_recording
from stario.sequences.arrays import interpolated
from stario.sequences.sequence import FloatArray

HEADER = "seconds_elapsed,x,y,z"


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


def test_times_of_batches_of_the_accelerometer_are_reported(tmp_path, walk, caplog):
    folder = written(tmp_path, walk, walk.time, walk.time)
    in_batches = walk.time[np.arange(len(walk)) // 4 * 4]
    save(folder / "Accelerometer.csv", HEADER, in_batches, walk.accel)
    read_recording(folder)
    assert "accelerometer: found 3.99 samples on average at each time" in caplog.text


def test_samples_logged_twice_are_not_reported(tmp_path, walk, caplog):
    folder = written(tmp_path, walk, walk.time, walk.time)
    save(folder / "Accelerometer.csv", HEADER, walk.time.repeat(2), walk.accel.repeat(2, axis=0))
    np.testing.assert_allclose(read_recording(folder).accel, walk.accel)
    assert "samples" not in caplog.text


def test_a_slow_accelerometer_is_reported(tmp_path, walk, caplog):
    read_recording(written(tmp_path, walk, walk.time, walk.time[::6]))
    assert "accelerometer: found 16.7 samples/s, expected 50 to 1000" in caplog.text


def test_sensors_that_start_late_keep_the_order_and_unit_of_their_titles(tmp_path, walk):
    for name, unit, values in (
        ("Gyroscope", "deg/s", np.degrees(walk.gyro)), ("Accelerometer", "g", walk.accel / 9.80665)
    ):  # fmt: skip
        file = tmp_path / f"{name}.csv"
        save(file, f"time,z ({unit}),y ({unit}),x ({unit})", walk.time, values[:, ::-1])
        header, first, *rows = file.read_text(encoding="utf-8").splitlines()
        file.write_text("\n".join([header, f"{first.split(',')[0]},,,", *rows]) + "\n")
    read = read_recording(tmp_path)
    np.testing.assert_allclose(read.gyro, walk.gyro[1:], atol=1e-9)
    np.testing.assert_allclose(read.accel, walk.accel[1:], atol=1e-9)


@pytest.mark.parametrize("titles", ["Uhrzeit,#", "ts,accuracy,#", "#,ticks"])
def test_axes_are_those_of_the_titles_if_the_clocks_is_unknown(titles, tmp_path, walk):
    for name, unit, values in (
        ("Gyroscope", "deg/s", np.degrees(walk.gyro)), ("Accelerometer", "m/s^2", walk.accel)
    ):  # fmt: skip
        axes = f"z ({unit}),y ({unit}),x ({unit})"
        columns = [walk.time, values[:, ::-1]]
        if "accuracy" in titles:
            columns.insert(1, np.full(len(walk), 3))
        columns = columns[::-1] if titles.startswith("#") else columns
        save(tmp_path / f"{name}.csv", titles.replace("#", axes), *columns)
    read = read_recording(tmp_path)
    np.testing.assert_allclose(read.gyro, walk.gyro, atol=1e-9)
    np.testing.assert_allclose(read.accel, walk.accel, atol=1e-9)


def test_copies_that_a_browser_numbers_are_another_recording(tmp_path, walk):
    folder = written(tmp_path, walk, walk.time, walk.time)
    save(folder / "Gyroscope (1).csv", HEADER, walk.time, -walk.gyro)
    np.testing.assert_allclose(read_recording(folder).gyro, walk.gyro)
    save(folder / "Accelerometer (1).csv", HEADER, walk.time, walk.accel)
    with pytest.raises(ReadError, match="a folder of 2 recordings"):
        read_recording(folder)
    np.testing.assert_allclose(read_recording(folder / "Gyroscope (1).csv").gyro, -walk.gyro)
