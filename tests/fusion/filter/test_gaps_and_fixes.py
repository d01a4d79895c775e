from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from simulated import measured
from support import GRAPH as CONFIG
from support import stream, swivelled, true_start

from stario.fusion import Navigator, NavState, PriorPose, Track, position_fix, yaw_fix
from stario.fusion.evaluation.checks.fusion import true_fixes
from stario.fusion.filter.frame_transform import FrameTransform
from stario.sequences import ImuSequence, about_z, yaw_of


def yaw_error(track: Track, walk: ImuSequence, rows: Any) -> np.ndarray:
    """Yaw error in the frame of the ground truth, wrapped [rad]."""
    truth = walk.truth.at(track.time[rows])
    found = yaw_of(track.trajectory.attitude_WB[rows])
    return np.angle(np.exp(1j * (found - yaw_of(truth.attitude_WB))))


def position_nees(track: Track, walk: ImuSequence, row: int) -> float:
    truth = walk.truth.at(track.time[row : row + 1])
    error = track.trajectory.position_W[row] - truth.position_W[0]
    return float(error @ np.linalg.solve(track.covariance[row, 6:9, 6:9], error))


@pytest.mark.parametrize(
    ("backend", "seed", "gap"),
    [
        ("ekf", 1, 15.0),
        ("graph", 4, 3.0),
        pytest.param("graph", 1, 15.0, marks=pytest.mark.slow),
        pytest.param("ekf", 4, 3.0, marks=pytest.mark.slow),
    ],
)
def test_a_position_before_a_gap_does_not_turn_the_track_after_it(backend, seed, gap):
    """Its direction was never determined, so that position gives none to the track after it."""
    walk, holed, oracle = measured(seed, 60.0, CONFIG, gap=(20.0, 20.0 + gap))
    fixes = [f for f in true_fixes(walk.truth, 3.0, 0.3, 0) if not 1.0 < f.time < 20.0 + gap]
    track = Navigator(oracle, CONFIG, backend=backend).run(holed, fixes=fixes)
    late = track.time > 50.0
    late &= track.time < walk.time[-1]
    assert np.abs(yaw_error(track, walk, late)).max() < 0.2
    early = int(np.searchsorted(track.time, 15.0))
    turn = float(yaw_error(track, walk, slice(early, early + 1))[0])
    assert abs(turn) < 3.0 * np.sqrt(track.covariance[early, 2, 2])
    # A graph's marginals are of first order: a turn's covariance lies across the arm only.
    assert backend == "graph" or position_nees(track, walk, early) < 20.0


@pytest.mark.parametrize(
    ("seed", "gap", "turn"), [(2, 6.0, 2.5), pytest.param(18, 10.0, 1.8, marks=pytest.mark.slow)]
)
def test_fixes_find_the_direction_after_a_gap(make_walk, make_oracle, without, seed, gap, turn):
    walk = turned(make_walk(seed, 50.0, 50.0), 20.0 + 0.5 * gap, turn)
    holed = without(walk, (walk.time > 20.0) & (walk.time < 20.0 + gap))
    oracle = make_oracle(holed, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    fixes = true_fixes(walk.truth, 3.0, 0.3, 0)
    graph = Navigator(oracle, CONFIG).run(holed, fixes=fixes)
    for track in (graph, graph.filtered):
        late = (track.time > 20.5 + gap) & (track.time < walk.time[-1])
        sigma = np.sqrt(track.covariance[late, 2, 2])
        assert (np.abs(yaw_error(track, walk, late)) < 4.0 * sigma).all()
        assert sigma[-1] < 0.1
        within = sum(20.0 < f.time <= 20.0 + gap for f in fixes)
        assert track.health.fixes["in a long gap"] == within


@pytest.mark.parametrize(
    ("seed", "gap", "yaw_first"), [(2, 7.3, False), (2, 7.3, True), (7, 0.9, True)]
)
def test_states_before_the_first_position_are_uncertain(seed, gap, yaw_first):
    walk, holed, oracle = measured(seed, 45.0, CONFIG, gap=(20.0, 20.0 + gap))
    fixes = [f for f in true_fixes(walk.truth, 2.0, 0.2, 0) if f.time > 32.0]
    if yaw_first:
        fixes.insert(0, yaw_fix(31.0, yaw_of(walk.truth.at(np.array([31.0])).attitude_WB)[0], 0.1))
    track = Navigator(oracle, CONFIG, backend="ekf").run(holed, fixes=fixes)
    early = np.flatnonzero((track.time > 1.0) & (track.time < 19.0))[::20]
    assert max(position_nees(track, walk, row) for row in early) < 16.0
    off = track.trajectory.position_W - walk.truth.at(track.time).position_W
    assert (np.abs(off[early, 2]) < 3.0 * np.sqrt(track.covariance[early, 8, 8])).all()


def test_a_first_yaw_that_was_off_is_off_about_the_position_that_places_the_track():
    walk, _, oracle = measured(0, 45.0, CONFIG)
    yaw = yaw_of(walk.truth.at(np.array([5.0])).attitude_WB)[0] + 0.3
    fixes = [f for f in true_fixes(walk.truth, 2.0, 0.2, 0) if f.time > 30.0]
    fixes.insert(0, yaw_fix(5.0, yaw, 0.4))
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk, fixes=fixes)
    early = np.flatnonzero((track.time > 1.0) & (track.time < 29.0))[::20]
    assert max(position_nees(track, walk, row) for row in early) < 12.0


def test_short_gaps_after_a_long_one_do_not_lose_the_position(make_walk, make_oracle, without):
    """A yaw that was lost once is not lost again because of a turn of a tenth of a radian."""
    walk = make_walk(1, 60.0, 50.0)
    gone = (walk.time > 12.0) & (walk.time < 16.0)
    gone |= (walk.time > 18.0) & (walk.time % 4.0 < 0.3)
    holed = without(walk, gone)
    oracle = make_oracle(holed, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    fixes = true_fixes(walk.truth, 5.0, 0.5, 0)
    track = Navigator(oracle, CONFIG, backend="ekf").run(holed, fixes=fixes)
    late = (track.time > 40.0) & (track.time < walk.time[-1])
    off = track.trajectory.position_W[late] - walk.truth.at(track.time[late]).position_W
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) < 1.0
    assert np.abs(yaw_error(track, walk, late)).max() < 0.5  # each short gap adds 0.15 rad


def test_a_track_not_yet_placed_stays_in_one_piece_across_a_gap():
    walk, holed, oracle = measured(4, 60.0, CONFIG, gap=(20.0, 23.0))
    shift = np.array([100.0, 50.0, 0.0])
    fixes = [yaw_fix(5.0, yaw_of(walk.truth.at(np.array([5.0])).attitude_WB)[0], 0.02)]
    for fix in true_fixes(walk.truth, 3.0, 0.3, 0):
        if fix.time > 35.0:
            fixes.append(position_fix(fix.time, fix.value + shift, fix.covariance))
    track = Navigator(oracle, CONFIG, backend="ekf").run(holed, fixes=fixes)
    early = int(np.searchsorted(track.time, 2.0))
    truth = walk.truth.at(track.time[early : early + 1]).position_W[0] + shift
    error = track.trajectory.position_W[early] - truth
    P = track.covariance[early, 6:8, 6:8]
    assert error[:2] @ np.linalg.solve(P, error[:2]) < 12.0


def test_fixes_after_a_gap_do_not_determine_the_yaw_before_it():
    walk, holed, oracle = measured(1, 60.0, CONFIG, gap=(20.0, 35.0))
    fixes = [f for f in true_fixes(walk.truth, 3.0, 0.3, 0) if f.time > 35.0]
    track = Navigator(oracle, CONFIG, backend="ekf").run(holed, fixes=fixes)
    before = int(np.searchsorted(track.time, 15.0))
    assert track.covariance[before, 2, 2] > 1.0
    assert position_nees(track, walk, before) < 20.0
    assert position_nees(track, walk, len(track.time) - 2) < 12.0


@pytest.mark.parametrize(
    "gap",
    [pytest.param(1.5, marks=pytest.mark.slow), 3.0, pytest.param(7.0, marks=pytest.mark.slow)],
)
def test_the_graph_is_no_more_certain_of_the_turn_in_a_gap_than_the_filter(gap):
    _, holed, oracle = measured(1, 10.0 + gap, CONFIG, gap=(6.0, 6.0 + gap))
    after = 6.0 + gap + 0.2

    def sigma(track):
        return float(np.sqrt(track.covariance[np.searchsorted(track.time, after), 2, 2]))

    expected = sigma(Navigator(oracle, CONFIG, backend="ekf").run(holed))
    assert expected > 0.45 * min(gap, 3.0)
    assert sigma(Navigator(oracle, CONFIG, backend="graph").run(holed)) > 0.85 * expected
    states = stream(Navigator(oracle, CONFIG, backend="graph"), holed.slice(0.0, after + 1.5))
    streamed = next(s for s in states if s.time > after)
    assert np.sqrt(streamed.covariance[2, 2]) > 0.85 * expected


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["yaw", "position"])
def test_a_fix_within_a_gap_gives_little_information_about_the_track_before_it(kind):
    nees = []
    for seed in range(4):
        walk, holed, oracle = measured(seed, 18.0, CONFIG, gap=(15.0, 15.9))
        truth = walk.truth.at(np.array([15.85]))
        fix = position_fix(15.85, truth.position_W[0], 0.05**2 * np.eye(3))
        if kind == "yaw":
            fix = yaw_fix(15.85, yaw_of(truth.attitude_WB)[0], 0.02)
        track = Navigator(oracle, CONFIG, true_start(walk), "graph").run(holed, fixes=[fix])
        nees.append(position_nees(track, walk, int(np.searchsorted(track.time, 14.9))))
    assert np.mean(nees) < 7.8  # 95 % of a chi-square with three degrees of freedom


def test_a_yaw_within_a_short_gap_is_that_of_its_time(make_walk, make_oracle, without):
    walk = swivelled(make_walk(1, 16.0, 50.0), 2.0)
    holed = without(walk, (walk.time > 10.0) & (walk.time < 10.8))
    oracle = make_oracle(holed, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    fix = yaw_fix(10.5, yaw_of(walk.truth.at(np.array([10.5])).attitude_WB)[0], 0.02)
    graph = Navigator(oracle, CONFIG).run(holed, fixes=[fix])
    for track in (graph, graph.filtered):
        before = int(np.searchsorted(track.time, 9.5))
        error = yaw_error(track, walk, slice(before, before + 1))[0]
        assert abs(error) < 3.0 * np.sqrt(track.covariance[before, 2, 2]) < 2.0


@pytest.mark.parametrize(
    "jump", [(0.0, 0.0, 8.0), pytest.param((20.0, 0.0, 0.0), marks=pytest.mark.slow)]
)
def test_a_streams_graph_follows_the_fixes_where_the_filter_does(jump):
    """A lift, or a positioning system whose origin has moved."""
    walk, _, oracle = measured(2, 17.0, CONFIG)
    navigator = Navigator(oracle, CONFIG, true_start(walk), "graph")
    for fix in true_fixes(walk.truth, 2.0, 0.3, 0):
        value = fix.value + (np.array(jump) if fix.time > 7.0 else 0.0)
        navigator.update_position(fix.time, value, fix.covariance)
    for state in stream(navigator, walk):
        if state.time > 13.5:
            truth = walk.truth.at(np.array([state.time])).position_W[0] + jump
            assert np.linalg.norm(state.p_W - truth) < 1.5


def test_the_moments_of_a_large_turn_agree_with_sampled_turns():
    arm, sigma = np.array([3.0, -1.0, 0.5]), 1.2
    zero, no_covariance = np.zeros(3), np.zeros((15, 15))
    turn = FrameTransform(np.eye(3), zero, zero, False, -np.inf, yaw_sigma=sigma)
    state = NavState(0.0, np.eye(3), 0.5 * arm, arm, zero, zero, no_covariance)
    angles = np.random.default_rng(0).normal(0.0, sigma, 200_000)
    off = about_z(angles).apply(arm) - arm
    errors = np.column_stack([angles, 0.5 * off, off])
    rows = [2, *range(3, 9)]
    expected = errors.T @ errors / len(angles)
    found = turn.state(state).covariance[np.ix_(rows, rows)]
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())
    assert np.linalg.eigvalsh(found).min() > -1e-9


def test_a_rotation_rounded_to_four_digits_is_accepted(still_model, make_walk):
    walk, zero = make_walk(3, 5.0), np.zeros(3)
    R_WB = np.round(about_z(0.7).as_matrix(), 4)
    states = stream(Navigator(still_model, prior=PriorPose(R_WB, zero, zero)), walk)
    np.testing.assert_allclose(states[0].R_WB @ states[0].R_WB.T, np.eye(3), atol=1e-9)


@lru_cache(maxsize=4)
def turned(walk: ImuSequence, at: float, angle: float) -> ImuSequence:
    """Return a walk that turns at once by an angle [rad], which its samples do not show."""
    truth = walk.truth
    pivot = truth.at(np.array([at])).position_W[0]
    turn = about_z(np.where(truth.time > at, angle, 0.0))
    p_W, v_W = pivot + turn.apply(truth.position_W - pivot), turn.apply(truth.velocity_W)
    R_WB = turn * truth.attitude_WB
    after = replace(truth, attitude_WB=R_WB, position_W=p_W, velocity_W=v_W)
    return replace(walk, truth=after)
