"""One file whose gyroscope and accelerometer are in different rows, or in parts."""

import numpy as np
import pytest
from csv_lines import write_lines

from stario.sequences import read_recording
from stario.sequences.readers.columns import HEADER
from stario.sequences.sequence import FloatArray

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


def test_a_slower_accelerometer_is_interpolated(tmp_path):
    cells = [text(force(t)) if k % 3 == 0 else ",," for k, t in enumerate(GYRO_TIMES.tolist())]
    rows = [f"{t},{text(rate(t))},{cells[k]}" for k, t in enumerate(GYRO_TIMES.tolist())]
    path = write_lines(tmp_path / "own.csv", HEADER, *rows)
    read = read_recording(path)
    assert len(read) == 298
    np.testing.assert_allclose(read.accel, expected(read.time, 0.0)[1], atol=1e-9)


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
