"""One table in which each row names its sensor."""

import logging

import numpy as np
import pytest
from alike import assert_same_samples
from csv_lines import write_lines
from phone_files import field

from stario.sequences import ImuSequence, ReadError, find_recordings, read_recording

NAMES = {
    "words": ("gyroscope", "accelerometer", "magnetometer"),
    "codes": ("GYR", "ACC", "MAG"),
    "android": tuple(
        f"android.sensor.{name}" for name in ("gyroscope", "accelerometer", "magnetic_field")
    ),
}


def rows_of(walk: ImuSequence, names: tuple[str, ...], separator: str = ",") -> list[str]:
    sensors = list(zip(names, (walk.gyro, walk.accel, field(walk)), strict=True))
    return [
        separator.join([f"{t:.4f}", name, *map(repr, values[k].tolist())])
        for k, t in enumerate(walk.time.tolist())
        for name, values in sensors
    ]


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("header", ["time,sensor,x,y,z", "timestamp;sensor_name;v_x;v_y;v_z", ""])
def test_rows_are_sorted_by_their_sensor(names, header, walk, tmp_path):
    rows = rows_of(walk, names, ";" if ";" in header else ",")
    path = tmp_path / "own.csv"
    write_lines(path, *([header, *rows] if header else rows))
    assert find_recordings(tmp_path) == [path]
    read = read_recording(path)
    assert read.name == "own"
    assert "the sensor named in each row" in read.summary()
    assert_same_samples(read, walk)
    np.testing.assert_allclose(read.magnetometer.field, field(walk), atol=1e-9)


def test_one_sensor_after_the_other_is_read_too(walk, tmp_path):
    rows = rows_of(walk, NAMES["codes"])
    ordered = [row for code in ("ACC", "GYR") for row in rows if code in row]
    path = write_lines(tmp_path / "own.csv", "time,sensor,x,y,z", *ordered)
    assert_same_samples(read_recording(path), walk)


def test_times_may_be_those_of_the_day(walk, tmp_path):
    rows = [row.split(",", 1) for row in rows_of(walk, NAMES["words"])]
    path = tmp_path / "own.csv"
    lines = [f"12:00:{float(t):07.4f},{rest}" for t, rest in rows]
    write_lines(path, "Clock time,sensor,x,y,z", *lines)
    assert_same_samples(read_recording(path), walk)


def test_a_sensor_spelled_in_two_ways_is_one(walk, tmp_path):
    rows = rows_of(walk, ("gyro (1)", "acc", "mag"))
    rows[3::6] = [row.replace("gyro (1)", "gyro-1-") for row in rows[3::6]]
    path = write_lines(tmp_path / "own.csv", "time,sensor,x,y,z", *rows)
    assert_same_samples(read_recording(path), walk)


def test_messages_name_the_file_and_the_sensor(walk, tmp_path, caplog):
    path = tmp_path / "own.csv"
    rows = rows_of(walk, NAMES["codes"])
    write_lines(path, "time,sensor,x,y,z", *rows)
    with caplog.at_level(logging.INFO):
        read_recording(path)
    assert f"{path}/GYR.csv: its times name no unit" in caplog.text
    assert "stario-" not in caplog.text
    write_lines(path, "time,sensor,x,y,z", *(row for row in rows if "ACC" in row))
    with pytest.raises(ReadError, match=r"own\.csv: sensors: found only accel"):
        read_recording(path)
