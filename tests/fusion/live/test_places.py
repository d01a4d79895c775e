from __future__ import annotations

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

from .conftest import SteadyWalk, added, command, rerun, send

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
