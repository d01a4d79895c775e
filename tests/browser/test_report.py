import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stario.fusion.evaluation.compare import Comparison, compare, demonstration
from stario.fusion.report.page import write_report
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.state import Innovations, Track
from stario.network import load_model
from stario.sequences.attitude.rotations import about_z
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import ImuSequence, Trajectory

from .conftest import DESKTOP, PHONE, Tiles, open_page

SECONDS = 12.0


def start_of(sequence: ImuSequence, name: str) -> ImuSequence:
    keep = sequence.time < SECONDS
    truth = None if sequence.truth is None else sequence.truth.slice(-1.0, SECONDS)
    arrays = (sequence.time[keep], sequence.gyro[keep], sequence.accel[keep])
    return ImuSequence(name, *arrays, truth=truth)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    name = "walk </script><b>&"  # a name may contain anything and must be shown as text
    return compare(load_model(), start_of(demonstration(), name), NavigatorConfig())


@pytest.fixture(scope="module")
def report(comparison, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return write_report(folder / "report.html", comparison)


@pytest.fixture(scope="module")
def opened(browser, report):
    """The report in windows of each size, opened once; the last tests below change it."""
    return cache(lambda size: open_page(browser, report.as_uri(), size, offline=True))


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_report_loads_offline_without_errors_and_fits_the_screen(opened, size):
    shown = opened(size)
    assert shown.problems == []
    assert not shown.overflows()
    assert shown.page.inner_text("h1") == "walk </script><b>&"


def test_report_names_units_on_every_panel(opened, report):
    shown = opened(DESKTOP)
    titles = shown.page.evaluate(
        "document.getElementById('time').layout.annotations.map(a => a.text)"
    )
    assert all(re.search(r"\[(m|m/s|m/s\^2|deg|deg/s|1)\]", title) for title in titles)
    assert {title.split("[")[0] for title in titles} >= {
        "Height ",
        "Speed ",
        "Accelerometer bias z ",
    }
    text = report.read_text()
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=\"http", text.split("<script>")[0])


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_everything_is_on_the_screen_and_nothing_covers_it(opened, size):
    shown = opened(size)
    page = shown.page
    scrolling = "() => [...document.querySelectorAll('section')]"
    scrolling += (
        ".filter(s => s.scrollHeight > s.clientHeight + 1 || s.scrollWidth > s.clientWidth)"
    )
    assert page.evaluate(f"({scrolling})().length") == 0
    last = page.locator("th", has_text="NIS").bounding_box()
    assert last["x"] + last["width"] <= size[0]
    # Scrolled to its end, the page's last card is above the bar with the slider.
    page.evaluate("window.scrollTo(0, document.documentElement.scrollHeight)")
    card, bar = page.locator("section").last.bounding_box(), page.locator("#bar").bounding_box()
    assert card["y"] + card["height"] <= bar["y"]
    if size == DESKTOP:
        tools = page.locator("#map .modebar").bounding_box()
        axes = page.locator("#map .bglayer rect, #map .nsewdrag").first.bounding_box()
        assert tools["y"] + tools["height"] <= axes["y"]


def test_report_opens_at_the_start_with_the_whole_track_and_its_scale(opened):
    page = opened(DESKTOP).page
    assert page.evaluate("+document.body.dataset.time") == pytest.approx(0.0, abs=0.05)
    inside = "() => { const m = document.getElementById('map'), r = a => m.layout[a].range;"
    inside += " const within = (v, [low, high]) => v === null || (low < v && v < high);"
    inside += " return m.data.filter(t => t.legendgroup === 'track')"
    inside += ".every(t => ['x', 'y'].every(a => t[a].every(v => within(v, r(`${a}axis`))))); }"
    assert page.evaluate(inside)
    bar = page.locator("#scale").bounding_box()["width"]
    metres = float(page.inner_text("#scale").removesuffix(" m"))
    x = page.evaluate(
        "(({ _length, range }) => _length / (range[1] - range[0]))"
        "(document.getElementById('map')._fullLayout.xaxis)"
    )
    assert bar == pytest.approx(metres * x, abs=1.0)


def test_slider_moves_the_cursor_on_the_map_and_every_panel(opened, comparison):
    shown = opened(DESKTOP)
    slide = "value => { const s = document.getElementById('slider'); s.value = value;"
    slide += " s.dispatchEvent(new Event('input')); }"
    cursor = "() => ({at: +document.body.dataset.time,"
    cursor += (
        " x: document.getElementById('map').layout.shapes.find(s => s.name === 'filtered').xanchor,"
    )
    cursor += " ellipses: document.getElementById('map').layout.shapes"
    cursor += ".filter(s => s.type === 'path').length,"
    cursor += " lines: document.getElementById('time').layout.shapes.map(s => s.x0)})"
    seen = []
    times = [0.0, 0.25 * comparison.tracks["track"].time[-1], comparison.tracks["track"].time[-1]]
    for value, time in zip((0, 250, 1000), times, strict=True):
        shown.page.evaluate(slide, value)
        moved = "v => Math.abs(document.body.dataset.time - v) < 0.05"
        shown.page.wait_for_function(moved, arg=time, timeout=10_000)
        seen.append(shown.page.evaluate(cursor))
    for one in seen:
        assert one["lines"] == [pytest.approx(one["at"], abs=1e-3)] * len(one["lines"])
        assert len(one["lines"]) == 14
        assert one["ellipses"] == 2  # of the track, and of the filter's
    end = comparison.aligned()["filtered"].position_W[-1, 0]
    assert seen[-1]["x"] == pytest.approx(end, abs=0.05)
    assert shown.problems == []


def test_the_button_of_a_track_hides_it_on_map_and_panels(opened):
    shown = opened(DESKTOP)
    visible = "() => ['map', 'time'].map(id => document.getElementById(id).data"
    visible += ".filter(t => t.legendgroup === 'track' && t.visible !== false).length)"
    assert all(shown.page.evaluate(visible))
    shown.page.click("[data-track=track]")
    shown.page.wait_for_function(f"() => ({visible})().every(n => n === 0)", timeout=10_000)


def test_report_of_ten_minutes_is_below_two_megabytes(tmp_path, comparison):
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 600.0, 0.1)
    position = np.cumsum(rng.normal(0.0, 0.1, (len(time), 3)), axis=0)
    velocity = rng.normal(0.0, 1.0, (len(time), 3))
    scatter = rng.normal(0.0, 1.0, (len(time), 15, 15))
    P = scatter @ scatter.transpose(0, 2, 1)
    attitude = about_z(np.cumsum(rng.normal(0.0, 0.1, len(time))))
    path = Trajectory(time, position, attitude, velocity, P[:, 6:9, 6:9])
    noise = rng.normal(0.0, 1.0, (len(time), 3))
    updates = Innovations(time, noise, abs(noise), noise[:, 0] ** 2, noise[:, 0] > 2.0)
    track = Track(path, b_g=noise, b_a=noise, covariance=P, innovations=updates)
    walk = ImuSequence("ten minutes", time, noise, noise, truth=path)
    found = Comparison(walk, {"track": track}, {"track": comparison.metrics["track"]})
    assert write_report(tmp_path / "r.html", found).stat().st_size < 2_000_000


def test_a_map_server_is_asked_on_request_and_points_have_their_place(
    show, tile_server, comparison, tmp_path
):
    place = Georeference(48.1, 11.5, np.radians(90.0))
    track = replace(comparison.track, georeference=place)
    sequence = replace(comparison.sequence, truth=None)
    found = Comparison(sequence, {"track": track}, comparison.metrics)
    shown = show(write_report(tmp_path / "r.html", found, tile_server).as_uri())
    assert shown.problems == []
    shown.page.wait_for_function("() => document.querySelectorAll('#map image').length > 0")
    assert all(re.fullmatch(r"/\d+/\d+/\d+\.png", path) for path in Tiles.asked)
    line = shown.page.evaluate(
        "document.getElementById('map').data.find(t => t.legendgroup === 'track' && t.customdata)"
    )
    first = track.trajectory.position_W[-1]
    assert line["x"][-1] == pytest.approx(-first[1], abs=0.01)
    latlon = place.latlon_deg(track.trajectory.position_W[-1:])[0]
    assert line["customdata"][-1][-2:] == pytest.approx(latlon, abs=1e-6)
    texts = "document.getElementById('map').layout.annotations.map(a => a.text)"
    assert shown.page.evaluate(texts) == ["N", "map: 127.0.0.1"]
