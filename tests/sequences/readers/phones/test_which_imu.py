"""Files with the sensors of several IMUs: one is read and named, or none; they are never mixed."""

import numpy as np
import pytest
from alike import assert_same_samples
from phone_files import save

from stario.sequences import ReadError, read_recording


def titles(*names: str) -> str:
    """Return a header in which `#` becomes each axis."""
    return ",".join(["time", *(name.replace("#", axis) for name in names for axis in "xyz")])


@pytest.mark.parametrize(
    "names",
    [
        ("acc1_#", "gyro1_#", "acc2_#", "gyro2_#"),
        ("accel_left_#", "gyro_left_#", "accel_right_#", "gyro_right_#"),
        ("imu1_a#", "imu1_g#", "imu2_a#", "imu2_g#"),
    ],
)
def test_the_first_of_two_imus_is_read_and_named(names, walk, tmp_path, caplog):
    columns = walk.time, walk.accel, walk.gyro, walk.accel + 1.0, walk.gyro + 1.0
    save(tmp_path / "own.csv", titles(*names), *columns)
    assert_same_samples(read_recording(tmp_path / "own.csv"), walk)
    first, *others = (names[k].replace("#", "x") for k in (1, 3, 2))
    assert f"read the one with {first}, not those with {', '.join(others)}" in caplog.text


def test_a_second_imu_beside_the_columns_of_a_generic_csv_is_named(walk, tmp_path, caplog):
    names = titles("g#", "a#", "gyro2_#", "acc_raw_#")
    columns = walk.gyro, walk.accel, walk.gyro + 1.0, walk.accel + 1.0
    save(tmp_path / "own.csv", names, walk.time, *columns)
    assert_same_samples(read_recording(tmp_path / "own.csv"), walk)
    assert "another IMU are not read: gyro2_x, gyro2_y, gyro2_z\n" in caplog.text


def test_the_sensors_of_two_imus_are_not_mixed(walk, tmp_path):
    """The right accelerometer comes first, but the left gyroscope."""
    names = titles("right_acc_#", "left_acc_#", "left_gyro_#", "right_gyro_#")
    save(tmp_path / "own.csv", names, walk.time, walk.accel + 1.0, walk.accel, walk.gyro,
         walk.gyro + 1.0)  # fmt: skip
    assert_same_samples(read_recording(tmp_path / "own.csv"), walk)


def test_two_accelerometers_and_a_gyroscope_of_neither_are_refused(walk, tmp_path):
    names = titles("gyro_#", "acc_wrist_#", "acc_hip_#")
    save(tmp_path / "own.csv", names, walk.time, walk.gyro, walk.accel, walk.accel)
    message = r"several IMUs \(acc_wrist_x and acc_hip_x\), expected one; keep the columns"
    with pytest.raises(ReadError, match=message):
        read_recording(tmp_path / "own.csv")


@pytest.mark.parametrize(
    "names",
    [
        ("acc_raw_#", "acc_#", "gyro_raw_#", "gyro_#"),
        ("FreeAcc_#", "Acc_#", "GyrUncal_#", "Gyr_#"),
        ("Accel_WR_#", "Accel_LN_#", "Gyro_Uncal_#", "Gyro_#"),
    ],
)
def test_variants_of_one_sensor_are_no_second_imu(names, walk, tmp_path, caplog):
    columns = walk.time, walk.accel + 1.0, walk.accel, walk.gyro + 1.0, walk.gyro
    save(tmp_path / "own.csv", titles(*names), *columns)
    assert_same_samples(read_recording(tmp_path / "own.csv"), walk)
    assert "several IMUs" not in caplog.text


def test_numbered_imus_in_alternating_rows_are_refused(walk, tmp_path):
    """As in the messages `IMU` of ArduPilot, in which `T` is the temperature."""
    header = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T"
    micros = 5_000_000 + np.round(1e6 * walk.time).astype(int)
    warmth = np.full(len(walk), 30.1)
    one = np.zeros(len(walk), dtype=int)
    save(tmp_path / "one.csv", header, micros, one, walk.gyro, walk.accel, warmth)
    assert_same_samples(read_recording(tmp_path / "one.csv"), walk)
    two = [np.repeat(x, 2, axis=0) for x in (micros, walk.gyro, walk.accel, warmth)]
    number = np.tile([0, 1], len(walk))
    save(tmp_path / "two.csv", header, two[0], number, *two[1:])
    with pytest.raises(ReadError, match=r"I: found several devices \(0, 1\), expected one"):
        read_recording(tmp_path / "two.csv")


@pytest.mark.parametrize("title", ["device", "Device ID", "mac_address", "side"])
@pytest.mark.parametrize("sensors", ["gx,gy,gz,ax,ay,az", "Gyro X,Gyro Y,Gyro Z,Acc X,Acc Y,Acc Z"])
def test_rows_of_named_devices_are_refused(sensors, title, walk, tmp_path):
    header = f"time [s],{title},{sensors}"
    rows = walk.time, np.repeat("left", len(walk)), walk.gyro, walk.accel
    save(tmp_path / "one.csv", header, *rows)
    assert_same_samples(read_recording(tmp_path / "one.csv"), walk)
    both = [np.repeat(x, 2, axis=0) for x in rows]
    both[0][1::2] += 0.003  # so that no time repeats
    both[1] = np.tile(["left", "right"], len(walk))
    save(tmp_path / "two.csv", header, *both)
    with pytest.raises(ReadError, match=rf"{title}: found several devices \(left, right\)"):
        read_recording(tmp_path / "two.csv")


def test_devices_of_rows_without_imu_samples_do_not_count(walk, tmp_path):
    file = tmp_path / "own.csv"
    save(file, "t [s],device,gx,gy,gz,ax,ay,az", walk.time, ["left"] * len(walk), walk.gyro,
         walk.accel)  # fmt: skip
    file.write_text(file.read_text() + "1.0,watch,,,,,,\n")
    assert len(read_recording(file)) == len(walk)
