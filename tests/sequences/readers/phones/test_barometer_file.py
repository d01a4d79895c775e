import re
from pathlib import Path

import numpy as np
import pytest
from phone_exports import START_NS, export, save
from recorded import DATA

from stario.sequences import Barometer, read_recording
from stario.sequences.sequence import FloatArray

RAW = DATA / "raw"
TIME = np.arange(0.5, 12.5)
HPA = 1013.25 - 0.01 * TIME
"""A slow climb of 1 m."""


def pressure_of(path: Path) -> Barometer:
    return read_recording(path).barometer


def assert_pressure(found: Barometer, time: FloatArray, pressure_hPa: FloatArray) -> None:
    np.testing.assert_allclose(found.time, time, atol=1e-6)
    np.testing.assert_allclose(found.pressure_hPa, pressure_hPa, rtol=1e-5)


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ('"Time (s)","X (hPa)"', 1.0),
        ('"Time (s)","Pressure (mBar)"', 1.0),
        ("time,value", 1.0),
        ("time,pressure_Pa", 100.0),
        ("time,Pressure (Pa)", 100.0),
        ("time,altimeterPressure(kPa)", 0.1),
        ("time,pressure (mmHg)", 1.0 / 1.33322),
        ("time,p", 100.0),
        ("time,p", 0.1),
        ("time,p", 1.0 / 33.8639),
        ("time,pressure (hPa)", 100.0),  # the title is wrong
    ],
)
def test_pressure_is_read_in_the_unit_of_its_title_or_else_of_its_size(
    walk, tmp_path, header, factor
):
    export("phyphox", tmp_path / "p", walk)
    save(tmp_path / "p/Barometer.csv", header, TIME, factor * HPA)
    assert_pressure(pressure_of(tmp_path / "p"), TIME, HPA)


def test_pressure_without_titles_is_read_but_a_walk_through_a_bar_is_none(walk, tmp_path):
    export("prefixed", tmp_path / "p", walk)
    stamps = [f"{1606391908305 + 1e3 * t:.18e}" for t in TIME]
    rows = [f"{t} {p:.18e}" for t, p in zip(stamps, HPA, strict=True)]
    (tmp_path / "p/Eight_bar.csv").write_text("\n".join(rows) + "\n")
    assert_pressure(pressure_of(tmp_path / "p"), TIME, HPA)
    for sensor, values in (("gyr", walk.gyro), ("acc", walk.accel)):
        save(tmp_path / f"bar_{sensor}.csv", "time (s),x,y,z", walk.time, values)
    assert read_recording(tmp_path / "bar_gyr.csv").barometer is None


def test_pressure_is_on_the_sensors_clock_and_read_once_where_every_row_repeats_it(walk, tmp_path):
    export("sensor_logger", tmp_path / "s", walk)
    time = np.append(-3.0, TIME)  # delivered before the first sample of the others
    stamps = [START_NS + round(t * 1e9) for t in time]
    header = "time,seconds_elapsed,relativeAltitude,pressure"
    columns = [stamps, time, np.zeros(13), np.append(1013.0, HPA)]
    save(tmp_path / "s/Barometer.csv", header, *columns)
    assert_pressure(pressure_of(tmp_path / "s"), TIME, HPA)
    names = [f"{sensor} {axis}" for sensor in ("ACCELEROMETER", "GYROSCOPE") for axis in "XYZ"]
    header = ",".join(["time (s)", *names, "ATMOSPHERIC PRESSURE (hPa)"])
    held = 1013.0 - 0.01 * np.floor(walk.time)
    save(tmp_path / "w.csv", header, walk.time, walk.accel, walk.gyro, held)
    seconds = np.arange(1.0 + np.floor(walk.time[-1]))
    found = pressure_of(tmp_path / "w.csv")
    np.testing.assert_allclose(found.time, seconds, atol=0.02)
    np.testing.assert_allclose(found.pressure_hPa, 1013.0 - 0.01 * seconds)


@pytest.mark.parametrize(
    ("title", "values", "words"),
    [
        ("altitude", 520.0 + TIME, "altitude: found 526 m, .* 300 to 1100 hPa.*altitude"),
        ("height (m)", 520.0 + TIME, "found 526 m.*altitude"),
        ("value", 3.0 + TIME, "value: found 9,.*altitude"),
        ("value", 520.0 + TIME, "1 hPa, which is 8 m of height.*altitude"),
        ("pressure (mbar)", 98.0 + TIME, "10 hPa, which is 84 m of height.*altitude"),
        ("pressure (hPa)", HPA, "from 7200 to 7212 s after the first sample"),
    ],
)
def test_what_is_no_pressure_is_named_in_one_line(walk, tmp_path, title, values, words, caplog):
    export("phyphox", tmp_path / "p", walk)
    time = TIME + (7200.0 if "hPa" in title else 0.0)
    save(tmp_path / "p/Barometer.csv", f"time (s),{title}", time, values)
    assert read_recording(tmp_path / "p").barometer is None
    [line] = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert re.search(words, line)


def test_lines_of_pressure_satellites_and_floors_are_read(walk, tmp_path):
    export("get_sensor_data", tmp_path / "g", walk)
    read = read_recording(tmp_path / "g/log.txt")
    assert_pressure(read.barometer, np.array([0.5, 1.5]), np.array([1013.055, 1013.065]))
    found = read.satellites
    np.testing.assert_allclose(found.time, [0.75, 1.75], atol=1e-3)
    np.testing.assert_array_equal(found.altitude_m, [5.5, 6.5])
    stated = (found.bearing_deg, found.radius_m, found.speed_m_s)
    np.testing.assert_array_equal(stated, [[90.0] * 2, [4.5] * 2, [1.25] * 2])
    np.testing.assert_array_equal(read.positions.floor, [0.0, -1.0])
    np.testing.assert_array_equal(read.positions.latlon_deg, [[40.0, -3.0], [40.0001, -3.0]])


@pytest.mark.skipif(not RAW.is_dir(), reason="the apps' own files are not here")
@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("phyphox", 1.0),
        ("canlang_logger", 10.0),
        ("pyojinkim_android", 25.0),
        ("ipin21_hcu", 100.0),
        ("advio/advio-15", 0.9),
    ],
)
def test_the_apps_own_pressure_stays_within_a_floor_of_a_level_walk(name, rate):
    found = pressure_of(RAW / name)
    assert found.rate == pytest.approx(rate, rel=0.1)
    assert np.ptp(8.43 * found.pressure_hPa) < 2.5
