import re
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from scipy.spatial.transform import Rotation

from stario.fusion.report.background import add_place, check_tiles
from stario.fusion.report.figures import map_figure
from stario.fusion.report.panels import motion_panels
from stario.fusion.report.series import MAX_POINTS, ellipse, track_series
from stario.fusion.values.state import Track
from stario.sequences import Georeference, InputError, PositionTrack, Trajectory, about_z

pytest.importorskip("plotly", reason="pip install '.[report]'")


def along_x(time: np.ndarray, speed: float = 1.0) -> Trajectory:
    position = np.outer(speed * time, [1.0, 0.0, 0.0])
    covariance = np.tile(0.01 * np.eye(3), (len(time), 1, 1))
    return Trajectory(time, position, Rotation.identity(len(time)), None, covariance)


def stretches(values) -> int:
    """Number of stretches of numbers between the NaN."""
    finite = np.isfinite(np.asarray(values, dtype=float))
    return int(finite[0]) + int((~finite[:-1] & finite[1:]).sum())


def drawn_map(track: Trajectory, *more: Any) -> go.Figure:
    return map_figure({"track": track_series(track, 0.0)}, None, *(more or (None,)))


def trace_of(figure: go.Figure, **properties: Any) -> Any:
    return next(t for t in figure.data if all(t[key] == v for key, v in properties.items()))


@pytest.mark.parametrize("rate", [10.0, 200.0])  # the second has to be thinned
def test_map_and_panels_break_where_poses_are_missing(rate):
    time = np.arange(0.0, 60.0, 1.0 / rate)
    track = along_x(time[(time < 20.0) | (time > 27.0)])
    series = track_series(track, 0.0)
    assert len(series) <= MAX_POINTS + 1
    inside = series[(series.index > 20.0) & (series.index < 27.0)]
    assert inside.isna().all(axis=None)
    assert len(inside)
    lines = [t for t in drawn_map(track).data if t.mode == "lines" and t.customdata is not None]
    assert stretches(lines[0].x) == 2
    height = motion_panels({"track": series}, None)[0]
    assert [stretches(trace.y) for trace in height.traces] == [2, 2]  # band and line


def test_an_error_is_drawn_only_where_the_truth_is_known():
    time = np.arange(0.0, 60.0, 0.1)
    truth = along_x(time[(time < 20.0) | (time > 27.0)])
    series, true = (track_series(track, 0.0) for track in (along_x(time), truth))
    error = motion_panels({"track": series}, true)[0].traces[0]
    x, y = np.asarray(error.x), np.asarray(error.y, dtype=float)
    assert np.isnan(y[(x > 20.05) & (x < 26.95)]).all()
    assert np.isfinite(y[(x < 19.85) | (x > 27.15)]).all()


def test_a_device_at_rest_does_not_fill_the_map():
    track = along_x(np.arange(0.0, 60.0, 0.1), speed=5e-5)  # 3 mm
    low, high = drawn_map(replace(track, position_covariance_W=None)).layout.xaxis.range
    assert high - low >= 1.0


def test_known_positions_are_within_the_map():
    taps = PositionTrack(np.array([1.0, 9.0]), np.array([[0.0, -40.0], [9.0, 0.0]]), "waypoints")
    low, high = drawn_map(along_x(np.arange(0.0, 10.0, 0.1)), taps).layout.yaxis.range
    assert low < -40.0
    assert high > 0.0


def test_no_ellipse_is_cut_by_the_axes_and_the_speed_band_ends_at_rest():
    track = along_x(np.arange(0.0, 60.0, 0.1))
    wide = np.linspace(0.0, 25.0, len(track.time))[:, None, None] * np.eye(3)  # up to 5 m, 1 sigma
    series = track_series(replace(track, position_covariance_W=wide), 0.0)
    series["sigma speed"] = 0.8
    figure = map_figure({"track": series}, None, None)
    y = np.asarray(trace_of(figure, name="3 sigma").y, dtype=float)
    low, high = figure.layout.yaxis.range
    assert np.nanmax(y) > 10.0
    assert low < np.nanmin(y)
    assert np.nanmax(y) < high
    band, _ = motion_panels({"track": series}, None)[1].traces
    assert np.nanmin(np.asarray(band.y, dtype=float)) == 0.0


def test_arrows_point_where_the_device_goes_and_there_are_none_at_rest():
    time = np.arange(0.0, 200.0, 0.1)
    position = np.clip(time, 0.0, 100.0)[:, None] * [0.6, -0.8, 0.0]  # then at rest
    track = replace(along_x(time), position_W=position)
    arrows = next(trace for trace in drawn_map(track).data if trace.marker.symbol == "arrow")
    assert len(arrows.x) == 3
    # Clockwise from up, which is y.
    np.testing.assert_allclose(arrows.marker.angle, np.degrees(np.arctan2(0.6, -0.8)), atol=0.1)


def test_a_correction_is_drawn_where_the_device_was_with_its_size_and_cause():
    found = [(20.0, 2.5, np.radians(4.0), "network")]
    figure = drawn_map(along_x(np.arange(0.0, 60.0, 0.1)), None, found)
    mark = trace_of(figure, name="corrected")
    assert mark.x == pytest.approx((20.0,))
    assert re.search(r"2\.5 m, 4 deg.*network", mark.text[0])


def test_many_known_positions_are_drawn_smaller_than_few_and_below_the_track():
    few, many = (np.linspace(1.0, 59.0, count) for count in (10, 150))
    line, found = along_x(np.arange(0.0, 60.0, 0.1)), []
    for at in (few, many):
        known = PositionTrack(at, np.outer(at, [1.0, 0.0]), "positions")
        found.append(drawn_map(line, known).data[0])
    assert [trace.name for trace in found] == ["positions"] * 2
    assert found[1].marker.size < found[0].marker.size


@pytest.fixture
def view():
    pytest.importorskip("rerun", reason="pip install '.[view]'")
    from stario.fusion.report import view

    return view


def test_file_holds_every_quantity_over_time(tmp_path, view, walk, still_model):
    from stario.fusion import Navigator
    from stario.fusion.evaluation.compare import Comparison

    reader = pytest.importorskip("rerun.chunk", reason="requires rerun 0.41 or newer").RrdReader
    track = Navigator(still_model).run(walk)
    found = Comparison(walk, {"track": track}, {"track": {}})
    path = view.write_view(tmp_path / "track.rrd", found)
    entities = {str(chunk.entity_path) for chunk in reader(str(path)).stream()}
    for name in ("world/track", "world/truth", "world/device", "NIS", "bias", "force", "yaw"):
        assert any(name in entity for entity in entities), (name, entities)


def test_the_viewer_is_started_on_the_file(tmp_path, view, monkeypatch):
    started = []
    monkeypatch.setattr(view.subprocess, "Popen", lambda command, **_: started.append(command))
    view.open_view(tmp_path / "track.rrd")
    assert started[0][-3:] == ["-m", "rerun", str(tmp_path / "track.rrd")]


def test_a_path_is_broken_in_a_gap(view):
    class Stream:
        def log(self, entity, strips, static):
            self.strips = strips.strips.as_arrow_array().to_pylist()

    time = np.arange(0.0, 20.0, 0.1)
    time = time[(time < 5.0) | (time > 9.0)]
    path = Trajectory(time, np.outer(time, [1.0, 0.0, 0.0]), Rotation.identity(len(time)))
    stream = Stream()
    view._log_path(stream, "world/track", path, (0, 0, 0))
    assert [len(strip) for strip in stream.strips] == [(time < 5.0).sum(), (time > 9.0).sum()]


TIME = np.arange(0.0, 10.0, 0.1)
_POSE = (0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
SIGMA = np.array([*_POSE, 1e-3, 2e-3, 3e-3, 0.07, 0.08, 0.09])
"""Of rotation, velocity, position and both biases."""


def along_y(yaw: float = 0.0) -> Track:
    count = len(TIME)
    covariance = np.tile(np.diag(SIGMA**2), (count, 1, 1))
    covariance[:, 6, 7] = covariance[:, 7, 6] = 0.05
    p_W, v_W = np.outer(TIME, [0.0, 1.5, 0.0]), np.tile([0.0, 1.5, 0.0], (count, 1))
    attitude_WB = about_z(np.full(count, yaw))
    trajectory = Trajectory(TIME, p_W, attitude_WB, v_W, covariance[:, 6:9, 6:9])
    b_g, b_a = np.full((count, 3), 0.01), np.full((count, 3), 0.2)
    return Track(trajectory, b_g=b_g, b_a=b_a, covariance=covariance)


def series_of(track: Track) -> pd.DataFrame:
    return track_series(track.trajectory, 0.0, track)


def test_columns_are_in_their_units_with_their_own_sigmas() -> None:
    series = series_of(along_y(yaw=0.5))
    for column, expected in {
        "yaw": np.degrees(0.5),
        "sigma yaw": np.degrees(0.03),
        "speed": 1.5,
        "sigma speed": 0.2,  # that of the velocity along the path
        "sigma z": 0.6,
        "xy": 0.05,
        "gyro x": np.degrees(0.01),
        "sigma gyro y": np.degrees(2e-3),
        "accel z": 0.2,
        "sigma accel z": 0.09,
    }.items():
        np.testing.assert_allclose(series[column], expected)
    positions = replace(along_y().trajectory, velocity_W=None)
    np.testing.assert_allclose(track_series(positions, 0.0).speed, 1.5)


def test_an_ellipse_is_where_the_mahalanobis_distance_is_three() -> None:
    outline = ellipse(4.0, 1.5, 1.0)
    weight = np.linalg.inv([[4.0, 1.5], [1.5, 1.0]])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", outline, weight, outline), 9.0)
    np.testing.assert_allclose(outline[0], outline[-1], atol=1e-10)


def test_yaws_on_both_sides_of_half_a_turn_are_drawn_next_to_each_other() -> None:
    turned = {"track": along_y(np.radians(179.0)), "filtered": along_y(np.radians(-179.0))}
    shown = {name: track_series(each.trajectory, 0.0) for name, each in turned.items()}
    yaw = {trace.name: trace.y for trace in motion_panels(shown, None)[2].traces if trace.name}
    apart = np.subtract(yaw["filter, as in a stream"], yaw["StarIO"])
    np.testing.assert_allclose(apart, 2.0, atol=1e-3)


def test_the_band_of_a_line_is_three_sigma_wide() -> None:
    height = motion_panels({"track": series_of(along_y())}, None)[0]
    band, line = height.traces
    edge = np.asarray(band.y, dtype=float)
    assert np.nanmax(edge) == pytest.approx(3.0 * 0.6)
    assert np.nanmin(edge) == pytest.approx(-3.0 * 0.6)
    assert not any(line.y)


def turning(stop: float, offset: float) -> pd.DataFrame:
    """A device that turns by six degrees a second until `stop` [s], its yaw off by `offset` deg."""
    time = np.arange(0.0, stop, 0.1)
    return pd.DataFrame({"yaw": 6.0 * time + offset}, time).assign(x=0.0, y=0.0, z=0.0, speed=0.0)


@pytest.mark.parametrize("stop", [10.0, 120.0])
@pytest.mark.parametrize("turns", [0, 2])
def test_yaws_are_drawn_within_half_a_turn_of_the_truth(stop: float, turns: int) -> None:
    track = turning(stop, 5.0 + 360.0 * turns)
    panel = motion_panels({"track": track}, turning(120.0, 0.0))[-1]
    drawn = next(trace for trace in panel.traces if trace.legendgroup == "track")
    np.testing.assert_allclose(drawn.y, 6.0 * np.array(drawn.x) + 5.0, atol=1e-3)


URL = "https://tiles.example/{z}/{x}/{y}.png"


@pytest.mark.parametrize("size", [30.0, 400.0, 3000.0])
def test_tiles_lie_side_by_side_and_cover_the_drawn_part(size: float) -> None:
    """A tile's address tells its place: columns count eastwards from 180 degrees west."""
    figure = go.Figure()
    figure.update_xaxes(range=[-size, size])
    figure.update_yaxes(range=[-0.2 * size, 0.2 * size])
    add_place(figure, Georeference(51.4779, 0.001), URL)
    images = figure.layout.images
    assert 4 <= len(images) <= 100
    left, top = min(i.x for i in images), max(i.y for i in images)
    right, bottom = max(i.x + i.sizex for i in images), min(i.y - i.sizey for i in images)
    assert left < -size
    assert right > size
    assert bottom < -size
    assert top > size
    area = sum(i.sizex * i.sizey for i in images)
    assert area == pytest.approx((right - left) * (top - bottom), rel=0.03)
    zoom, x, _ = map(int, images[0].source.removesuffix(".png").split("/")[-3:])
    west = 360.0 * x / 2**zoom - 180.0
    assert images[0].x == pytest.approx((west - 0.001) * 69_500.0, rel=0.01, abs=2.0)


@pytest.mark.parametrize("url", ["tiles", "https://tiles.example/{z}/{x}.png", "file:///{z}{x}{y}"])
def test_what_is_no_map_server_is_refused(url: str) -> None:
    with pytest.raises(InputError, match="--tiles"):
        check_tiles(url)
