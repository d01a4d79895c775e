"""What a table holds is told by its content: names of files and words for time decide nothing."""

import numpy as np
import pytest
from csv_lines import write_lines

from stario.sequences import ReadError, read_recording, write_csv

CLOCKS = {
    **{"t [s]": 1, "time_s": 1, "seconds_elapsed": 1, "timestamp [ms]": 1e3},
    **{"t_ms": 1e3, "time_ms": 1e3, "timestamp_ms": 1e3, "timestamp_ns": 1e9},
    **{"ts": 1, "ts_ms": 1e3},
}


@pytest.mark.parametrize("names", ["walk_imu_pose", "purpose_imu", "imu pose", "imu walk_arcore"])
@pytest.mark.parametrize("step", [1, 150], ids=["every pose", "sparse"])
def test_no_name_of_a_csv_loses_its_truth(names, step, walk, tmp_path):
    write_csv(tmp_path / "walk.csv", walk)
    header, *rows = (tmp_path / "walk.csv").read_text().splitlines()
    for k in set(range(len(rows))) - set(range(0, len(rows), step)):
        rows[k] = ",".join(rows[k].split(",")[:7]) + 7 * ","
    for name in names.split():
        write_lines(tmp_path / f"{name}.csv", header, *rows)
    for name in names.split():
        read = read_recording(tmp_path / f"{name}.csv")
        assert len(read.truth) == len(walk.truth.time[::step])
        assert np.array_equal(read.accel, walk.accel)


def test_a_recording_beside_another_is_not_its_poses(walk, tmp_path):
    write_csv(tmp_path / "pose.csv", walk)
    whole = (tmp_path / "pose.csv").read_text().splitlines()
    rows = [",".join(row.split(",")[:7]) for row in whole]
    assert read_recording(write_lines(tmp_path / "imu.csv", *rows)).truth is None


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("placed", [True, False], ids=["truth", "device's attitude"])
def test_any_title_of_a_clock_gives_the_same_recording(clock, placed, walk, tmp_path):
    write_csv(tmp_path / "walk.csv", walk)
    header, *rows = ([*row.split(",")] for row in (tmp_path / "walk.csv").read_text().splitlines())
    for row in rows:
        row[0] = f"{float(row[0]) * CLOCKS[clock]:.9g}"
    kept = [*range(7), *(range(7, 14) if placed else range(10, 14))]
    lines = [",".join(row[k] for k in kept) for row in ([clock, *header[1:]], *rows)]
    read = read_recording(write_lines(tmp_path / "walk.csv", *lines))
    np.testing.assert_allclose(read.time, walk.time, atol=1e-9)
    assert (read.truth is not None) == placed
    assert (read.device_attitude is not None) != placed


@pytest.mark.parametrize("coarse", ["timestamp", "time [ms]"])
def test_of_two_clocks_the_finer_is_read(coarse, walk, tmp_path):
    write_csv(tmp_path / "walk.csv", walk)
    header, *rows = (tmp_path / "walk.csv").read_text().splitlines()
    rows = [f"{1e6 + k // 10:g},{row}" for k, row in enumerate(rows)]
    read = read_recording(write_lines(tmp_path / "walk.csv", f"{coarse},{header}", *rows))
    assert np.array_equal(read.time, walk.time)


@pytest.mark.parametrize(
    "spelled",
    [
        "Gyroscope ?,Accelerometer ?,p?,q?",
        "Gyro_? [rad/s],Acc ?,Position ?,Quaternion ?",
        "gyro_rad/s_?,Acceleration ? (m/s²),pos.?,Orientation ?",
    ],
)
@pytest.mark.parametrize("count", [14, 10], ids=["poses", "positions"])
def test_a_file_with_positions_has_truth_however_it_is_spelled(spelled, count, walk, tmp_path):
    write_csv(tmp_path / "walk.csv", walk)
    _, *rows = (row.split(",") for row in (tmp_path / "walk.csv").read_text().splitlines())
    axes = [title.replace("?", axis) for title in spelled.split(",") for axis in "XYZ"]
    titles = ["t [s]", *axes, axes[-1].replace("Z", "W")]
    lines = [",".join(row[:count]) for row in (titles, *rows)]
    read = read_recording(write_lines(tmp_path / "walk.csv", *lines))
    assert np.array_equal(read.gyro, walk.gyro)
    assert np.array_equal(read.accel, walk.accel)
    track = read.truth if count > 10 else read.positions
    assert np.array_equal(track.position_W, walk.truth.position_W)


@pytest.mark.parametrize("names", ["gx gy gz ax ay az", "gyro_x gyro_y gyro_z acc_x acc_y acc_z"])
@pytest.mark.parametrize("units", [["deg/s", "rad/s", "rad/s"], ["", "rad/s", "deg/s"]])
def test_a_sensor_has_one_unit_whichever_of_its_axes_names_it(names, units, walk, tmp_path):
    def read(units):
        titles = [
            f"{name} [{unit}]".replace(" []", "")
            for name, unit in zip(names.split(), units, strict=True)
        ]
        cells = np.column_stack([walk.time, np.degrees(walk.gyro), walk.accel])
        rows = [",".join(map(str, row)) for row in cells.tolist()]
        return read_recording(write_lines(tmp_path / "w.csv", ",".join(["t [s]", *titles]), *rows))

    with pytest.raises(ReadError, match="expected one unit for all axes"):
        read([*units, "m/s^2", "m/s^2", "m/s^2"])
    np.testing.assert_allclose(read(["", "deg/s", "", "", "", "m/s^2"]).gyro, walk.gyro, atol=1e-9)
