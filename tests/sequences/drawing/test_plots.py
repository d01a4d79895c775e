import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.drawing.figures import TRACK_STYLES
from stario.sequences.drawing.plan import plan_view
from stario.sequences.drawing.plots import error_over_time, imu_overview, innovations
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import ImuSequence, PositionTrack, Trajectory


@pytest.fixture
def truth():
    t = np.arange(0.0, 60.0, 0.05)
    position = np.stack([10 * np.sin(0.1 * t), 6 * np.cos(0.13 * t), 0 * t], axis=1)
    return Trajectory(t, position, Rotation.identity(len(t)))


def with_growing_error(track: Trajectory, growth: float, power: int = 1) -> Trajectory:
    error = growth * track.time**power
    return replace(track, position_W=track.position_W + np.outer(error, [1.0, 0.5, 0.1]))


@pytest.fixture
def tracks(truth):
    sigma = 0.02 * truth.time + 0.01
    covariance = np.einsum("n,ij->nij", sigma**2, np.eye(3))
    return {
        "track": replace(with_growing_error(truth, 0.01), position_covariance_W=covariance),
        "network": with_growing_error(truth, 0.03),
        "dead_reckoning": with_growing_error(truth, 0.5, power=2),
    }


def labels(parent) -> list[str]:
    return [text.get_text() for text in parent.get_texts()]


def line(axes, label: str):
    return next(item for item in axes.get_lines() if item.get_label().startswith(label))


def test_plan_view_fits_the_truth_and_labels_tracks_that_leave_it(truth, tracks):
    fig = plan_view(tracks, truth, "a walk")
    axes = fig.axes[0]
    for drawn in (axes, plan_view(tracks, None, "").axes[0]):
        assert np.ptp(drawn.get_xlim()) < 40.0  # dead reckoning runs to 1.8 km
    assert axes.get_aspect() == 1.0
    legend = labels(fig.legends[0])
    assert legend[:3] == ["truth", "StarIO", "network alone"]
    assert legend[3:] == [
        "dead reckoning (IMU alone) (leaves the figure by 1.8 km)", "start", "end",
    ]  # fmt: skip
    for track in (truth, tracks["network"], tracks["track"]):
        assert (track.position_W[:, 0] < axes.get_xlim()[1]).all()
        assert (track.position_W[:, 1] > axes.get_ylim()[0]).all()


def test_plan_view_cuts_any_track_but_the_first(truth, tracks):
    astray = with_growing_error(truth, 3.0)
    for given, cut in (((astray, truth), False), ((truth, astray), True)):
        fig = plan_view(dict(zip(("track", "network"), given, strict=True)), truth, "")
        inside = astray.position_W[-1, 0] < fig.axes[0].get_xlim()[1]
        assert inside != cut
        assert any("leaves the figure" in label for label in labels(fig.legends[0])) == cut


def test_tracks_differ_without_their_colours(truth):
    """In grey, and to many eyes, only the dashes of lines are left; colours are the names'."""
    named = {name: with_growing_error(truth, 0.01) for name in TRACK_STYLES}
    for axes in (plan_view(named, truth, "").axes[0], error_over_time(named, truth).axes[0]):
        tracks = [line(axes, label) for label, *_ in TRACK_STYLES.values()]
        # The first track of a plan is drawn in pieces, by its time.
        assert len({str(track._dash_pattern) for track in tracks[1:]}) == len(tracks) - 1
        assert all(track.is_dashed() for track in tracks[1:])
    all_axes = plan_view(named, truth, "").axes[0]
    few = {name: named[name] for name in ("track", "network")}
    few_axes = plan_view(few, truth, "").axes[0]
    for label in ("StarIO", "network alone"):
        assert line(all_axes, label).get_color() == line(few_axes, label).get_color()
    shown = ("truth", "StarIO", "network alone", "dead reckoning")
    assert len({line(all_axes, label).get_color() for label in shown}) == len(shown)


def test_a_way_back_differs_from_the_way_out_in_brightness_and_width():
    """Out and back on one line: the second half lies on the first and leaves its edges visible."""
    t = np.arange(0.0, 120.0, 0.1)
    x = np.where(t < 60.0, t, 120.0 - t)
    there_and_back = Trajectory(t, np.outer(x, [1.0, 0.5, 0.0]), Rotation.identity(len(t)))
    axes = plan_view({"track": there_and_back}, None, "").axes[0]
    (path,) = axes.collections
    bright = path.get_colors()[:, :3] @ [0.2126, 0.7152, 0.0722]  # which every eye sees
    width = np.asarray(path.get_linewidths())
    half = len(bright) // 2
    assert np.abs(np.diff(bright)).max() < 0.05
    assert bright[half:].min() > bright[:half].max() - 0.05
    assert (bright[::-1] - bright)[: half // 2].min() > 0.2
    assert (np.diff(width) < 0.0).all()
    assert width[-1] < 0.5 * width[0]


def test_arrows_point_along_the_walk_and_its_ends_have_times():
    t = np.arange(0.0, 125.0, 0.1)
    x = np.interp(t, [0.0, 40.0, 70.0, 125.0], [0.0, 40.0, 40.0, 95.0])  # a stop of 30 s
    along = Trajectory(t, np.outer(x, [0.6, -0.8, 0.0]), Rotation.identity(len(t)))
    axes = plan_view({"track": along}, None, "").axes[0]
    arrows = [text for text in axes.texts if getattr(text, "arrow_patch", None)]
    assert len(arrows) == 4  # one in each half minute but in the stop
    for arrow in arrows:
        step = np.subtract(arrow.xy, arrow.xyann)
        np.testing.assert_allclose(step / np.linalg.norm(step), [0.6, -0.8], atol=1e-6)
    assert {"0:00", "2:05"} <= {text.get_text() for text in axes.texts}


def test_positions_are_drawn_below_the_tracks_and_waypoints_above(tracks):
    ekf = tracks["track"]
    for kind, above in (("positions", False), ("waypoints", True)):
        known = PositionTrack(ekf.time, ekf.position_W[:, :2], kind=kind)
        axes = plan_view({"track": ekf}, None, "", known).axes[0]
        assert (line(axes, kind).get_zorder() > axes.collections[0].get_zorder()) == above


@pytest.mark.parametrize("size", [0.3, 7.0, 260.0, 4000.0])
def test_the_scale_bar_is_as_long_as_it_says(truth, size):
    walk = replace(truth, position_W=truth.position_W * size / 20.0)
    axes = plan_view({"track": walk}, None, "").axes[0]
    (bar,) = (item for item in axes.lines if item.get_linewidth() == 3.0)
    (text,) = (text.get_text() for text in axes.texts if text.get_text().endswith("m"))
    number, unit = text.split()
    length = float(number) * {"cm": 0.01, "m": 1.0, "km": 1000.0}[unit]
    assert np.ptp(bar.get_xdata()) == pytest.approx(length)
    assert 0.1 < length / np.ptp(axes.get_xlim()) < 0.35


def test_the_error_and_its_sigma_are_drawn_beside_a_plan_with_truth(truth, tracks):
    assert len(plan_view(tracks, None, "").axes) == 2  # the map and its bar of times
    beside = plan_view(tracks, truth, "").axes[1]
    error, sigma = beside.lines[1], line(beside, "its sigma")
    np.testing.assert_allclose(error.get_ydata(), 0.01 * truth.time * np.hypot(1, 0.5), atol=1e-9)
    np.testing.assert_allclose(
        sigma.get_ydata(), np.sqrt(2.0) * (0.02 * truth.time + 0.01), atol=1e-9
    )
    assert beside.get_ylim()[1] < 3.0  # dead reckoning leaves it


@pytest.mark.parametrize("kind", ["marked", "missing"])
def test_gaps_in_the_truth_break_the_line(truth, kind):
    keep = (truth.time < 20.0) | (truth.time > 34.0)
    cut = replace(truth, valid=keep) if kind == "marked" else truth.select(keep)
    axes = plan_view({}, cut, "").axes[0]
    x = np.asarray(line(axes, "truth").get_xdata())
    assert np.isnan(x).sum() == 1
    assert np.isnan(x[np.searchsorted(truth.time, 20.0)])
    errors = error_over_time({"network": with_growing_error(truth, 0.03)}, cut).axes[0]
    assert np.isnan(np.asarray(line(errors, "network").get_ydata())).sum() == 1


def test_error_panels_show_the_error_and_three_sigma(truth, tracks):
    fig = error_over_time(tracks, truth)
    top, in_x, *_ = fig.axes
    np.testing.assert_allclose(
        line(top, "network").get_ydata(), 0.03 * truth.time * np.hypot(1, 0.5), atol=1e-9
    )
    assert top.get_ylim()[1] < 5.0
    assert "dead reckoning (IMU alone) (leaves the figure, up to 2.0 km)" in labels(
        top.get_legend()
    )
    # The panels per axis show only the track with a covariance, within a three-sigma band.
    assert labels(in_x.get_legend()) == ["StarIO", "StarIO, 3 sigma"]
    (band,) = in_x.collections
    edge = np.abs(band.get_paths()[0].vertices[:, 1]).max()
    assert edge == pytest.approx(3 * (0.02 * truth.time[-1] + 0.01))
    in_x = error_over_time({"network": tracks["network"]}, truth).axes[1]  # without covariance
    np.testing.assert_allclose(line(in_x, "network").get_ydata(), 0.03 * truth.time, atol=1e-9)
    assert len(in_x.collections) == 0


def test_gated_innovations_are_marked_and_kept_within_the_axes():
    rng = np.random.default_rng(2)
    time, residual = np.arange(0.0, 30.0, 0.2), rng.normal(0, 0.1, (150, 3))
    residual[40] = 50.0
    nis, gated = (residual**2).sum(axis=1) / 0.01, np.arange(150) == 40
    fig = innovations(time, residual, np.full((150, 3), 0.1), nis, gated, "")
    for axes in fig.axes[:3]:
        low, high = axes.get_ylim()
        assert high < 1.0
        crosses = line(axes, "gated")
        assert list(crosses.get_xdata()) == [8.0]
        assert low <= crosses.get_ydata()[0] <= high
    assert "0.7 % gated" in fig.axes[3].get_title(loc="left")
    assert line(fig.axes[3], "expected 3").get_ydata()[0] == 3


@pytest.mark.parametrize("count", [1, 150])
def test_the_first_update_does_not_set_the_axes_of_innovations(count):
    rng = np.random.default_rng(3)
    time, residual = 0.5 * np.arange(count), rng.normal(0, 0.1, (count, 3))
    sigma, nothing = np.full((count, 3), 0.1), np.zeros(count, dtype=bool)
    residual[0], sigma[0] = 1.2, 1.0
    fig = innovations(time, residual, sigma, np.ones(count), nothing, "")
    for axes in fig.axes[:3]:
        top = axes.get_ylim()[1]
        assert 0.3 < top < (0.4 if count > 1 else 4.0)
        assert line(axes, "used").get_ydata()[0] == pytest.approx(min(top, 1.2))
    innovations(time, residual, sigma, np.ones(count), ~nothing, "")  # all gated


def test_imu_overview_tolerates_the_bad_samples_that_readers_keep(truth):
    rng = np.random.default_rng(4)
    n = 20_000
    time = np.arange(n) / 200.0
    gyro, accel = rng.normal(0, 0.1, (n, 3)), rng.normal([0, 0, 9.8], 0.5, (n, 3))
    gyro[100] = np.nan
    time[5000], time[7000] = time[4000], time[6999]  # out of order, repeated
    gyro[12345, 1] = 30.0
    fig = imu_overview(ImuSequence("walk", time, gyro, accel, truth))
    assert len(fig.axes) == 3
    tallest = max(
        path.vertices[:, 1].max() for band in fig.axes[0].collections for path in band.get_paths()
    )
    assert tallest == 30.0  # a single spike survives the decimation
    assert len(imu_overview(ImuSequence("walk", time[:50], gyro[:50], accel[:50])).axes) == 2


def test_matplotlib_is_imported_lazily_and_pyplot_never():
    code = """
import sys
import numpy as np
from stario.sequences import ImuSequence
from stario.sequences.drawing.figures import TRACK_STYLES
from stario.sequences.drawing.plan import plan_view
from stario.sequences.drawing.plots import imu_overview
assert "matplotlib" not in sys.modules
ones = np.ones((9, 3))
imu_overview(ImuSequence("x", np.arange(9.0), ones, ones)).canvas.draw()
assert "matplotlib.figure" in sys.modules
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_track_is_marked_where_it_resumes_after_a_gap(truth, tracks):
    """At its first valid pose, if that lies within the frame."""
    whole, half = tracks["track"], 600
    broken = whole.select(np.r_[0:half, half + 50 : len(whole)])  # 2.5 s
    # The network's second pose comes one window after the first, the others two per second.
    delayed = whole.select(np.r_[0, 20 : len(whole) : 10])
    cases = (("track", whole, 0), ("track", broken, 1), ("pdr", broken, 0), ("network", delayed, 0))
    for name, track, marks in cases:
        axes = plan_view({name: track}, None, "").axes[0]
        found = [line for line in axes.lines if line.get_label() == "after a gap"]
        assert len(found) == marks
    unknown = replace(broken, valid=np.arange(len(broken)) != half)  # right after the gap
    mark = line(plan_view({"track": unknown}, truth, "").axes[0], "after a gap")
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == tuple(broken.position_W[half + 1, :2])
    far = {"track": truth, "dead_reckoning": with_growing_error(broken, 0.5, power=2)}
    assert "after a gap" not in labels(plan_view(far, truth, "").legends[0])


def test_the_axes_of_a_tall_plan_fill_its_figure_and_a_long_legend_fits(truth, tracks):
    tall = replace(truth, position_W=np.outer(truth.time, [0.1, 1.2, 0.0]))
    names = ("track", "filtered", "network", "network_true_attitude", "pdr", "dead_reckoning")
    for shown in (names[:1], names):  # with a legend of one row or of several
        fig = plan_view(dict.fromkeys(shown, tall), None, "")
        fig.canvas.draw()
        assert fig.axes[1].get_tightbbox().x1 > 0.95 * fig.bbox.x1  # the bar of times
    straight = replace(truth, position_W=np.outer(truth.time, [0.0, 1.2, 0.0]))
    names = ("dead_reckoning", "pdr", "network", "network_true_attitude", "track")
    distant = {name: with_growing_error(straight, 0.5, power=2) for name in names}
    fig = plan_view(distant, straight, "")
    fig.canvas.draw()
    legend = fig.legends[0].get_window_extent()
    assert fig.bbox.x0 <= legend.x0
    assert legend.x1 <= fig.bbox.x1


def test_lost_samples_are_marked_at_the_edge_and_only_gaps_are_shaded(truth):
    still = ImuSequence("walk", truth.time, *(np.ones((len(truth), 3)) for _ in range(2)))
    lost = [(k, k + 0.01) for k in np.arange(10.0, 20.0, 0.1)]
    for axes in imu_overview(still, gaps=[(30.0, 34.0), *lost]).axes[:2]:
        (shaded,) = (patch for patch in axes.patches if patch.get_label() == "gap")
        assert (shaded.get_x(), shaded.get_width()) == (30.0, 4.0)
        assert shaded.get_zorder() < line(axes, "x").get_zorder()
        marks = line(axes, "lost")
        assert len(marks.get_xdata()) == len(lost)
        assert set(marks.get_ydata()) == {1.0}


def test_columns_are_as_wide_as_their_widest_cell_and_unknown_values_are_dashes():
    lines = aligned([["", "ATE [m]", "n"], ["a walk", "1.5", "12"], ["b", "-", "3"]])
    assert lines == ["         ATE [m]    n", "a walk       1.5   12", "b              -    3"]
    assert [figure(value) for value in (None, float("nan"), 0.0)] == ["-", "-", "0.000"]
    assert figure(1.25, ".1f") == "1.2"
