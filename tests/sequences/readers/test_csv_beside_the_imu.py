from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alike import assert_same
from csv_lines import ROW, write_lines
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stario.sequences import Barometer, ReadError, Satellites, read_recording, write_csv
from stario.sequences.readers.generic_csv import read_generic_csv
from stario.sequences.sequence import FloatArray, ImuSequence, Magnetometer, PositionTrack


def test_a_position_without_its_accuracy_is_none(tmp_path):
    def read(*cells):
        rows = [f"{0.01 * k:.2f},{ROW},,," for k in range(100)]
        for k, cell in zip((20, 50, 80), cells, strict=True):
            rows[k] = f"{0.01 * k:.2f},{ROW},{k},0,{cell}"
        header = "t [s],gx,gy,gz,ax,ay,az,px,py,sp [m]"
        return read_generic_csv(write_lines(tmp_path / "a.csv", header, *rows)).positions

    np.testing.assert_allclose(read("3.0", "2.0", "4.0").time, [0.2, 0.5, 0.8])
    np.testing.assert_allclose(read("3.0", "", "4.0").time, [0.2, 0.8])
    with pytest.raises(ReadError, match=r"line 52, sp: found 0, .*deviation above 0"):
        read("3.0", "0.0", "4.0")


def test_an_accuracy_next_to_poses_is_ignored(tmp_path, walk):
    write_csv(tmp_path / "walk.csv", walk)
    header, *rows = (tmp_path / "walk.csv").read_text().splitlines()
    write_lines(tmp_path / "sp.csv", f"{header},sp", *(f"{row},3.0" for row in rows))
    found = read_recording(tmp_path / "sp.csv")
    assert len(found.truth) == len(walk)
    assert found.positions is None


def test_waypoints_listed_below_the_samples_may_be_in_any_order(tmp_path):
    samples = [f"{0.01 * k:.2f},{ROW},," for k in range(1000)]
    waypoints = [f"{time},,,,,,,{time + 1},0" for time in (8, 2, 5)]
    header = "t,gx,gy,gz,ax,ay,az,px,py"
    known = read_generic_csv(
        write_lines(tmp_path / "a.csv", header, *samples, *waypoints)
    ).positions
    assert known.time.tolist() == [2.0, 5.0, 8.0]
    assert known.position_W[:, 0].tolist() == [3.0, 6.0, 9.0]


SECONDS = 2.0
IMU = ImuSequence(
    "walk",
    np.arange(0.0, SECONDS, 0.02),
    np.full((100, 3), 0.25),
    np.tile([0.5, -0.25, 9.75], (100, 1)),
)

times = st.lists(
    st.one_of(
        st.sampled_from(IMU.time.tolist()),
        st.floats(-1.0, SECONDS + 1.0).filter(lambda t: abs(t) > 1e-9),
    ),
    min_size=1,
    max_size=12,
    unique=True,
).map(lambda found: np.array(sorted(found)))


@st.composite
def barometers(draw: st.DrawFn) -> Barometer:
    time = draw(times)
    hPa = draw(arrays(np.float64, len(time), elements=st.floats(300.0, 1100.0)))
    return Barometer(time, hPa)


@st.composite
def receivers(draw: st.DrawFn) -> Satellites:
    time = draw(times)

    def values(low: float, high: float, unknown: bool) -> FloatArray:
        found = st.floats(low, high)
        each = st.one_of(st.just(np.nan), found) if unknown else found
        return draw(arrays(np.float64, len(time), elements=each))

    def perhaps(low: float, high: float) -> FloatArray | None:
        column = values(low, high, unknown=True)
        return column if np.isfinite(column).any() and draw(st.booleans()) else None

    place = np.stack([values(0.001, 90.0, False), values(-180.0, 180.0, False)], axis=1)
    altitude, radius = perhaps(-400.0, 9000.0), perhaps(0.1, 1e4)
    return Satellites(time, place, altitude, radius, perhaps(0.0, 99.0), perhaps(0.0, 360.0))


@st.composite
def fields(draw: st.DrawFn) -> Magnetometer:
    time = draw(times)
    return Magnetometer(time, draw(arrays(np.float64, (len(time), 3), elements=st.floats(1, 99))))


@st.composite
def tracks(draw: st.DrawFn) -> PositionTrack:
    """Two or more positions: a track, or with two seconds or more between them waypoints."""
    time = draw(times.filter(lambda found: len(found) > 1))
    shape = len(time), draw(st.integers(2, 3))
    place = draw(arrays(np.float64, shape, elements=st.floats(-1e4, 1e4)))
    sigma = draw(st.none() | arrays(np.float64, len(time), elements=st.floats(0.01, 99.0)))
    sparse = np.median(np.diff(time)) >= 2.0
    return PositionTrack(time, place, "waypoints" if sparse else "positions", sigma=sigma)


@settings(max_examples=40, deadline=None)
@given(
    st.fixed_dictionaries({
        "barometer": st.none() | barometers(),
        "satellites": st.none() | receivers(),
        "magnetometer": st.none() | fields(),
        "positions": st.none() | tracks(),
    })
)  # fmt: skip
def test_what_is_written_is_read_back(tmp_path_factory, parts):
    path = tmp_path_factory.mktemp("csv") / "walk.csv"
    write_csv(path, replace(IMU, **parts))
    found = read_recording(path)
    np.testing.assert_array_equal(found.accel, IMU.accel)
    for name, part in parts.items():
        if part is None:
            assert getattr(found, name) is None
        else:
            assert_same(getattr(found, name), part)


def file_of(folder: Path, titles: str, cells: str) -> Path:
    rows = [f"{0.01 * k:.2f},{ROW},{cells}" for k in range(20)]
    return write_lines(folder / "walk.csv", f"t,gx,gy,gz,ax,ay,az{titles}", *rows)


def test_columns_may_name_other_units(tmp_path):
    titles = ",pressure [kPa],latitude [deg],longitude [deg],altitude [ft],speed [km/h]"
    found = read_recording(file_of(tmp_path, titles, "100.5,48.5,11.5,100,36"))
    np.testing.assert_allclose(found.barometer.pressure_hPa, 1005.0)
    np.testing.assert_array_equal(found.satellites.latlon_deg, [[48.5, 11.5]] * len(found))
    np.testing.assert_allclose(found.satellites.altitude_m, 30.48)
    np.testing.assert_allclose(found.satellites.speed_m_s, 10.0)


@pytest.mark.parametrize(
    ("titles", "cells", "words"),
    [
        (",p [rad/s]", "0.25", "p is not read: found unit 'rad/s', expected hPa, Pa"),
        (",p", "35.5", "pressure skipped: "),
        (",lat,lon", "48.5N,11.5E", "pressure and satellites skipped: "),
    ],
)
def test_columns_that_hold_something_else_cost_no_recording(tmp_path, titles, cells, words, caplog):
    found = read_recording(file_of(tmp_path, titles, cells))
    assert len(found) == 20
    assert found.barometer is None
    assert found.satellites is None
    assert words in caplog.text
