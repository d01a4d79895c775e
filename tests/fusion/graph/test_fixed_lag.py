from dataclasses import replace
from typing import Any

import numpy as np
from initial_ekf import Driven
from simulated import measured
from support import GRAPH as CONFIG
from support import lying, nav_state, samples, stream, true_start

from stario.fusion import Navigator, NavigatorConfig, NavState
from stario.fusion.filter import estimator
from stario.fusion.filter.gained import gained_information
from stario.fusion.filter.magnetic import with_field
from stario.fusion.graph.fixed_lag import FixedLag
from stario.fusion.graph.keyframes import KeyframeGraph
from stario.fusion.graph.term import IndeterminateError
from stario.fusion.values.lie import yaw_twist
from stario.sequences import ImuSequence, MagneticField, about_z, simulate_imu
from stario.sequences.attitude.so3 import exp_so3, log_so3


def lagged(model: Any, config: NavigatorConfig = CONFIG, **more: Any) -> Navigator:
    return Navigator(model, config, backend="graph", **more)


def errors(states: list[NavState], walk: ImuSequence) -> np.ndarray:
    time = np.array([s.time for s in states])
    position = np.array([s.p_W for s in states])
    return np.linalg.norm(position - walk.truth.at(time).position_W, axis=1)


def assert_valid(state: NavState) -> None:
    for value in (state.R_WB, state.v_W, state.p_W, state.b_g, state.b_a, state.covariance):
        assert np.isfinite(value).all()
    assert np.linalg.eigvalsh(state.covariance).min() > -1e-9
    np.testing.assert_allclose(state.R_WB @ state.R_WB.T, np.eye(3), atol=1e-9)


def test_a_stream_is_about_as_accurate_as_the_filter():
    """Same times, similar errors and sigmas; above all yaw's, which only fixes determine."""
    walk, _, oracle = measured(5, 16.0, CONFIG)
    start = true_start(walk)
    navigators = (Navigator(oracle, CONFIG, start, backend) for backend in ("graph", "ekf"))
    ours, theirs = (stream(navigator, walk) for navigator in navigators)
    assert [s.time for s in ours] == [s.time for s in theirs]
    assert errors(ours, walk).mean() < 1.3 * errors(theirs, walk).mean() + 0.02
    sigma, expected = (np.sqrt(np.diag(states[-1].covariance)) for states in (ours, theirs))
    np.testing.assert_allclose(sigma[:9], expected[:9], rtol=0.1)
    assert 0.95 < sigma[2] / expected[2] < 1.05


def test_a_tilted_start_misleads_a_stream_no_more_than_the_filter(make_walk, make_oracle):
    """Starts in motion are up to 0.2 rad off level; correct displacements then look false."""
    walk = make_walk(5, 10.0, 50.0)
    config = replace(CONFIG, filter=replace(CONFIG.filter, update_rate=1))
    oracle = make_oracle(walk, walk.truth, config, noise=0.03, sigma=0.03)
    start = true_start(walk)
    tilted = replace(start, R_WB=exp_so3(np.array([0.3, 0.0, 0.0])) @ start.R_WB, tilt_sigma=0.05)
    navigators = (Navigator(oracle, config, tilted, backend) for backend in ("graph", "ekf"))
    ours, theirs = (stream(navigator, walk) for navigator in navigators)
    assert errors(ours, walk).max() < 1.1 * errors(theirs, walk).max() + 0.1


def track_with_outliers(preprocessed, config, metres: float, intervals: range):
    """Positions until 3 s after intervals with false displacements, and the number gated."""
    filtered = estimator.begin(config, preprocessed.start, streaming=True)
    graph, positions = FixedLag(filtered, config), []
    for k in range(intervals.stop + 3 * config.filter.output_rate):
        measurement = preprocessed.measurements[k]
        if measurement is not None and k in intervals:
            measurement = measurement._replace(d_N=measurement.d_N + metres * np.eye(3)[0])
        interval = preprocessed.intervals[k]
        filtered, record = estimator.step(filtered, interval, measurement, (), config)
        graph.step(filtered, record)
        positions.append(graph.nav_state(filtered).p_W)
    return np.array(positions), filtered.counts.gated


def test_a_stream_gates_displacements_as_its_filter_does(walk, make_oracle):
    """Two displacements that are 5 m off are down-weighted by both."""
    walk = walk.slice(0.0, 9.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    preprocessed = Navigator(oracle, CONFIG).observe(walk)
    clean, clean_gated = track_with_outliers(preprocessed, CONFIG, 0.0, range(40, 50))
    corrupted, corrupted_gated = track_with_outliers(preprocessed, CONFIG, 5.0, range(40, 50))
    assert clean_gated == 0
    # Both false ones, and the correct one after them, since the second has changed the velocity.
    assert corrupted_gated == 3
    # The accelerometer has less weight after them (`InnovationStatistics`): 0.19 to 0.34 m.
    assert np.linalg.norm(corrupted[-1] - clean[-1]) < 0.4


def test_a_stream_gates_displacements_itself_if_the_filter_uses_more_of_them(walk, make_oracle):
    """At 20 updates a second the graph uses one window in ten, so a false one pulls harder."""
    walk = walk.slice(0.0, 7.0)
    config = replace(CONFIG, filter=replace(CONFIG.filter, update_rate=20))
    oracle = make_oracle(walk, walk.truth, config, noise=0.1, sigma=0.1)
    preprocessed = Navigator(oracle, config).observe(walk)
    late = (k for k, each in enumerate(preprocessed.intervals) if each.stop > walk.time[0] + 2.99)
    at = next(late)
    clean, _ = track_with_outliers(preprocessed, config, 0.0, range(at, at + 1))
    corrupted, _ = track_with_outliers(preprocessed, config, 1.2, range(at, at + 1))
    assert np.linalg.norm(corrupted - clean, axis=1).max() < 0.35


def test_a_heading_far_from_the_estimate_turns_a_stream_like_its_filter():
    """Used as inflated by the filter; to a robust loss of the graph's own it is 60 sigma off."""
    walk, _, oracle = measured(5, 8.0, CONFIG)
    start = true_start(walk)
    turn = about_z(0.6).as_matrix()
    turned = replace(start, R_WB=turn @ start.R_WB, v_W=turn @ start.v_W, yaw_sigma=0.5)
    R_WB = walk.truth.at(np.array([5.25])).attitude_WB.as_matrix()[0]
    ends = []
    for backend in ("graph", "ekf"):
        navigator = Navigator(oracle, CONFIG, turned, backend)
        navigator.update_yaw(5.25, yaw_twist(R_WB), 0.01)
        ends.append(errors(stream(navigator, walk), walk)[-1])
    assert ends[0] < 1.2 * ends[1] + 0.1


def test_a_late_fix_that_changes_the_gating_brings_a_stream_to_its_filter():
    """A start 4 m/s off makes correct displacements look false until a fix gives the velocity."""
    walk, _, oracle = measured(5, 6.0, CONFIG)
    start = true_start(walk)
    fast = replace(start, v_W=start.v_W + np.array([4.0, 0.0, 0.0]), velocity_sigma=0.5)
    v_W = walk.truth.at(np.array([0.3])).velocity_W[0]
    late = []
    for backend in ("graph", "ekf"):
        navigator = Navigator(oracle, CONFIG, fast, backend)
        states = []
        for row in samples(walk):
            states.append(navigator.push(*row))
            if abs(row[0] - 1.15) < 1e-6:
                navigator.update_velocity(0.3, v_W, 1e-4 * np.eye(3))
        late.append(errors([s for s in states if s is not None and s.time > 1.2], walk))
    assert late[1].max() < 0.5
    assert late[0].max() < late[1].max() + 0.15


def test_a_late_fix_from_before_the_graph_began_brings_a_stream_to_its_filter(walk, make_oracle):
    """The graph begins at the first position; a better and earlier one arrives after it."""
    oracle = make_oracle(walk, walk.truth, CONFIG)
    late = []
    for backend in ("graph", "ekf"):
        navigator = Navigator(oracle, CONFIG, backend=backend)
        first, second = walk.truth.at(np.array([9.83, 10.03])).position_W
        navigator.update_position(10.03, second + np.array([4.0, 3.0, 0.0]), 25.0 * np.eye(3))
        stream(navigator, walk.slice(0.0, 10.45))
        assert navigator.update_position(9.83, first, 1e-4 * np.eye(3)) == "applied"
        late.append(navigator.state.p_W)
    np.testing.assert_allclose(*late, atol=1e-6)


def test_a_lag_longer_than_the_walk_changes_little(walk, make_oracle):
    """Marginalised information is kept."""
    walk = walk.slice(0.0, 8.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    configs = (replace(CONFIG, graph=replace(CONFIG.graph, lag=lag)) for lag in (3.0, 60.0))
    ends = [stream(lagged(oracle, config), walk)[-1] for config in configs]
    assert np.linalg.norm(ends[0].p_W - ends[1].p_W) < 0.15
    np.testing.assert_allclose(*(np.sqrt(np.diag(s.covariance)) for s in ends), rtol=0.05)


def test_marginalisation_leaves_the_newest_state_unchanged(walk, make_oracle):
    """Even where windows reach from the removed keyframes past the first one that stays."""
    walk = walk.slice(0.0, 6.2)
    navigator = lagged(make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03))
    stream(navigator, walk)
    graph = navigator._stream.graph.builder.graph
    before, oldest = graph.solve()[graph.last], min(graph.states)
    graph.marginalise(oldest + 3)
    after = graph.solve(1)[graph.last]
    assert min(graph.states) == oldest + 3
    np.testing.assert_allclose(after.p_W, before.p_W, atol=1e-4)
    np.testing.assert_allclose(after.v_W, before.v_W, atol=1e-4)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-3, atol=1e-7)


def test_late_fixes_correct_the_newest_state_too(walk, make_oracle):
    walk = walk.slice(0.0, 15.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    navigator = lagged(oracle, prior=true_start(walk))
    measured = walk.truth.at(np.array([10.33, 14.0])).position_W
    before = after = None
    for row in samples(walk):
        if navigator.push(*row) is None:
            continue
        if abs(row[0] - 10.9) < 0.01 and before is None:  # more than half a second late
            before = navigator.state
            navigator.update_position(10.33, measured[0], 1e-4 * np.eye(3))
            after = navigator.state
        if abs(row[0] - 13.5) < 0.01:  # half a second early
            navigator.update_position(14.0, measured[1], 1e-4 * np.eye(3))
    assert before.time == after.time
    assert errors([after], walk)[0] < 0.1
    assert np.trace(after.covariance[6:9, 6:9]) < 0.2 * np.trace(before.covariance[6:9, 6:9])
    assert navigator.health.fixes == {"applied": 2}
    assert_valid(navigator.state)


def test_rest_stops_the_drift(still_model):
    """A device on a table with an uninformative network."""
    navigator = lagged(still_model)
    stream(navigator, lying(15.0, 100.0, 3 * [2e-3], 2e-3, 0.02))
    assert navigator.health.zero_velocity["applied"] > 100
    assert np.linalg.norm(navigator.state.p_W) < 0.1
    np.testing.assert_allclose(navigator.state.b_g, 2e-3, atol=2e-4)


def test_if_the_graph_fails_the_stream_continues_from_the_filter(walk, make_oracle, monkeypatch):
    solve, calls = KeyframeGraph.solve, []

    def fails_once(self, max_rounds, only_last):
        calls.append(self.times[self.last])
        if abs(calls[-1] - 8.0) < 1e-6 and calls.count(calls[-1]) == 1:
            raise IndeterminateError("velocity at 8.0 s is undetermined")
        return solve(self, max_rounds, only_last=only_last)

    walk = walk.slice(0.0, 12.0)
    oracle = make_oracle(walk, walk.truth, CONFIG)
    filtered = stream(Navigator(oracle, CONFIG), walk)
    monkeypatch.setattr(KeyframeGraph, "solve", fails_once)
    navigator = lagged(oracle)
    states = stream(navigator, walk)
    at = next(k for k, s in enumerate(states) if abs(s.time - 8.0) < 1e-6)
    np.testing.assert_allclose(states[at].p_W, filtered[at].p_W, atol=1e-9)
    assert len(calls) > 20
    assert errors(states[-1:], walk)[0] < errors(filtered[-1:], walk)[0] + 0.3
    assert "velocity at 8.0 s is undetermined" in navigator.health.notes[0]


def test_after_a_long_gap_the_graph_restarts(make_walk, make_oracle, without):
    walk = make_walk(1, 80.0, 50.0)
    holed = without(walk, (walk.time > 6.0) & (walk.time < 74.0))
    oracle = make_oracle(holed, walk.truth, CONFIG)
    navigator = lagged(oracle)
    for state in stream(navigator, holed):
        assert_valid(state)
    track = navigator.run(holed)
    assert np.isfinite(track.covariance).all()
    assert not any("fell back" in note for note in track.health.notes)


Z = [0, 1, 2, 9, 10, 11]
FIELD_B = np.array([15.0, -8.0, -40.0])


def ekf_with_field() -> Driven:
    """A filter with an azimuth, whose yaw and bias are correlated and known to a few degrees."""
    ekf = Driven(slots=0)
    P = 0.01 * np.eye(15)
    P[2, 11] = P[11, 2] = 2e-4
    P[9:12, 9:12] = 1e-5 * np.eye(3)
    ekf.initialise(nav_state(P))
    ekf.state = with_field(ekf.state, FIELD_B)
    P = ekf.P.copy()
    P[-5:, -5:] = np.diag([0.04**2, 0.05**2, 1.0, 1.0, 1.0])  # a field known from before
    ekf.P = P
    return ekf


def test_the_information_gained_gives_the_filters_covariance_and_mean():
    ekf = ekf_with_field()
    before = ekf.state
    turned_B = np.array([15.5, -4.0, -40.0])
    assert ekf.update_bearing(turned_B, 0.05**2, gate=1e9).accepted
    after = ekf.state
    gained = gained_information(before, after)
    u, value, variance, *_ = gained
    P = before.P[np.ix_(Z, Z)]
    gain = P @ u / (u @ P @ u + variance)
    np.testing.assert_allclose(P - np.outer(gain, u @ P), after.P[np.ix_(Z, Z)], atol=1e-10)
    # Relative to the estimate after the bearing, the one before it is off by minus the change.
    turned = log_so3(after.R_WB @ before.R_WB.T)
    change = np.concatenate([turned, after.b_g - before.b_g])
    assert abs(turned[2]) > 0.01
    np.testing.assert_allclose(gain * (value + u @ change), change, rtol=0.02, atol=1e-6)
    # An update of neither yaw nor bias gains nothing.
    ekf.update_position_W(np.ones(3), 0.01 * np.eye(3))
    assert gained_information(after, ekf.state) is None


def test_the_field_bounds_the_yaw_of_a_stream(make_walk, make_oracle):
    """A gyroscope as noisy as this is lost by 0.54 rad after 14 s, but for the magnetic field."""
    truth = make_walk(3, 14.0, 50.0).truth
    walk = simulate_imu(truth, 50.0, magnetic_field=MagneticField(), seed=3)
    noisy = replace(CONFIG, noise=replace(CONFIG.noise, gyro_noise=0.144))
    oracle = make_oracle(walk, truth, noisy, noise=0.03, sigma=0.03)
    navigators = (Navigator(oracle, noisy, backend=backend) for backend in ("graph", "ekf"))
    graph, ekf = (np.sqrt(stream(each, walk)[-1].covariance[2, 2]) for each in navigators)
    assert ekf < 0.48
    assert 0.9 * ekf < graph < 1.1 * ekf
