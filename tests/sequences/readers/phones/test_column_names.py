"""One file with all sensors, whose columns are named as people name them."""

import numpy as np
import pytest
from alike import assert_same_samples
from phone_files import ns, save

from stario.sequences import read_recording
from stario.sequences.sequence import STANDARD_GRAVITY

DEG = np.degrees(1.0)
G = 1.0 / STANDARD_GRAVITY


def header(clock: str, accel: str, gyro: str, separator: str = ",") -> str:
    """Return titles in which `#` becomes each axis."""
    axes = [name.replace("#", axis) for name in (accel, gyro) for axis in "xyz"]
    return separator.join([clock, *axes])


@pytest.mark.parametrize(
    ("titles", "accel", "gyro"),
    [
        (header("time", "acc_#_g", "gyr_#_dps"), G, DEG),
        (header("time", "acc_g_#", "gyr_dps_#"), G, DEG),
        (header("Time (s)", "Accelerometer # g", "Gyroscope # deg/s"), G, DEG),
        (header("time", "accelerometer.#.g", "gyroscope.#.rad/s"), G, 1.0),
        (header("time", "acc_#_mg", "gyr_#_mdps"), 1e3 * G, 1e3 * DEG),
        (header("time_s", "acc_#_m_s2", "gyro_#_deg_s"), 1.0, DEG),
        (header("time_s", "acc_#_mps2", "gyro_#_rads"), 1.0, 1.0),
        (header("t", "a#_g", "g#_dps"), G, DEG),
        (header("t", "a#_ms2", "w#_rad_s"), 1.0, 1.0),
        (header("time", "IMU(0):acc#", "IMU(0):gyro#"), 1.0, 1.0),
        (header("time", "imu_a_#", "imu_g_#"), 1.0, 1.0),  # no unit of a sensor
        (header("time", "IMU(0):acc# (g)", "IMU(0):gyro# (deg/s)"), G, DEG),
        (header("Time, s", "Acc #, g", "Gyro #, deg/s", ";"), G, DEG),
    ],
)
def test_a_unit_within_the_name_is_converted(titles, accel, gyro, walk, tmp_path):
    columns = walk.time, accel * walk.accel, gyro * walk.gyro
    save(tmp_path / "own.csv", titles, *columns, sep=";" if ";" in titles else ",")
    assert_same_samples(read_recording(tmp_path / "own.csv"), walk)


def test_numbered_elements_of_a_sensor_are_its_axes(walk, tmp_path):
    """As PX4's `sensor_combined` names them."""
    names = [f"{name}[{k}]" for name in ("gyro_rad", "accelerometer_m_s2") for k in range(3)]
    micros = 5_000_000 + np.round(1e6 * walk.time).astype(int)
    titles = ",".join(["timestamp", *names, "accelerometer_timestamp_relative"])
    relative = np.zeros(len(walk), dtype=int)
    save(tmp_path / "log_0.csv", titles, micros, walk.gyro, walk.accel, relative)
    assert_same_samples(read_recording(tmp_path / "log_0.csv"), walk)


def test_a_letter_in_a_devices_name_is_no_sensor(walk, tmp_path):
    titles = header("Shimmer_A_Timestamp", "Shimmer_A_Accel_#_CAL", "Shimmer_A_Gyro_#_CAL")
    save(tmp_path / "own.csv", titles, ns(walk), walk.accel, walk.gyro)
    assert_same_samples(read_recording(tmp_path / "own.csv"), walk)
