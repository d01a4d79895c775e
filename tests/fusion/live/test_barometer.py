from __future__ import annotations

import json

import numpy as np
import pytest

from stario.sequences import read_recording
from stario.sequences.units import METRES_PER_HPA

from .conftest import added, end_of_rerun, ends, send

LATLON = 48.137, 11.575


def climb(time: float) -> float:
    """Height [m] of stairs of ten seconds, one floor up."""
    return float(np.interp(time, [4.0, 14.0], [0.0, 3.0]))


def pressure(time: float) -> dict[str, float]:
    ripple = 0.005 * np.sin(99.0 * time)  # a sensor without noise has stopped
    return {"pressure": 950.0 + ripple - climb(time) / METRES_PER_HPA, "relativeAltitude": 99.0}


def place(time: float) -> dict[str, float | None]:
    latitude, longitude = LATLON
    rest = {"horizontalAccuracy": 5.0, "altitude": 520.0, "speed": None, "bearing": -1}
    return {"latitude": latitude + 1e-6 * time, "longitude": longitude} | rest


def test_pushed_pressures_change_height_and_floor(client, hub, pushes):
    """While one climbs no floor is claimed."""
    shown = []
    for body in added(pushes("stairs"), "barometer", pressure):
        send(client, [body])
        shown.append(hub.sessions["stairs"].status()["floor"])
    assert list(dict.fromkeys(shown)) == ["", "floor 0", "between floors", "floor +1"]
    send(client, pushes("level", seconds=8.0))
    stairs, level = hub.sessions["stairs"], hub.sessions["level"]
    assert ends(stairs)[2] - ends(level)[2] == pytest.approx(3.0, abs=0.5)
    assert level.status()["floor"] == ""
    words = [word["text"] for word in stairs.status()["health"]]
    assert any(text.startswith("Floor 0 to 1 by stairs") for text in words)


def test_pressures_and_places_are_kept_and_read_back(client, hub, pushes, new_navigator):
    bodies = added(added(pushes(seconds=8.0), "barometer", pressure), "location", place)
    send(client, bodies)
    session = hub.sessions["phone"]
    recording = read_recording(session.track.path)
    times = 0.2 * np.arange(len(recording.barometer.time))
    assert len(times) == 40
    np.testing.assert_allclose(recording.barometer.time, times, atol=1e-6)
    expected = [pressure(time)["pressure"] for time in times]
    np.testing.assert_array_equal(recording.barometer.pressure_hPa, expected)
    satellites = recording.satellites
    np.testing.assert_allclose(satellites.latlon_deg, [[48.137 + 1e-6 * t, 11.575] for t in times])
    np.testing.assert_array_equal(satellites.radius_m, 5.0)
    np.testing.assert_array_equal(satellites.altitude_m, 520.0)
    assert satellites.speed_m_s is None
    assert satellites.bearing_deg is None
    np.testing.assert_allclose(ends(session), end_of_rerun(session, new_navigator()), atol=1e-5)


def test_an_old_or_repeated_place_neither_refuses_nor_divides_a_recording(client, hub, pushes):
    """A phone's first place may be one of an hour ago, repeated until there is another."""
    old = []
    for body in added(pushes(seconds=4.0), "location", place):
        message = json.loads(body)
        message["payload"][-1]["time"] = 10**18 - 3600 * 10**9
        old.append(json.dumps(message).encode())
    assert all(answer.is_success for answer in send(client, old))
    session = hub.sessions["phone"]
    assert session.track.samples == 400
    assert session.status()["dropped"] == {}
    recording = read_recording(session.track.path)
    assert (len(recording), recording.duration) == (400, pytest.approx(3.99))
    assert len(recording.satellites.time) == 1


def test_pressure_in_another_unit_is_told_and_the_track_goes_on(client, hub, pushes):
    bodies = pushes(seconds=4.0)
    bodies = added(bodies, "barometer", lambda t: {"pressure": 100 * pressure(t)["pressure"]})
    send(client, bodies)
    session = hub.sessions["phone"]
    assert "convert from Pa to hPa" in session.status()["problem"]
    assert session.track.drawn.points[-1][0] > 3.5


@pytest.mark.parametrize("values", [{}, {"pressure": None}, {"pressure": "x"}, [1013.0]])
def test_a_barometer_without_pressure_refuses_no_push(client, hub, pushes, values):
    bodies = added(pushes(seconds=1.0), "barometer", lambda _: values)
    assert all(answer.is_success for answer in send(client, bodies))
    assert read_recording(hub.sessions["phone"].track.path).barometer is None
