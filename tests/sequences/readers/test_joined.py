"""Tables whose times are in several columns, in a file of their own, or nowhere."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stario.sequences.errors import StarioError
from stario.sequences.readers import find_recordings, read_recording
from stario.sequences.sequence import ImuSequence

START, START_S = 1_700_000_000, 3595
SENSORS = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]


def table(path: Path, titles: Sequence[str], rows: Sequence[Sequence[object]]) -> Path:
    lines = [",".join(map(str, row)) for row in ([titles, *rows] if titles else rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def parts(time: float) -> tuple[int, int]:
    """Return whole seconds since 1970 and nanoseconds of a time since the start [s]."""
    ns = round(time * 1e9)
    return START + ns // 10**9, ns % 10**9


def check(read: ImuSequence, walk: ImuSequence) -> None:
    assert_allclose(read.time, walk.time, atol=1e-8)
    assert_allclose(read.gyro, walk.gyro, atol=1e-9)
    assert_allclose(read.accel, walk.accel, atol=1e-9)


def seconds_and_nanoseconds(walk: ImuSequence) -> tuple[list[str], list[tuple[int, ...]]]:
    return ["sec", "nanosec"], [parts(t) for t in walk.time]


def utc_without_a_date(walk: ImuSequence) -> tuple[list[str], list[tuple[int, ...]]]:
    """The hour turns over within the recording."""
    times = [(START_S + s - START, n) for s, n in map(parts, walk.time.tolist())]
    return ["UTC_Nano", "UTC_Minute", "UTC_Second"], [(n, s // 60 % 60, s % 60) for s, n in times]


@pytest.mark.parametrize("clock", [seconds_and_nanoseconds, utc_without_a_date])
def test_times_in_several_columns_are_joined(tmp_path, walk, clock):
    titles, times = clock(walk)
    values = zip(times, walk.gyro.tolist(), walk.accel.tolist(), strict=True)
    path = table(tmp_path / "a.csv", [*titles, *SENSORS], [[*t, *g, *a] for t, g, a in values])
    check(read_recording(path), walk)


def test_a_cut_row_is_named_by_its_line(tmp_path, walk):
    titles, times = seconds_and_nanoseconds(walk)
    rows = [[*t, *g, *a] for t, g, a in zip(times, walk.gyro, walk.accel, strict=True)]
    rows[5] = rows[5][:4]
    with pytest.raises(StarioError, match=r"a\.csv: line 7"):
        read_recording(table(tmp_path / "a.csv", [*titles, *SENSORS], rows))


def test_messages_that_ros2_topic_echo_wrote_as_csv_are_read(tmp_path, walk):
    covariance = [0.0] * 9
    rows = [
        [*parts(t), "imu_link", 0, 0, 0, 1, *covariance, *g, *covariance, *a, *covariance]
        for t, g, a in zip(walk.time, walk.gyro.tolist(), walk.accel.tolist(), strict=True)
    ]
    check(read_recording(table(tmp_path / "echo.csv", [], rows)), walk)


@pytest.mark.parametrize("names", [("gyro-0", "accel-0", "time"), ("gyr", "acc", "timestamps")])
def test_one_file_per_sensor_and_one_of_times_are_joined_by_row(tmp_path, walk, names):
    folder = tmp_path / "set" / "walk"
    folder.mkdir(parents=True)
    for name, values in zip(names, (walk.gyro, walk.accel, walk.time[:, None]), strict=True):
        titles = list("xyz") if values.shape[1] == 3 else ["time (sec)"]
        table(folder / f"{name}.csv", titles, values.tolist())
    assert find_recordings(tmp_path) == [folder]
    check(read_recording(folder), walk)
    table(folder / f"{names[2]}.csv", ["time"], walk.time[: len(walk) // 2, None].tolist())
    with pytest.raises(StarioError, match=f"found {len(walk) // 2} and {len(walk)} rows"):
        read_recording(folder)


def test_a_table_without_times_is_read_at_the_rate_given(tmp_path, walk):
    rows = np.column_stack([np.arange(len(walk)), walk.gyro, walk.accel]).tolist()
    path = table(tmp_path / "a.csv", ["count", *SENSORS], rows)
    check(read_recording(path, rate="200"), walk)
    with pytest.raises(StarioError, match="--rate"):
        read_recording(path)
    with pytest.raises(StarioError, match="samples per second"):
        read_recording(path, rate="0")
    timed = table(tmp_path / "b.csv", ["time [s]", *SENSORS], rows)
    with pytest.raises(StarioError, match=r"the column time \[s\]"):
        read_recording(timed, rate="200")
