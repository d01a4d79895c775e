import importlib.util
import threading
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.fusion import Navigator, NavigatorConfig, PlaceConfig, demonstration
from stario.fusion.live.run import LiveServer
from stario.network import load_model
from stario.sequences import Barometer, read_recording
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import Satellites
from stario.sequences.units import METRES_PER_HPA

from .conftest import DESKTOP, PHONE, Tiles

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "replay_live.py"
LAST = "id => { const p = window.stario.devices.get(id)?.points; return p && p[p.length - 1]; }"


@pytest.fixture(scope="module")
def replay():
    spec = importlib.util.spec_from_file_location("examples_replay_live", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.replay


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    model = load_model()
    folder = tmp_path_factory.mktemp("live")
    with running(LiveServer(lambda: Navigator(model), folder, port=0)) as server:
        yield server


@contextmanager
def running(server):
    listening = threading.Event()
    thread = threading.Thread(target=server.run, args=(listening.set,))
    thread.start()
    try:
        assert listening.wait(60.0)
        yield server
    finally:
        server.stop()
        thread.join()


def test_page_draws_two_phones_and_ends_where_a_run_on_their_files_does(show, server, replay):
    url = f"http://127.0.0.1:{server.port}"
    shown = show(url)
    assert shown.page.is_visible("#local")
    assert not shown.page.is_visible("#time")
    phones = [
        threading.Thread(target=replay, args=(demonstration(), f"{url}/data", 10.0, 6.0, name))
        for name in ("anna <a href=x>b</a>", "ben")
    ]
    for phone in phones:
        phone.start()
    for phone in phones:
        phone.join()
    for name in ("anna <a href=x>b</a>", "ben"):
        session = server.hub.sessions[name]
        end = session.track.drawn.points[-1]
        shown.page.wait_for_function(f"([id, t]) => ({LAST})(id)?.[0] >= t", arg=[name, end[0]])
        track = Navigator(load_model(), backend="ekf").run(read_recording(session.track.path))
        drawn = shown.page.evaluate(LAST, name)
        np.testing.assert_allclose(drawn[1:4], track.trajectory.position_W[-1], atol=1e-4)
        assert shown.page.is_visible(f"[data-device='{name}'] .figures")
    assert shown.page.is_visible("#time")
    assert not shown.page.is_visible("#local")
    assert shown.page.locator("#map a[href=x]").count() == 0
    assert not shown.overflows()
    assert shown.problems == []


def test_height_and_floor_of_a_phone_with_a_barometer_are_shown(show, server, replay):
    walk = demonstration()
    height = np.interp(walk.time - walk.time[0], [5.0, 15.0], [0.0, 3.0])
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(height))
    air = Barometer(walk.time[::10], (1000.0 + noise - height / METRES_PER_HPA)[::10])
    url = f"http://127.0.0.1:{server.port}"
    replay(replace(walk, barometer=air), f"{url}/data", 10.0, 22.0, "emil")
    shown = show(url)
    box = shown.page.locator("[data-device=emil] .figures div", has_text="height")
    box.get_by_text("height, floor +1").wait_for()
    metres = float(box.locator("b").inner_text().removesuffix(" m"))
    assert metres == pytest.approx(3.0, abs=0.5)
    assert shown.problems == []


def test_a_walk_with_satellites_lies_on_the_map(show, tile_server, replay, tmp_path):
    walk = demonstration()
    there = walk.truth.at(np.arange(walk.time[0] + 0.5, walk.time[0] + 12.0))
    v = there.velocity_W
    receiver = Satellites(
        there.time,
        Georeference(48.1, 11.5).latlon_deg(there.position_W),
        radius_m=np.full(len(there.time), 4.0),
        speed_m_s=np.hypot(v[:, 0], v[:, 1]),
        bearing_deg=np.degrees(np.arctan2(v[:, 0], v[:, 1])),
    )
    model, config = load_model(), NavigatorConfig(place=PlaceConfig(satellites="use"))
    server = LiveServer(lambda: Navigator(model, config), tmp_path, port=0, tiles=tile_server)
    with running(server):
        url = f"http://127.0.0.1:{server.port}"
        replay(replace(walk, satellites=receiver), f"{url}/data", 10.0, 12.0, "fred")
        shown = show(url)
        shown.page.locator("#map image").first.wait_for(state="attached")
        shown.page.get_by_text("east [m]").wait_for()
        shown.page.get_by_text("map: 127.0.0.1").wait_for()
        loaded = "() => performance.getEntriesByType('resource').some(e => e.name.endsWith('.png'))"
        shown.page.wait_for_function(loaded)
        drawn = "window.stario.devices.get('fred').places.length"
        assert shown.page.evaluate(drawn) == len(server.hub.sessions["fred"].track.places.drawn) > 8
        assert not shown.page.get_by_text("Zero here").is_visible()
        assert Tiles.asked
        assert not shown.overflows()
        shown.fits(PHONE)
        assert shown.problems == []


def test_buttons_for_zero_place_and_stop_reach_the_server(show, server, replay):
    url, name = f"http://127.0.0.1:{server.port}", "carl"
    replay(demonstration(), f"{url}/data", 10.0, 4.0, name)
    session = server.hub.sessions[name]
    shown = show(url, PHONE)
    card = shown.page.locator(f"[data-device={name}]")
    card.get_by_text("Zero here").click()
    shown.page.wait_for_function(f"() => window.stario.devices.get('{name}').origin[0] !== 0")
    np.testing.assert_allclose(
        session.track.drawn.origin, session.track.drawn.points[-1][1:4], atol=1e-3
    )
    card.get_by_text("Place on map").click()
    assert shown.page.is_visible("#tap")
    before = session.track.drawn.points[-1][1:3]
    box = shown.page.locator("#map .nsewdrag").first.bounding_box()
    shown.page.mouse.click(box["x"] + 0.75 * box["width"], box["y"] + 0.25 * box["height"])
    shown.page.wait_for_function(f"() => window.stario.devices.get('{name}').fixes === 1")
    x, y = np.array(session.track.drawn.points[-1][1:3]) - before
    assert np.hypot(x, y) > 0.5  # where to depends on whether the map has followed the zero yet
    assert card.locator(".file").inner_text().endswith(", 1 fix")
    card.get_by_text("Stop").click()
    shown.page.wait_for_function(f"() => !window.stario.devices.get('{name}').running")
    assert not session.running
    assert not shown.overflows()
    shown.fits(DESKTOP)
    assert shown.problems == []


def test_a_command_without_an_answer_is_shown_and_any_name_can_be_commanded(show, server, replay):
    url = f"http://127.0.0.1:{server.port}"
    replay(demonstration(), f"{url}/data", 10.0, 4.0, "dora/2")
    shown = show(url)
    card = shown.page.locator("[data-device='dora/2']")
    for answer, words in (
        (lambda route: route.fulfill(status=404, body="Not Found"), "status 404"),
        (lambda route: route.abort(), "no connection"),
    ):
        shown.page.route("**/command", answer)
        card.get_by_text("Stop").click()
        card.locator(".error", has_text=words).wait_for()
        shown.page.unroute("**/command")
    card.get_by_text("Stop").click()
    shown.page.wait_for_function("() => !window.stario.devices.get('dora/2').running")
    assert not server.hub.sessions["dora/2"].running
    card.locator(".error").wait_for(state="hidden")
    expected = ("Failed to load resource", "failed: ")  # both are the browser's own
    assert all(problem.startswith(expected) for problem in shown.problems)
    server.hub.sessions["dora/2"].close()
    del server.hub.sessions["dora/2"]  # as when it makes room for another
    card.wait_for(state="detached")


def test_page_of_a_server_that_requires_a_token_loads_with_it(show, tmp_path):
    server = LiveServer(lambda: None, tmp_path, host="0.0.0.0", port=0)
    with running(server):
        shown = show(f"http://127.0.0.1:{server.port}/?token={server.token}")
        address = shown.page.inner_text("#push-url")
        assert "127.0.0.1" not in address
        assert address.endswith(f":{server.port}/data?token={server.token}")
        shown.page.wait_for_function("document.getElementById('code').naturalWidth > 50")
        assert not shown.overflows()
        shown.fits(PHONE)
        assert shown.problems == []
