from dataclasses import replace
from itertools import count

import numpy as np
import pandas as pd
import pytest
from support import CONFIG, lying

from stario.fusion import Health, Navigator, NavigatorConfig, Track
from stario.fusion.evaluation.checks import fusion
from stario.fusion.evaluation.checks.faults import run_faults
from stario.fusion.evaluation.checks.fusion import (
    end_shift_table,
    end_shifts,
    fixes_table,
    fusion_gain,
    fusion_gain_table,
    simulated_gain,
    track_with_fixes,
    true_fixes,
)
from stario.fusion.evaluation.checks.moments import moment_costs
from stario.fusion.evaluation.scores import joined, scored, values
from stario.network.model import load_model
from stario.sequences import InputError, PositionTrack, Trajectory, about_z


def of(scores: pd.DataFrame, metric: str, track: str = "filtered") -> float:
    [found] = values(scores, metric, track=track)
    return float(found)


def row(name: str, group: str, ratio: float, network: float, **fused: float) -> pd.DataFrame:
    figures = {"network": {"error_m": network}, "filtered": {"ratio": ratio, **fused}}
    return scored(name, figures, group)


def test_ratios_are_geometric_means_by_group():
    rows = [
        row("a", "x", 0.5, 1.0, nis=3.0, nees=1.0, yaw_error=0.01, yaw_good=1.0),
        row("b", "x", 2.0, 1.0, nis=3.0, nees=5.0, yaw_error=-0.9, yaw_good=0.0),
        row("c", "y", 0.5, 2.0, nis=1.0),
    ]
    _, alone, x, _, y, pooled, *_ = map(str.split, fusion_gain_table(joined(rows)).splitlines())
    assert alone[:4] == ["x", "network", "2", "1.00"]
    assert x[:2] == ["x", "filtered"]
    assert x[5:8] == ["1.00", "1.87", "2.00"]  # 95th percentile on a logarithmic scale, and worst
    assert x[8:12] == ["3.0", "3.0", "26.1", "50%"]
    assert y[5] == "0.50"
    assert pooled[:3] == ["all", "network", "3"]


def test_ratios_of_two_tracks_are_geometric_means_with_their_standard_error():
    ratios = (0.5, 0.8, 1.0, 1.25, 2.0)
    figures = ({"filtered": {"error_m": 3.0}, "track": {"error_m": 3.0 * r}} for r in ratios)
    scores = [scored(f"walk {k}", {"network": {}, **found}) for k, found in enumerate(figures)]
    expected = np.std(np.log(ratios), ddof=1) / np.sqrt(5)
    assert f"track / filtered: 1.00 +- {expected:.2f}" in fusion_gain_table(joined(scores))


def test_time_is_per_minute_of_data(monkeypatch):
    clock = count()
    monkeypatch.setattr(fusion, "process_time", lambda: float(next(clock)))
    found = simulated_gain(0, 10.0, graph=True)
    for name in ("filtered", "track"):
        assert values(found, "s_per_min", track=name) == pytest.approx([60.0 / 10.0])
    assert values(found, "slowest_ms") == [1e3]


def test_the_error_of_the_fusion_at_waypoints_agrees_with_its_error_at_poses(walk, make_oracle):
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    poses = fusion_gain(oracle, walk, CONFIG)
    every = slice(None, None, 500)
    at = walk.truth.time[every], walk.truth.position_W[every, :2]
    at_waypoints = replace(walk, truth=None, positions=PositionTrack(*at, "waypoints"))
    waypoints = fusion_gain(oracle, at_waypoints, CONFIG)
    assert of(poses, "error_m") < 0.5
    assert of(waypoints, "error_m") == pytest.approx(of(poses, "error_m"), abs=0.2)
    path = walk.truth.path_length()
    assert of(poses, "percent") == pytest.approx(100.0 * of(poses, "error_m") / path)
    legs = np.linalg.norm(np.diff(at[1], axis=0), axis=1).sum()
    assert of(waypoints, "percent") == pytest.approx(100.0 * of(waypoints, "error_m") / legs)


def test_the_yaw_error_is_that_since_the_start_next_to_the_sigma_of_yaw(walk, make_oracle):
    """A world whose axes point elsewhere changes neither."""
    walk = walk.slice(0.0, 10.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    turn, truth = about_z(2.0), walk.truth
    position_W, attitude_WB = turn.apply(truth.position_W), turn * truth.attitude_WB
    other = replace(truth, position_W=position_W, attitude_WB=attitude_WB)
    worlds = (replace(walk, truth=each) for each in (truth, other))
    found, rotated = (fusion_gain(oracle, world, CONFIG) for world in worlds)
    assert of(rotated, "yaw_error") == pytest.approx(of(found, "yaw_error"), abs=1e-9)
    assert abs(of(found, "yaw_error")) < 0.1
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk)
    assert of(found, "yaw_sigma") == pytest.approx(np.sqrt(track.covariance[-1, 2, 2]))
    half = truth.slice(truth.time[0], 0.5 * truth.time[-1])
    shorter = fusion_gain(oracle, replace(walk, truth=half), CONFIG)
    at_its_end = np.flatnonzero(track.time <= half.time[-1])[-1]
    assert of(shorter, "yaw_sigma") == pytest.approx(np.sqrt(track.covariance[at_its_end, 2, 2]))


@pytest.mark.parametrize(
    "score",
    [fusion_gain, track_with_fixes, moment_costs, lambda model, *rest: run_faults(*rest)],
)
def test_a_recording_without_truth_is_refused(walk, still_model, score):
    with pytest.raises(InputError, match="truth"):
        score(still_model, walk.without_truth(), CONFIG)


def test_what_cannot_be_scored_is_refused(walk, still_model):
    with pytest.raises(InputError, match="fixes"):
        track_with_fixes(still_model, walk, CONFIG, every=15.0)
    # A group's mean would be NaN with a single waypoint within the track.
    at_waypoints = PositionTrack(np.array([5.0, 500.0]), np.zeros((2, 2)), "waypoints")
    with pytest.raises(InputError, match="fewer than 2"):
        fusion_gain(still_model, replace(walk, truth=None, positions=at_waypoints), CONFIG)
    with pytest.raises(InputError, match="metre"):
        end_shifts(still_model, lying(20.0), CONFIG)


def test_errors_and_sigmas_are_those_of_the_second_half(walk, still_model, monkeypatch):
    """A track that is lost at first, then off by (0.3, 0.4, 0) m and 0.02 rad."""
    truth = walk.truth
    off = np.where(truth.time > truth.time[-1] / 2.0, 1.0, 100.0)
    position_W = truth.position_W + np.outer(off, [0.3, 0.4, 0.0])
    attitude_WB = about_z(0.02) * truth.attitude_WB
    trajectory = replace(truth, position_W=position_W, attitude_WB=attitude_WB)
    variances = [1.0, 1.0, 0.01**2, *[9.0] * 3, *[0.5**2] * 3, *[4.0] * 6]
    covariance = np.tile(np.diag(variances), (len(truth), 1, 1))
    track = Track(trajectory, covariance=covariance, health=Health(fixes={"applied": 3}))
    monkeypatch.setattr(Navigator, "run", lambda *arguments, **options: track)
    scores = track_with_fixes(still_model, walk, CONFIG, every=5.0)
    [found] = scores.itertuples()
    assert found.applied == pytest.approx(0.75)
    assert found.position_rms == pytest.approx(0.5)
    assert found.position_nees == pytest.approx(0.5**2 / 0.25)
    assert found.yaw_rms == pytest.approx(0.02)
    assert found.yaw_nees == pytest.approx((0.02 / 0.01) ** 2)
    assert found.yaw_covered == 1.0
    assert fixes_table(scores).splitlines()[1].split()[1:] == [
        "75%", "0.50", "1.0", "1.1", "4.0", "100.0%",
    ]  # fmt: skip


def test_errors_of_fixes_match_their_stated_sigma(walk):
    fixes = true_fixes(walk.truth, 0.05, 0.2, seed=1)
    at = walk.truth.at(np.array([fix.time for fix in fixes])).position_W
    error = np.array([fix.value for fix in fixes]) - at
    assert np.sqrt((error**2).mean()) == pytest.approx(0.2, rel=0.1)


def test_truth_before_the_first_sample_gives_no_fixes(walk, make_oracle, caplog):
    time = walk.truth.time.copy()
    time[0] = walk.time[0] - 1.0
    earlier = replace(walk, truth=replace(walk.truth, time=time))
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    scores = track_with_fixes(oracle, earlier, CONFIG, every=2.0, sigma=0.05)
    [found] = scores.itertuples()
    assert "before the start" not in caplog.text
    assert found.applied > 0.9
    assert found.position_rms < 0.3
    assert found.yaw_covered == 1.0
    row = fixes_table(scores.assign(group="walks")).splitlines()[1].split()
    assert (row[:2], row[-1]) == (["walks", "1"], "100.0%")


@pytest.mark.slow
def test_gaps_of_a_tenth_of_a_second_and_5_percent_loss_hardly_move_the_end(walk, monkeypatch):
    monkeypatch.setattr(fusion, "INSTANTS", 2)
    found = end_shifts(load_model("default"), walk, NavigatorConfig())
    assert set(found["recording"]) == {walk.name}
    *gaps, dropped = found.itertuples()
    assert [one.track for one in gaps] == ["gap at 5 s", "gap at 15 s"]  # of twenty
    # On the short path of a simulated walk of 20 s, a turn at a gap has a large effect.
    assert max(one.metres for one in gaps) < 0.1
    assert max(one.degrees for one in gaps) < 15.0
    assert 0.0 < dropped.metres < 0.01
    assert dropped.degrees < 0.5


def test_a_shift_is_a_share_of_the_path_and_a_turn_in_degrees(still_model, walk, monkeypatch):
    time, position = np.arange(3.0), np.outer(np.arange(3.0), [5.0, 0.0, 0.0])
    turned = about_z(np.radians([0.0, 10.0, -20.0]))
    straight = Track(Trajectory(time, position, about_z(np.zeros(3))))
    other = Track(Trajectory(time, position + np.array([0.3, 0.4, 9.0]), turned))
    runs = iter([straight, other, *[straight] * 6])
    monkeypatch.setattr(Navigator, "run", lambda *arguments: next(runs))
    scores = end_shifts(still_model, walk, NavigatorConfig())
    assert values(scores, "metres")[:2] == pytest.approx([0.05, 0.0])
    assert values(scores, "degrees")[:2] == pytest.approx([20.0, 0.0])
    row = end_shift_table(scores.assign(group="set")).splitlines()[1].split()
    assert row[:3] == ["set", "7", "86%"]
    assert row[5] == "5.00%"
    assert row[-1] == "20.00"
