from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from phone_exports import START_NS, export, save
from recorded import DATA

from stario.sequences import read_recording
from stario.sequences.sequence import FloatArray, PositionTrack

PHYPHOX = '"Time (s)","Latitude (°)","Longitude (°)","Height (m)","Velocity (m/s)","Direction (°)"'
SENSOR_LOGGER = (
    "time,seconds_elapsed,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,"
    "speed,bearing,altitude,longitude,latitude"
)
NORTH, EAST = 111_132.95, 78_846.8
"""Length of a degree of latitude and of longitude at 45 degrees [m] (WGS 84)."""

TIME = np.arange(1.0, 13.0)
METRES = np.stack([1.2 * TIME, -0.5 * TIME], axis=1)


def degrees(metres: FloatArray) -> FloatArray:
    """Latitude and longitude of points east and north of 45 degrees north, 7 east."""
    return np.array([45.0, 7.0]) + metres[:, ::-1] / [NORTH, EAST]


def positions_of(path: Path) -> PositionTrack:
    found = read_recording(path).positions
    assert found.kind == "positions"
    return found


def test_positions_of_phyphox_are_read_with_their_accuracy(walk, tmp_path):
    export("phyphox", tmp_path / "p", walk)
    radius = np.where(TIME == 5.0, 200.0, 4.53)  # one from the cells of the network
    header = f'{PHYPHOX},"Horizontal Accuracy (m)","Vertical Accuracy (°)"'
    save(tmp_path / "p/Location.csv", header, TIME, degrees(METRES), *[TIME] * 3, radius, TIME)
    found = positions_of(tmp_path / "p")
    np.testing.assert_allclose(found.time, TIME, atol=1e-9)
    np.testing.assert_allclose(found.position_W, METRES - METRES[0], atol=0.02)
    np.testing.assert_allclose(found.sigma[found.valid], 3.0)
    assert "11 positions (sigma 3 m" in read_recording(tmp_path / "p").truth_summary()
    for title in ("accuracy", "hAcc (m)", "h_acc", "HACC"):
        save(tmp_path / "p/Location.csv", f"time,lat,lon,{title}", TIME, degrees(METRES), radius)
        known = positions_of(tmp_path / "p")
        np.testing.assert_allclose(known.sigma[known.valid], 3.0)
    np.testing.assert_array_equal(found.valid, TIME != 5.0)


def test_sensor_loggers_own_clock_is_used_and_satellites_are_preferred(walk, tmp_path):
    export("sensor_logger", tmp_path / "s", walk)
    time = np.append(-20.0, TIME)  # the last position known before the recording
    stamps = [START_NS + round(t * 1e9) for t in time]
    place = degrees(np.vstack([[-900.0, 0.0], METRES]))
    others, radius = np.ones((13, 3)), np.full(13, 4.53)
    for name, off in (("LocationGps", 0.0), ("Location", 0.01)):
        columns = [stamps, time, others, radius, others, place[:, ::-1] + off]
        save(tmp_path / f"s/{name}.csv", SENSOR_LOGGER, *columns)
    found = positions_of(tmp_path / "s")
    np.testing.assert_allclose(found.time, TIME, atol=1e-6)
    np.testing.assert_allclose(found.position_W, METRES - METRES[0], atol=0.02)


def test_positions_repeated_in_every_row_are_read_once(walk, tmp_path):
    export("androsensor", tmp_path / "a", walk)
    [file] = (tmp_path / "a").glob("*.csv")
    header, *rows = file.read_text(encoding="utf-8").splitlines()
    sep = ";" if ";" in header else ","
    place = degrees(1.2 * np.floor(walk.time)[:, None] * [1.0, 0.0])
    added = [sep.join(["0.0"] * 3 if t < 1.0 else [*map(repr, p), "6.04"])
             for t, p in zip(walk.time, place.tolist(), strict=True)]  # fmt: skip
    names = ["LOCATION Latitude : ", "LOCATION Longitude : ", "LOCATION Accuracy ( m)"]
    lines = [sep.join([names[0], names[1], names[2], header])]
    lines += [f"{a}{sep}{row}" for a, row in zip(added, rows, strict=True)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = positions_of(file)
    np.testing.assert_allclose(found.time, np.arange(1.0, 16.0), atol=0.02)
    np.testing.assert_allclose(found.sigma, 4.0)


def test_each_recording_of_a_folder_has_its_own_positions(walk, tmp_path):
    for name, speed in (("one", 1.0), ("two", -1.0)):
        for sensor, values in (("gyr", walk.gyro), ("acc", walk.accel)):
            save(tmp_path / f"{name}_{sensor}.csv", "time (s),x,y,z", walk.time, values)
        place = degrees(speed * METRES)
        save(tmp_path / f"{name}_gps.csv", "time (s),lat,lon", TIME, place)
    for name, speed in (("one", 1.0), ("two", -1.0)):
        found = positions_of(tmp_path / f"{name}_gyr.csv")
        np.testing.assert_allclose(found.position_W, speed * (METRES - METRES[0]), atol=0.02)


def test_dates_of_positions_and_samples_may_be_in_different_zones(walk, tmp_path):
    def dates(time: FloatArray, hours: int) -> list[list[str]]:
        start = datetime(2024, 5, 1, 23, 59, 55, tzinfo=UTC)
        start = start.astimezone(timezone(timedelta(hours=hours)))
        return [[(start + timedelta(seconds=t)).isoformat()] for t in time.tolist()]

    for name, values in (("Accelerometer", walk.accel), ("Gyroscope", walk.gyro)):
        save(tmp_path / f"w/{name}.csv", "time,x,y,z", dates(walk.time, hours=2), values)
    columns = dates(TIME, hours=-3), degrees(METRES), np.full(len(TIME), 4.53)
    save(tmp_path / "w/gps.csv", "time,lat,lon,accuracy", *columns)
    found = positions_of(tmp_path / "w")
    np.testing.assert_allclose(found.time, TIME, atol=1e-6)
    np.testing.assert_allclose(found.position_W, METRES - METRES[0], atol=0.02)


PLACE = degrees(METRES)
NMEA = np.stack([4807.038 + 0.001 * TIME, 1131.0 - 0.001 * TIME], axis=1)
"""48 degrees 7.038 minutes; the hemisphere is in a column of its own."""


@pytest.mark.parametrize(
    ("titles", "columns", "words"),
    [
        ("lat,lon,alt", [np.stack([TIME, TIME, TIME], axis=1)], ""),  # a latitude is no clock
        ("time (s),acc_lat,acc_long,gps speed", [TIME, METRES, TIME], ""),  # lateral forces
        (
            "time,lat,lon,accuracy",
            [TIME, PLACE, np.where(TIME == 5.0, 8.0, 120.0)],
            "found 1 of 12 positions known to 30 m, expected at least two",
        ),
        ("time,lat,lon", [TIME, 1e7 * PLACE], "found 449999955 and 70000152.19, expected degrees"),
        ("time,lat,lon", [TIME, 123.0 * PLACE], "found 5534.99"),
        ("time,lat (rad),lon (rad)", [TIME, np.radians(PLACE)], "found lat (rad), expected degr"),
        (
            "time,lat,lon",
            [TIME, NMEA],
            "found 4807.039 and 1130.999, expected degrees .* NMEA's degrees and minutes? "
            "That latitude is 48.117317",
        ),
        (
            "time (s),lat,lon",
            [TIME + 9e3, PLACE],
            "found times from 9001 to 9012 s after the first s",
        ),
        ("time (s),lat,lon", [TIME[:1] + 9e3, PLACE[:1]], ""),
        ("time,lat,lon", [TIME[:1], PLACE[:1]], ""),
        ("time,lat,lon", [["1", "2", "3"], [["45", "7"], ["45", "x"], ["45", "7"]]], "'x', expect"),
    ],
)
def test_what_is_no_use_as_a_position_costs_no_recording(
    walk, tmp_path, titles, columns, words, caplog
):
    export("phyphox", tmp_path / "p", walk)
    save(tmp_path / "p/gps.csv", titles, *columns)
    read = read_recording(tmp_path / "p")
    assert read.positions is None
    assert len(read) > 1000
    assert len(caplog.records) == bool(words)
    assert all(part in caplog.text for part in words.split(" .* "))


def test_latitude_and_longitude_that_can_only_be_exchanged_are(walk, tmp_path, caplog):
    export("phyphox", tmp_path / "p", walk)
    place = degrees(METRES) + np.array([0.0, 120.0])
    save(tmp_path / "p/gps.csv", "time,lat,lon", TIME, place[:, ::-1])
    found = read_recording(tmp_path / "p").satellites
    np.testing.assert_array_equal(found.latlon_deg, place)
    assert "latitude and longitude are exchanged: read the other way round" in caplog.text


def test_what_a_receiver_reports_is_kept_as_measured(walk, tmp_path):
    """Repeated positions too; what it does not know is NaN, in m, m/s and degrees."""
    export("phyphox", tmp_path / "p", walk)
    place = degrees(METRES)
    place[6:] = place[6]  # indoors
    radius = np.where(TIME == 2.0, 0.0, 9.0)
    bearing = np.where(TIME == 3.0, -1.0, 90.0)
    header = (
        "time (s),lat,lon,Height (ft),Velocity (km/h),Direction (°),Accuracy (m),Vertical Accuracy"
    )
    columns = [place, np.full(12, 100.0), np.full(12, 3.6), bearing, radius, np.full(12, 77.0)]
    save(tmp_path / "p/Location.csv", header, TIME, *columns)
    read = read_recording(tmp_path / "p")
    found = read.satellites
    np.testing.assert_allclose(found.time, TIME, atol=1e-9)
    np.testing.assert_allclose(found.latlon_deg, place, atol=1e-12)
    expected = {
        "altitude_m": np.full(12, 30.48),
        "speed_m_s": np.ones(12),
        "bearing_deg": np.where(TIME == 3.0, np.nan, 90.0),
        "radius_m": np.where(TIME == 2.0, np.nan, 9.0),
    }
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(found, name), values, err_msg=name)
    np.testing.assert_allclose(read.positions.time, TIME[:7], atol=1e-9)
    np.testing.assert_allclose(read.positions.latlon_deg, place[:7], atol=1e-12)


@pytest.mark.skipif(not DATA.is_dir(), reason="ADVIO is not here")
def test_a_file_of_advio_without_titles_is_read():
    found = read_recording(DATA / "raw/advio/advio-15").satellites
    np.testing.assert_allclose(found.latlon_deg, [[60.187, 24.8215]] * len(found), atol=1e-3)
    assert found.radius_m.min() >= 5.0
    assert found.radius_m.max() <= 200.0
    assert np.ptp(found.altitude_m) < 5.0
