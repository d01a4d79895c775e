"""Figures of the report, and the 3-D view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.fusion.report.figures import map_figure
from stario.fusion.report.panels import motion_panels
from stario.fusion.report.series import MAX_POINTS, track_series
from stario.sequences.sequence import PositionTrack, Trajectory

pytest.importorskip("plotly", reason="pip install '.[report]'")


def along_x(time: np.ndarray, speed: float = 1.0) -> Trajectory:
    position = np.outer(speed * time, [1.0, 0.0, 0.0])
    covariance = np.tile(0.01 * np.eye(3), (len(time), 1, 1))
    return Trajectory(time, position, Rotation.identity(len(time)), None, covariance)


def stretches(values) -> int:
    """Number of stretches of numbers between the NaN."""
    finite = np.isfinite(np.asarray(values, dtype=float))
    return int(finite[0]) + int((~finite[:-1] & finite[1:]).sum())


@pytest.mark.parametrize("rate", [10.0, 200.0])  # the second has to be thinned
def test_map_and_panels_break_where_poses_are_missing(rate):
    time = np.arange(0.0, 60.0, 1.0 / rate)
    track = along_x(time[(time < 20.0) | (time > 27.0)])
    series = track_series(track, 0.0)
    assert len(series) <= MAX_POINTS + 1
    inside = series[(series.index > 20.0) & (series.index < 27.0)]
    assert inside.isna().all(axis=None)
    assert len(inside)
    figure = map_figure({"track": series}, None, None)
    path = next(
        trace for trace in figure.data if trace.mode == "lines" and trace.customdata is not None
    )
    assert stretches(path.x) == 2
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
    series = track_series(replace(track, position_covariance_W=None), 0.0)
    low, high = map_figure({"track": series}, None, None).layout.xaxis.range
    assert high - low >= 1.0


def test_known_positions_are_within_the_map():
    series = track_series(along_x(np.arange(0.0, 10.0, 0.1)), 0.0)
    taps = PositionTrack(np.array([1.0, 9.0]), np.array([[0.0, -40.0], [9.0, 0.0]]), "waypoints")
    low, high = map_figure({"track": series}, None, taps).layout.yaxis.range
    assert low < -40.0
    assert high > 0.0


def test_no_ellipse_is_cut_by_the_axes_and_the_speed_band_ends_at_rest():
    track = along_x(np.arange(0.0, 60.0, 0.1))
    wide = np.linspace(0.0, 25.0, len(track.time))[:, None, None] * np.eye(3)  # up to 5 m, 1 sigma
    series = track_series(replace(track, position_covariance_W=wide), 0.0)
    series["sigma speed"] = 0.8
    figure = map_figure({"track": series}, None, None)
    outline = next(trace for trace in figure.data if trace.name == "3 sigma")
    y = np.asarray(outline.y, dtype=float)
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
    figure = map_figure({"track": track_series(track, 0.0)}, None, None)
    arrows = next(trace for trace in figure.data if trace.marker.symbol == "arrow")
    assert len(arrows.x) == 3
    # Clockwise from up, which is y.
    np.testing.assert_allclose(arrows.marker.angle, np.degrees(np.arctan2(0.6, -0.8)), atol=0.1)


def test_a_correction_is_drawn_where_the_device_was_with_its_size_and_cause():
    series = track_series(along_x(np.arange(0.0, 60.0, 0.1)), 0.0)
    found = [(20.0, 2.5, np.radians(4.0), "network")]
    figure = map_figure({"track": series}, None, None, found)
    mark = next(trace for trace in figure.data if trace.name == "corrected")
    assert mark.x == pytest.approx((20.0,))
    assert mark.text == ("20.0 s: corrected by 2.5 m, 4 deg<br>network",)


def test_many_known_positions_are_drawn_smaller_than_few_and_below_the_track():
    series = track_series(along_x(np.arange(0.0, 60.0, 0.1)), 0.0)

    def drawn(count: int):
        at = np.linspace(1.0, 59.0, count)
        known = PositionTrack(at, np.outer(at, [1.0, 0.0]), "positions")
        return map_figure({"track": series}, None, known).data[0]

    assert drawn(10).name == drawn(150).name == "positions"
    assert drawn(150).marker.size < drawn(10).marker.size


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
    path = view.write_view(
        tmp_path / "track.rrd", Comparison(walk, {"track": track}, {"track": {}})
    )
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
