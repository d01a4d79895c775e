import logging
from pathlib import Path

import numpy as np
import pytest
from alike import assert_same_samples
from csv_lines import write_lines
from phone_exports import Walk, export, write

from stario.sequences import ImuSequence, ReadError, read_recording

TABLES = {
    # A unit within the name.
    "time,acc_@_g,gyr_@_dps": lambda w: (w.t, w.a_g, w.w_deg),
    "time,acc_g_@,gyr_dps_@": lambda w: (w.t, w.a_g, w.w_deg),
    "Time (s),Accelerometer @ g,Gyroscope @ deg/s": lambda w: (w.t, w.a_g, w.w_deg),
    "time,accelerometer.@.g,gyroscope.@.rad/s": lambda w: (w.t, w.a_g, w.w),
    "time,acc_@_mg,gyr_@_mdps": lambda w: (w.t, 1e3 * w.a_g, 1e3 * w.w_deg),
    "time_s,acc_@_m_s2,gyro_@_deg_s": lambda w: (w.t, w.a, w.w_deg),
    "time_s,acc_@_mps2,gyro_@_rads": lambda w: (w.t, w.a, w.w),
    "t,a@_g,g@_dps": lambda w: (w.t, w.a_g, w.w_deg),
    "t,a@_ms2,w@_rad_s": lambda w: (w.t, w.a, w.w),
    "time,IMU(0):acc@,IMU(0):gyro@": lambda w: (w.t, w.a, w.w),
    "time,imu_a_@,imu_g_@": lambda w: (w.t, w.a, w.w),  # no unit of a sensor
    "time,IMU(0):acc@ (g),IMU(0):gyro@ (deg/s)": lambda w: (w.t, w.a_g, w.w_deg),
    "Time, s;Acc @, g;Gyro @, deg/s": lambda w: (w.t, w.a_g, w.w_deg),
    # Numbered elements, as in PX4's `sensor_combined`; a letter of a device's name.
    "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],accelerometer_m_s2[1],"
    "accelerometer_m_s2[2],accelerometer_timestamp_relative": lambda w: (
        (w.us, w.w, w.a, np.zeros(len(w.t), dtype=int))
    ),
    "Shimmer_A_Timestamp,Shimmer_A_Accel_@_CAL,Shimmer_A_Gyro_@_CAL": lambda w: (w.ns, w.a, w.w),
    # Variants of one sensor are no second IMU; the sensors of two are not mixed.
    "time,acc_raw_@,acc_@,gyro_raw_@,gyro_@": lambda w: (w.t, w.a + 1, w.a, w.w + 1, w.w),
    "time,FreeAcc_@,Acc_@,GyrUncal_@,Gyr_@": lambda w: (w.t, w.a + 1, w.a, w.w + 1, w.w),
    "time,Accel_WR_@,Accel_LN_@,Gyro_Uncal_@,Gyro_@": lambda w: ((w.t, w.a + 1, w.a, w.w + 1, w.w)),
    "time,right_acc_@,left_acc_@,left_gyro_@,right_gyro_@": lambda w: (
        (w.t, w.a + 1, w.a, w.w, w.w + 1)
    ),
    # As in the messages `IMU` of ArduPilot, in which `T` is the temperature.
    "TimeUS,I,Gyr*,Acc*,T": lambda w: (w.us, w.all(0), w.w, w.a, w.all(30.1)),
}


def table(folder: Path, titles: str, *columns: object) -> Path:
    """Write a table in which `@` and `*` of the titles become each axis."""
    write(folder, ("own.csv", titles, *columns))
    return folder / "own.csv"


@pytest.mark.parametrize("titles", TABLES)
def test_a_table_is_read_by_the_words_of_its_titles(titles, walk, tmp_path, caplog):
    assert_same_samples(read_recording(table(tmp_path, titles, *TABLES[titles](Walk(walk)))), walk)
    assert ("several IMUs" in caplog.text) == ("right" in titles)


# --- several IMUs ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("titles", "words"),
    [
        ("acc1_@,gyro1_@,acc2_@,gyro2_@", "gyro1_x, not those with gyro2_x, acc2_x"),
        (
            "accel_left_@,gyro_left_@,accel_right_@,gyro_right_@",
            "gyro_left_x, not those with gyro_right_x, accel_right_x",
        ),
        ("imu1_a@,imu1_g@,imu2_a@,imu2_g@", "imu1_gx, not those with imu2_gx, imu2_ax"),
        ("a@,g@,acc_raw_@,gyro2_@", "another IMU are not read: gyro2_x, gyro2_y, gyro2_z\n"),
    ],
)
def test_the_first_of_two_imus_is_read_and_named(titles, words, walk, tmp_path, caplog):
    columns = walk.time, walk.accel, walk.gyro, walk.accel + 1.0, walk.gyro + 1.0
    assert_same_samples(read_recording(table(tmp_path, f"time,{titles}", *columns)), walk)
    assert words in caplog.text
    columns = walk.time, walk.gyro, walk.accel, walk.accel
    neither = table(tmp_path, "time,gyro_@,acc_wrist_@,acc_hip_@", *columns)
    with pytest.raises(ReadError, match=r"\(acc_wrist_x and acc_hip_x\).*keep"):
        read_recording(neither)


@pytest.mark.parametrize(
    ("titles", "names"),
    [
        ("time [s],device,g@,a@", ("left", "right")),
        ("time [s],Device ID,Gyro *,Acc *", ("left", "right")),
        ("time [s],mac_address,g@,a@", ("left", "right")),
        ("time [s],side,Gyro *,Acc *", ("left", "right")),
        ("time [s],I,Gyr*,Acc*", (0, 1)),
    ],
)
def test_rows_of_several_devices_are_refused(titles, names, walk, tmp_path):
    one = np.repeat(names[0], len(walk))
    path = table(tmp_path, titles, walk.time, one, walk.gyro, walk.accel)
    path.write_text(path.read_text() + f"1.0,{names[1]},,,,,,\n")  # a row without IMU samples
    assert_same_samples(read_recording(path), walk)
    time, gyro, accel = (np.repeat(x, 2, axis=0) for x in (walk.time, walk.gyro, walk.accel))
    time[1::2] += 0.003  # so that no time repeats
    path = table(tmp_path, titles, time, np.tile(names, len(walk)), gyro, accel)
    title = titles.split(",")[1]
    with pytest.raises(ReadError, match=rf"{title}: .* \({names[0]}, {names[1]}\), expected one"):
        read_recording(path)


# --- rows that name their sensor -------------------------------------------------------------


def rows_of(walk: ImuSequence, folder: Path) -> tuple[str, list[str]]:
    export("rows_by_sensor", folder, walk)
    titles, *rows = (folder / "own.csv").read_text().splitlines()
    return titles, rows


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: sorted(rows, key=lambda row: row.split(",")[1]),  # one sensor after the other
        lambda rows: [row.replace("gyroscope", ("gyro (1)", "gyro-1-")[k // 3 % 2])
                      for k, row in enumerate(rows)],
    ],
    ids=["sorted", "two spellings"],
)  # fmt: skip
def test_rows_by_sensor_may_be_in_any_order_and_spelling(change, walk, tmp_path):
    titles, rows = rows_of(walk, tmp_path)
    path = write_lines(tmp_path / "own.csv", titles, *change(rows))
    assert_same_samples(read_recording(path), walk)


def test_messages_name_the_file_and_the_sensor(walk, tmp_path, caplog):
    titles, rows = rows_of(walk, tmp_path)
    path = tmp_path / "own.csv"
    with caplog.at_level(logging.INFO):
        read_recording(path)
    assert f"{path}/gyroscope.csv: its times name no unit" in caplog.text
    assert "stario-" not in caplog.text
    write_lines(path, titles, *(row for row in rows if "acc" in row))
    with pytest.raises(ReadError, match=r"own\.csv: sensors: found only accel"):
        read_recording(path)
