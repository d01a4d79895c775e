import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from stario.fusion import Navigator, NavigatorConfig, PlaceConfig
from stario.fusion.live.hub import Hub, Viewer
from stario.fusion.live.server import live_app
from stario.sequences import Georeference, read_recording
from stario.sequences.sequence import FloatArray
from stario.sequences.units import METRES_PER_HPA

from .conftest import SteadyWalk, added, command, end_of_rerun, ends, rerun, send

PLACE = Georeference(48.1, 11.5)
TILES = "http://tiles.example:81/{z}/{x}/{y}.png"


@pytest.fixture
def make_client(tmp_path):
    hubs = []

    def make(tiles: str = "", **place: Any) -> Any:
        config = NavigatorConfig(place=PlaceConfig(**place))
        hub = Hub(tmp_path / f"live-{len(hubs)}", lambda: Navigator(SteadyWalk(), config))
        hubs.append(hub)
        client = TestClient(live_app(hub, tiles=tiles), base_url="http://localhost")
        return client, hub, lambda: Navigator(SteadyWalk(), config)

    yield make
    for hub in hubs:
        hub.close()


def with_places(bodies, xy: Callable[[float], Any], **values: float) -> Iterator[bytes]:
    """Pushes with a place in every fifth, once a second, at metres from `PLACE`."""

    def place(time: float) -> dict[str, float]:
        latitude, longitude = PLACE.latlon_deg(np.array([xy(time)]))[0].tolist()
        return {"latitude": latitude, "longitude": longitude, "horizontalAccuracy": 4.0} | values

    return added(bodies, "location", place, every=5)


def east(time: float) -> FloatArray:
    return np.array([0.8 * time, 0.0])


EASTWARDS = {"speed": 0.8, "bearing": 90.0}


def test_used_places_put_the_track_where_a_run_of_its_recording_does(make_client, pushes) -> None:
    """A viewer gets the places only when they have changed."""
    client, hub, new_navigator = make_client(satellites="use")
    bodies = list(with_places(pushes(seconds=13.0), east, **EASTWARDS))
    viewer = Viewer(hub)
    send(client, bodies[:40])
    [first], [same] = (viewer.message()["devices"] for _ in range(2))
    send(client, bodies[40:])
    [last] = viewer.message()["devices"]
    assert "places" not in same
    assert len(last["places"]) > len(first["places"]) > 0
    session = hub.sessions["phone"]
    status, track = session.status(), session.track
    assert status["georeferenced"]
    assert status["satellites"] == "13 satellite positions used, origin 48.100000,11.500000"
    again = rerun(new_navigator(), track.path)
    there = again.trajectory.position_W
    np.testing.assert_allclose(track.drawn.points[-1][1:3], there[-1, :2], atol=0.05)
    # The whole track was moved and turned, not only what followed.
    drawn = np.array(track.drawn.points)
    x, y = (np.interp(again.time, drawn[:, 0], drawn[:, k]) for k in (1, 2))
    known = again.time >= drawn[0, 0]
    off = np.hypot(x - there[:, 0], y - there[:, 1])[known]
    assert np.median(off) < 1.0
    for time, x, y, _ in track.places.drawn:
        np.testing.assert_allclose([x, y], east(time), atol=0.02)


def test_compared_places_lie_on_the_track_and_change_nothing(make_client, pushes) -> None:
    client, hub, _ = make_client()
    send(client, pushes(seconds=13.0))
    plain = np.array(hub.sessions["phone"].track.drawn.points)
    turned = Georeference(48.1, 11.5, yaw=1.0)

    def along(time: float) -> FloatArray:
        xy = np.array([[np.interp(time, plain[:, 0], plain[:, k]) for k in (10, 11)]])
        return PLACE.xy(turned.latlon_deg(xy))[0] + [70.0, 20.0]

    client, hub, _ = make_client()
    send(client, with_places(pushes(seconds=13.0), along))
    session = hub.sessions["phone"]
    np.testing.assert_array_equal(session.track.drawn.points, plain)
    assert not session.status()["georeferenced"]
    assert hub.earth.georeference is None
    time, x, y, radius = np.array(session.track.places.drawn).T
    assert len(time) >= 11
    for axis, k in ((x, 10), (y, 11)):
        np.testing.assert_allclose(axis, np.interp(time, plain[:, 0], plain[:, k]), atol=0.05)
    assert set(radius) == {4.0}


def test_ignored_places_are_kept_but_neither_drawn_nor_counted(make_client, pushes) -> None:
    client, hub, _ = make_client(satellites="ignore")
    send(client, with_places(pushes(seconds=5.0), east))
    session = hub.sessions["phone"]
    assert session.track.places.drawn == []
    assert session.status()["satellites"] == ""
    assert len(read_recording(session.track.path).satellites) == 5


def test_a_place_that_is_held_is_neither_used_nor_drawn(make_client, pushes) -> None:
    client, hub, _ = make_client(satellites="use")
    send(client, with_places(pushes(seconds=14.0), lambda time: [min(time, 5.0), 0.0]))
    session = hub.sessions["phone"]
    assert [place[0] for place in session.track.places.drawn] == [1.0, 2.0, 3.0, 4.0]
    (words,) = (word["text"] for word in session.status()["health"] if "fix" in word["text"])
    assert sum(map(int, re.findall(r"\d+", words))) <= 9  # three of the held, until it shows


def test_a_track_placed_by_hand_before_any_satellite_keeps_its_map(make_client, pushes) -> None:
    tracks = []
    for use in ("use", "ignore"):
        client, hub, _ = make_client(satellites=use)
        bodies = pushes(seconds=13.0)
        send(client, bodies[:25])
        assert command(client, "fix", x=3.0, y=2.0, sigma=1.0).status_code == 200
        send(client, with_places(bodies[25:], east, **EASTWARDS))
        session = hub.sessions["phone"]
        assert not session.status()["georeferenced"]
        tracks.append(session.track.drawn.points)
    np.testing.assert_array_equal(*tracks)


def test_a_track_on_the_earth_keeps_its_zero_there(make_client, pushes) -> None:
    client, hub, _ = make_client(origin=(48.1, 11.5))
    bodies = pushes(seconds=6.0)
    send(client, bodies)
    answer = command(client, "zero")
    assert answer.status_code == 400
    assert "earth" in answer.json()["error"]
    assert hub.sessions["phone"].track.drawn.origin.tolist() == [0.0, 0.0, 0.0]


def test_the_map_has_tiles_where_the_track_lies(make_client, pushes) -> None:
    client, *_ = make_client(TILES, satellites="use")
    sides = {"left": -100, "right": 100, "bottom": -50, "top": 50}
    assert client.get("/background", params=sides).json() == []
    send(client, with_places(pushes(seconds=4.0), east))
    images = client.get("/background", params=sides).json()
    columns = [each for each in images if each["x"] <= 0.0 < each["x"] + each["sizex"]]
    [over] = [each for each in columns if each["y"] - each["sizey"] < 0.0 <= each["y"]]
    zoom, x, y = map(int, over["source"].removesuffix(".png").split("/")[-3:])
    assert over["source"].startswith("http://tiles.example:81/")
    assert x == int(2**zoom * (11.5 / 360.0 + 0.5))
    assert y == int(2**zoom * 0.5 * (1.0 - np.arcsinh(np.tan(np.radians(48.1))) / np.pi))


@pytest.mark.parametrize(
    "sides",
    [
        {},
        {"left": "x", "right": 1, "bottom": 0, "top": 1},
        {"left": "nan", "right": 1, "bottom": 0, "top": 1},
        {"left": 2, "right": 1, "bottom": 0, "top": 1},
        {"left": 0, "right": 1e9, "bottom": 0, "top": 1},
    ],
)
def test_limits_that_are_none_are_refused(make_client, sides: dict[str, Any]) -> None:
    client, *_ = make_client(TILES)
    assert client.get("/background", params=sides).status_code == 400


@pytest.mark.parametrize(("tiles", "allowed"), [("", False), (TILES, True)])
def test_the_page_may_load_images_of_the_tile_server_only(make_client, tiles, allowed) -> None:
    client, *_ = make_client(tiles)
    policy = client.get("/").headers["content-security-policy"]
    assert ("http://tiles.example:81" in policy) == allowed
    assert "default-src 'self'" in policy


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
