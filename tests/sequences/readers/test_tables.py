import numpy as np
import pytest
from alike import assert_same_samples
from csv_lines import write_lines
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from phone_exports import export, save

from stario.sequences import ReadError, StarioError, read_recording
from stario.sequences.readers.columns import HEADER
from stario.sequences.readers.table_head import table_heads
from stario.sequences.sequence import FloatArray

ZYX = ["time", "z", "y", "x"]
"""Titles without which these columns would be read as x, y, z."""


@pytest.mark.parametrize(
    ("lines", "titles"),
    [
        ("made by a logger on a phone|0 1 2 3|1 1 2 3", []),
        ("t x y z|0 1 2 3|1 1 2 3", ["t", "x", "y", "z"]),
        ("# time,z,y,x|0 1 2 3|1 1 2 3", ZYX),  # as by NumPy's `savetxt`
        ("by a logger|time,z,y,x|0,,,|1,,,|2,1,2,3|3,1,2,3", ZYX),
        ("by a logger|time,z,y,x|0,NaN,NaN,NaN|2,1,2,3|3,1,2,3", ZYX),
        ("by a logger|time,z,y,x|0,null,,1|2,1,2,3|3,1,2,3", ZYX),
        ("|time,z,y,x|Started 12:00|2,1,2,3|3,1,2,3", ZYX),
        ("# a||# b|time,z,y,x|# walk|2,1,2,3|3,1,2,3", ZYX),
        ("time,z,y,x|int64,float,float,float|2,1,2,3|3,1,2,3", ZYX),
        ("0,,,|2,1,2,3|3,1,2,3", []),
        ("Zeit;x;y;z|0;0;0;0|0,01;0,5;-0,25;9,8|0,02;0,5;-0,25;9,8", ["Zeit", "x", "y", "z"]),
    ],
)
def test_titles_are_found_among_remarks_and_incomplete_rows(tmp_path, lines, titles):
    (tmp_path / "table.csv").write_text(lines.replace("|", "\n"))
    *_, head = table_heads(tmp_path / "table.csv")
    assert head.titles == titles
    assert head.row_format.decimal == ("," if "0,01" in lines else ".")


TITLES = ["gx [rad/s]", "gy [rad/s]", "gz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"]
ROWS = 40


def table(time_at: int) -> list[list[str]]:
    """Return titles and rows with the times in one of the seven columns."""
    rows = [["0.1", "0.2", "0.3", "1.0", "2.0", f"9.{k % 10}"] for k in range(ROWS)]
    lines = [list(TITLES), *rows]
    for k, line in enumerate(lines):
        line.insert(time_at, f"{0.01 * k:.2f}" if k else "t [s]")
    return lines


@given(
    time_at=st.integers(0, 6),
    row=st.integers(1, ROWS),
    kept=st.integers(0, 6),
    separator=st.sampled_from(",;\t"),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_a_row_that_lacks_cells_is_named(tmp_path, time_at, row, kept, separator):
    """The last one, cut short when the recorder was killed, is skipped."""
    lines = table(time_at)
    lines[row] = lines[row][:kept]
    text = [separator.join(line) for line in lines]
    path = tmp_path / "a.csv"
    if row == ROWS:
        path.write_text("\n".join(text))
    else:
        write_lines(path, *text)
    if row == ROWS or not kept:  # a blank line is none
        assert len(read_recording(path)) == ROWS - 1
    else:
        with pytest.raises(ReadError, match=rf"line {row + 1}: found {kept} values, expected 7"):
            read_recording(path)


@pytest.mark.parametrize("row", [1, ROWS // 2, ROWS])
def test_a_ragged_row_of_a_sensor_is_refused_within_and_skipped_at_an_end(tmp_path, row):
    """An app writes its first rows before all sensors have begun, and its last as it is killed."""
    for name in ("accelerometer", "gyroscope"):
        lines = [f"{0.01 * k:.2f},5.66,5.66,5.66" for k in range(ROWS)]
        if name == "gyroscope":
            lines[row - 1] = lines[row - 1].rsplit(",", 1)[0]
        write_lines(tmp_path / f"{name}.csv", "time [s],x,y,z", *lines)
    if row in (1, ROWS):
        assert len(read_recording(tmp_path)) == ROWS - 1
    else:
        with pytest.raises(ReadError, match=f"line {row + 1}"):
            read_recording(tmp_path)


GYRO_TIMES = 0.01 * np.arange(300)
ACCEL_TIMES = GYRO_TIMES[::2] + 0.003
WIDE = "time,Gyroscope X,Gyroscope Y,Gyroscope Z,Accelerometer X,Accelerometer Y,Accelerometer Z"


def rate(t: float) -> list[float]:
    return [0.1 + t, -0.2, 0.3 * t]


def force(t: float) -> list[float]:
    """Linear in time, so that interpolation is exact."""
    return [1.0 + t, 2.0 - t, 9.0]


def text(values: list[float]) -> str:
    return ",".join(map(repr, values))


def expected(times: FloatArray, start: float) -> tuple[FloatArray, FloatArray]:
    return np.array([rate(t + start) for t in times]), np.array([force(t + start) for t in times])


@pytest.mark.parametrize("header", [HEADER, WIDE])
def test_blank_cells_of_the_other_sensor_are_interpolated(tmp_path, header):
    rows = [(t, f"{t:.3f},{text(rate(t))},,,") for t in GYRO_TIMES.tolist()]
    rows += [(t, f"{t:.3f},,,,{text(force(t))}") for t in ACCEL_TIMES.tolist()]
    path = write_lines(tmp_path / "own.csv", header, *(row for _, row in sorted(rows)))
    read = read_recording(path)
    assert read.rate == pytest.approx(100.0)
    assert len(read) == 298  # between the first and the last accelerometer sample
    gyro, accel = expected(read.time, 0.01)
    np.testing.assert_allclose(read.gyro, gyro, atol=1e-9)
    np.testing.assert_allclose(read.accel, accel, atol=1e-9)


def test_an_accelerometer_that_fails_halfway_leaves_its_rows_to_be_counted(tmp_path):
    cells = [text(force(t)) if t < 1.0 else "nan,nan,nan" for t in GYRO_TIMES.tolist()]
    rows = [f"{t},{text(rate(t))},{cells[k]}" for k, t in enumerate(GYRO_TIMES.tolist())]
    path = write_lines(tmp_path / "own.csv", HEADER, *rows)
    read = read_recording(path)
    assert len(read) == 300
    assert np.isnan(read.accel).all(axis=1).sum() == 200


def test_ground_truth_in_rows_of_its_own_stays_on_the_samples_clock(tmp_path):
    header = f"{HEADER},px,py,pz,qx,qy,qz,qw"
    rows = [(t, f"{t:.3f},{text(rate(t))},,,,,,,,,,") for t in GYRO_TIMES.tolist()]
    rows += [(t, f"{t:.3f},,,,{text(force(t))},,,,,,,") for t in ACCEL_TIMES.tolist()]
    rows += [(t, f"{t:.3f},,,,,,,{t},0,0,0,0,0,1") for t in (GYRO_TIMES[::5] + 0.001).tolist()]
    path = write_lines(tmp_path / "own.csv", header, *(row for _, row in sorted(rows)))
    read = read_recording(path)
    np.testing.assert_allclose(read.truth.position_W[:, 0], read.truth.time + 0.01, atol=1e-9)
    np.testing.assert_allclose(read.gyro, expected(read.time, 0.01)[0], atol=1e-9)


@pytest.mark.parametrize("accel", ["a", "lin_acc_"])
def test_gravity_in_columns_of_its_own_is_added(tmp_path, accel):
    names = [f"{name}{axis}" for name in ("g", accel, "gravity_") for axis in "xyz"]
    rows = [f"{t},{text(rate(t))},{t},{-t},0.5,1,2,8.5" for t in GYRO_TIMES.tolist()]
    path = write_lines(tmp_path / "own.csv", ",".join(["t", *names]), *rows)
    np.testing.assert_allclose(read_recording(path).accel, expected(GYRO_TIMES, 0.0)[1], atol=1e-9)


SECONDS = 5.0
OURS = "t,gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"


@given(
    rates=st.tuples(st.integers(60, 400), st.integers(60, 400)),
    phase=st.floats(0.0001, 0.002),
    seed=st.integers(0, 99),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=10)
def test_zeros_of_the_sensor_that_was_not_read_are_no_samples(tmp_path, rates, phase, seed):
    rng = np.random.default_rng(seed)
    rows = []
    for sensor, rate in enumerate(rates):
        for t in np.arange(phase * sensor, SECONDS, 1.0 / rate):
            values = np.zeros(6)
            values[3 * sensor : 3 * sensor + 3] = rng.normal([0.0, 0.0, 9.8 * sensor], 0.3)
            rows.append([t, *values])
    rows.sort(key=lambda row: row[0])
    path = tmp_path / "a.csv"
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    write_lines(path, OURS.replace("t,", "t [s],"), *lines)
    read = read_recording(path)
    # Where both are, both are measured: nothing is 0, and gravity is whole.
    assert not (read.gyro == 0.0).all(axis=1).any()
    assert np.median(read.accel[:, 2]) == pytest.approx(9.8, abs=0.2)
    assert read.duration == pytest.approx(SECONDS, abs=0.1)


SENSORS = ",".join(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")


def test_a_cut_row_and_a_file_of_too_few_times_are_named(tmp_path, walk):
    export("seconds_and_nanoseconds", tmp_path, walk)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    lines[6] = lines[6].rsplit(",", 4)[0]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(StarioError, match=r"a\.csv: line 7"):
        read_recording(tmp_path / "a.csv")
    folder = tmp_path / "few"
    export("times_in_a_file", folder, walk)
    save(folder / "time.csv", "time", walk.time[: len(walk) // 2])
    with pytest.raises(StarioError, match=f"found {len(walk) // 2} and {len(walk)} rows"):
        read_recording(folder)


def test_a_table_without_times_is_read_at_the_rate_given(tmp_path, walk):
    columns = np.arange(len(walk)), walk.gyro, walk.accel
    path, timed, counted = (tmp_path / f"{name}.csv" for name in ("a", "b", "MT"))
    wide = ",".join(f"{name}_{axis}" for name in ("Gyr", "Acc") for axis in "XYZ")
    save(path, f"count,{SENSORS}", *columns)
    save(timed, f"time [s],{SENSORS}", *columns)
    save(counted, f"// Update Rate: 100.0Hz\nPacketCounter,{wide}", *columns)
    assert_same_samples(read_recording(path, rate="200"), walk)
    for file, options, message in (
        (path, {}, "--rate"),
        (counted, {}, r"MT\.csv: time: .*`t \[s\]`"),
        (path, {"rate": "0"}, "samples per second"),
        (timed, {"rate": "200"}, r"the column time \[s\]"),
    ):
        with pytest.raises(StarioError, match=message):
            read_recording(file, **options)
