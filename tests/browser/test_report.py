"""The report loads without a network, names units, and its slider moves every cursor."""

import re

import numpy as np
import pytest

from stario.fusion import Navigator
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.compare import Comparison, compare, demonstration
from stario.fusion.report.page import write_report
from stario.fusion.report.series import ellipse
from stario.network import load_model
from stario.sequences.sequence import ImuSequence

from .conftest import DESKTOP, PHONE

SECONDS = 20.0


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


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_report_loads_offline_without_errors_and_fits_the_screen(show, report, size):
    shown = show(report.as_uri(), size, offline=True)
    assert shown.problems == []
    assert not shown.overflows()
    assert shown.page.inner_text("h1") == "walk </script><b>&"


def test_slider_moves_the_cursor_on_the_map_and_every_panel(show, report, comparison):
    shown = show(report.as_uri())
    slide = "value => { const s = document.getElementById('slider'); s.value = value;"
    slide += " s.dispatchEvent(new Event('input')); }"
    cursor = "() => ({at: +document.body.dataset.time,"
    cursor += (
        " x: document.getElementById('map').layout.shapes.find(s => s.name === 'filtered').xanchor,"
    )
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
        assert len(one["lines"]) == 10
    end = comparison.aligned()["filtered"].position_W[-1, 0]
    assert seen[-1]["x"] == pytest.approx(end, abs=0.05)
    assert shown.problems == []


def test_the_button_of_a_track_hides_it_on_map_and_panels(show, report):
    shown = show(report.as_uri())
    visible = "() => ['map', 'time'].map(id => document.getElementById(id).data"
    visible += ".filter(t => t.legendgroup === 'track' && t.visible !== false).length)"
    assert all(shown.page.evaluate(visible))
    shown.page.click("[data-track=track]")
    shown.page.wait_for_function(f"() => ({visible})().every(n => n === 0)", timeout=10_000)


def test_report_names_units_on_every_panel(report):
    text = report.read_text()
    for title in ("Height [m]", "Speed [m/s]", "Yaw, unwrapped [deg]", "NIS [1]", "x [m]"):
        assert title in text
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=\"http", text.split("<script>")[0])


def test_report_of_a_run_without_truth_has_no_table(tmp_path):
    sequence = start_of(demonstration(), "bare").without_truth()
    track = Navigator(load_model()).run(sequence)
    path = write_report(tmp_path / "r.html", Comparison(sequence, {"track": track}, {"track": {}}))
    assert "Accuracy against ground truth" not in path.read_text()


def test_ellipse_is_where_the_mahalanobis_distance_is_three():
    covariance = np.array([[4.0, 1.5, 0.3], [1.5, 1.0, 0.1], [0.3, 0.1, 9.0]])
    outline = ellipse(covariance)
    weight = np.linalg.inv(covariance[:2, :2])
    distance = np.sqrt(np.einsum("ni,ij,nj->n", outline, weight, outline))
    np.testing.assert_allclose(distance, 3.0)
