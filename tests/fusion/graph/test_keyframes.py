from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import Oracle, measured
from support import GRAPH as CONFIG
from support import nav_state, stream, true_start
from told import health_lines

from stario.fusion import Navigator, backends
from stario.fusion.filter.initial import PriorPose
from stario.fusion.graph import keyframes
from stario.fusion.graph.batch import smooth
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.graph.keyframes import KeyframeGraph
from stario.fusion.graph.term import IndeterminateError
from stario.fusion.imu.preintegration import preintegrate
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import position_fix, velocity_fix, yaw_fix
from stario.fusion.values.lie import yaw_twist
from stario.fusion.values.state import NavState
from stario.sequences import ImuNoise, about_z, position_nees, yaw_of
from stario.sequences.simulation.insertion import insert_moment
from stario.sequences.simulation.moments import Moment, MomentMotion, ramp


def graph(model: Any, config: NavigatorConfig = CONFIG, **more: Any) -> Navigator:
    return Navigator(model, config, backend="graph", **more)


@pytest.fixture(scope="module")
def oracle(walk, make_oracle):
    return make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03)


@pytest.fixture(scope="module")
def filtered(walk, oracle):
    return Navigator(oracle, CONFIG, backend="ekf").run(walk)


def test_states_are_at_the_filters_times_with_a_smaller_covariance(walk, oracle, filtered):
    smoothed = graph(oracle).run(walk)
    np.testing.assert_array_equal(smoothed.time, filtered.time)
    ours, theirs = (np.trace(t.covariance[:, 3:6, 3:6], axis1=1, axis2=2) for t in
                    (smoothed, filtered))  # fmt: skip
    assert (ours[10:] < 1.05 * theirs[10:]).all()  # velocity, after the first second
    assert ours.mean() < 0.7 * theirs.mean()
    for covariance in smoothed.covariance:
        scale = np.abs(covariance).max()
        np.testing.assert_allclose(covariance / scale, covariance.T / scale, atol=1e-10)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert smoothed.health.notes == []
    assert 0.3 < position_nees(smoothed.trajectory, walk.truth).mean < 3.0  # 0.5 for this walk


def test_the_track_follows_the_imu_between_keyframes(walk, make_oracle):
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.05, sigma=0.05)
    track = graph(oracle).run(walk).trajectory
    step = np.diff(track.time)[:, None]
    mean = 0.5 * (track.velocity_W[1:] + track.velocity_W[:-1])
    off = np.linalg.norm(np.diff(track.position_W, axis=0) / step - mean, axis=1)
    assert off.max() < 0.1  # of 1.2 m/s
    truth = walk.truth.at(track.time)
    turned = (track.attitude_WB * truth.attitude_WB.inv()).magnitude()
    assert np.abs(np.diff(turned)).max() < 0.01


def twice_about(rng: np.random.Generator, time: np.ndarray, attitude_LB: object) -> MomentMotion:
    """Two turns of the device in half a second, as of a phone that is thrown and caught."""
    count = len(time)
    turn = 4.0 * np.pi * ramp((time - 1.0) / 0.8)[:, None] * [0.8, 0.6, 0.0]
    return MomentMotion(np.zeros((count, 3)), turn, np.zeros(count), np.ones(count))


def test_a_spin_of_two_turns_does_not_lose_the_heading():
    walk = measured(3, 16.0, CONFIG)[0]
    spun = insert_moment(walk, walk.truth, Moment("spin", 3.0, twice_about), 0.5, 0).sequence
    oracle = Oracle(spun, spun.truth, CONFIG, noise=0.03, sigma=0.03)
    start = true_start(walk)
    track = graph(oracle, prior=start).run(spun)
    last = stream(graph(oracle, prior=start), spun)[-1]
    batch = track.trajectory.attitude_WB.as_matrix()[-1], track.covariance[-1]
    truth = spun.truth.at(track.time[-1:]).attitude_WB.as_matrix()[0]
    for R_WB, covariance in (batch, (last.R_WB, last.covariance)):
        assert abs(yaw_twist(R_WB @ truth.T)) < 0.1
        assert covariance[2, 2] < 0.1**2


def smooth_turned(filtered, *others):
    """Smooth from headings that are off by 6 rad in the end."""
    turns = about_z([0.3 * (state.time - filtered[0].time) for state in filtered]).as_matrix()
    lost = [
        replace(s, **{name: turn @ getattr(s, name) for name in ("R_WB", "v_W", "p_W")})
        for s, turn in zip(filtered, turns, strict=True)
    ]
    return smooth(lost, *others)


def test_the_track_does_not_depend_on_a_heading_that_the_filter_lost(monkeypatch):
    """With full steps, and with small turns where these do not converge."""
    walk, _, oracle = measured(3, 20.0, CONFIG)
    expected = graph(oracle).run(walk)
    monkeypatch.setattr(backends, "smooth", smooth_turned)
    for full_steps in (50, 1):
        monkeypatch.setattr(keyframes, "_FULL_STEPS", full_steps)
        found = graph(oracle).run(walk)
        assert found.health.notes == []
        off = found.trajectory.position_W - expected.trajectory.position_W
        assert np.linalg.norm(off, axis=1).max() < 0.05


def test_a_track_that_does_not_converge_is_not_given_out(walk, oracle, filtered, monkeypatch):
    monkeypatch.setattr(backends, "smooth", smooth_turned)
    monkeypatch.setattr(keyframes, "_FULL_STEPS", 1)
    monkeypatch.setattr(keyframes, "_SMALL_TURNS", 1)
    found = graph(oracle).run(walk)
    np.testing.assert_array_equal(found.trajectory.position_W, filtered.trajectory.position_W)
    np.testing.assert_array_equal(found.covariance, filtered.covariance)
    [note] = found.health.notes
    assert "converge" in note
    assert any("filter's track" in line for line in health_lines(found.health))


def test_a_turned_and_shifted_world_turns_and_shifts_the_track(walk, make_oracle):
    walk = walk.slice(0.0, 12.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    R = walk.truth.attitude_WB[0].as_matrix()
    turn, shift = about_z(2.0), np.array([100.0, -40.0, 3.0])
    first = PriorPose(R, np.zeros(3), np.zeros(3), velocity_sigma=1.0)
    other = replace(first, R_WB=turn.as_matrix() @ R, p_W=shift)
    here, there = (graph(oracle, prior=prior).run(walk).trajectory for prior in (first, other))
    expected = turn.apply(here.position_W) + shift
    np.testing.assert_allclose(there.position_W, expected, atol=1e-4)
    np.testing.assert_allclose(there.velocity_W, turn.apply(here.velocity_W), atol=1e-4)


def first_state(covariance: np.ndarray) -> NavState:
    return nav_state(covariance, 12.3)


@pytest.mark.parametrize(("first", "name"), [(3, "velocity"), (6, "position"), (9, "bias")])
def test_an_undetermined_state_is_named(first, name):
    sigma = np.full(15, 0.1)
    sigma[first : first + 3] = 1e9
    graph = KeyframeGraph(first_state(np.diag(sigma**2)), gate=0.997)
    samples = np.linspace(12.3, 13.3, 11), np.zeros((11, 3)), np.tile([0.0, 0.0, 9.80665], (11, 1))
    segment = preintegrate(*samples, np.zeros(3), np.zeros(3), ImuNoise(), 9.80665)
    graph.add_keyframe(13.3, KeyframeState.from_nav(first_state(np.eye(15))), segment)
    with pytest.raises(IndeterminateError, match=f"{name} at"):
        graph.solve()
    np.testing.assert_array_equal(graph.states[1].p_W, np.zeros(3))


def test_the_graph_accepts_a_perfect_sensor(walk, make_oracle):
    """With densities of zero gtsam has nothing to invert; the track is computed all the same."""
    exact = replace(CONFIG, noise=ImuNoise(0.0, 0.0, 0.0, 0.0))
    track = graph(make_oracle(walk, walk.truth, exact), exact).run(walk)
    assert np.isfinite(track.trajectory.position_W).all()
    assert track.health.notes == []  # it did not fall back


@pytest.mark.parametrize("length", [0.3, 3.0])
def test_a_gap_is_crossed_and_its_sigma_covers_the_error(walk, make_oracle, without, length):
    walk = walk.slice(0.0, 14.0)
    holed = without(walk, (walk.time > 8.0) & (walk.time < 8.0 + length))
    track = graph(make_oracle(holed, walk.truth, CONFIG)).run(holed)
    assert track.time[~track.trajectory.valid] == pytest.approx([8.0 + length], abs=0.02)
    assert np.isfinite(track.covariance).all()
    assert track.health.notes == []  # it did not fall back
    at_end = walk.truth.at(np.clip(track.time[-1:], 0.0, walk.time[-1]))
    turn = about_z(float(yaw_of(at_end.attitude_WB * track.trajectory.attitude_WB[-1].inv())[0]))
    start = walk.truth.position_W[0]
    error = np.linalg.norm(turn.apply(track.trajectory.position_W[-1]) + start - at_end.position_W)
    assert error < 4.0 * np.sqrt(np.trace(track.covariance[-1, 6:9, 6:9])) + 0.5


@pytest.mark.parametrize("time", [10.0, 10.37, 10.4])
def test_a_position_fix_pulls_the_track_to_it_at_its_own_time(walk, make_oracle, time):
    walk = walk.slice(0.0, 15.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    truth = walk.truth.at(np.array([time])).position_W[0]
    fix = position_fix(time, truth, 1e-4 * np.eye(3))
    track = graph(oracle, prior=true_start(walk)).run(walk, fixes=[fix])
    near = np.abs(track.time - time) < 0.11
    true = walk.truth.at(track.time[near]).position_W
    assert np.linalg.norm(track.trajectory.position_W[near] - true, axis=1).max() < 0.06
    k = int(np.argmin(np.abs(track.time - time)))
    assert np.sqrt(track.covariance[k, 6:9, 6:9].trace()) < 0.08
    assert track.health.fixes == {"applied": 1}


def test_the_track_meets_heading_and_velocity_fixes(walk, make_oracle):
    walk = walk.slice(0.0, 16.0)
    oracle = make_oracle(walk, walk.truth, CONFIG)
    truth = walk.truth.at(np.array([9.25, 14.0]))
    yaw = float(yaw_of(truth.attitude_WB)[0])
    fixes = [yaw_fix(9.25, yaw, 1e-3)]
    fixes += [velocity_fix(14.0, truth.velocity_W[1], 1e-4 * np.eye(3))]
    track = graph(oracle, prior=true_start(walk)).run(walk, fixes=fixes)
    near = int(np.argmin(np.abs(track.time - 9.25)))
    at = walk.truth.at(track.time[[near]])
    off = yaw_of(track.trajectory.attitude_WB[[near]] * at.attitude_WB.inv())
    assert abs(float(off[0])) < 0.01
    k = int(np.argmin(np.abs(track.time - 14.0)))
    assert np.linalg.norm(track.trajectory.velocity_W[k] - truth.velocity_W[1]) < 0.05
    assert track.covariance[k, 3, 3] < 2e-4


def test_a_heading_at_a_tilted_device_is_measured_at_the_tilt_that_the_graph_finds():
    """At 126 degrees, the start's error of the tilt enters a yaw fix twice as large."""
    walk, _, oracle = measured(1, 15.0, CONFIG, noise=0.1, mount_rotvec=(2.2, 0.0, 0.0))
    first = Rotation.from_rotvec([0.1, -0.1, 0.0]) * walk.truth.attitude_WB[0]
    start = first.as_matrix(), walk.truth.velocity_W[0], walk.truth.position_W[0]
    times = np.arange(0.51, 14.0, 0.1)
    yaws = [yaw_twist(R) for R in walk.truth.at(times).attitude_WB.as_matrix()]
    fixes = [yaw_fix(t, yaw, 0.01) for t, yaw in zip(times, yaws, strict=True)]
    prior = PriorPose(*start, tilt_sigma=0.1, yaw_sigma=0.3)
    track = graph(oracle, prior=prior).run(walk, fixes=fixes)
    true = walk.truth.at(np.clip(track.time, 0.0, walk.time[-1])).attitude_WB
    off = (true * track.trajectory.attitude_WB.inv()).as_rotvec()[:, 2]
    assert np.mean(off**2 / track.covariance[:, 2, 2]) < 3.0  # 1 expected


def test_contradicting_fixes_are_weighed_until_the_track_has_converged(make_walk, make_oracle):
    """Headings off by 86 degrees, as from another axis: accurate positions outweigh them."""
    walk, rng = make_walk(7, 20.0, 50.0), np.random.default_rng(0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.05, sigma=0.05)
    times = np.arange(3.03, 19.0)
    places = walk.truth.at(times).position_W
    places += 0.1 * rng.standard_normal(places.shape)
    yaws = yaw_of(walk.truth.at(times + 0.25).attitude_WB) + 1.5
    fixes = [position_fix(t, p, 0.01 * np.eye(3)) for t, p in zip(times, places, strict=True)]
    fixes += [yaw_fix(t + 0.25, yaw, 0.1) for t, yaw in zip(times, yaws, strict=True)]
    track = graph(oracle).run(walk, fixes=fixes)
    end = walk.truth.at(walk.time[-1:]).position_W[0]
    assert np.linalg.norm(track.trajectory.position_W[-1] - end) < 0.5


def test_accurate_positions_with_an_unknown_height_need_no_fall_back(walk, make_oracle):
    walk = walk.slice(0.0, 14.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.05, sigma=0.05)
    times = np.arange(2.03, 13.0)
    flat = walk.truth.at(times).position_W * [1.0, 1.0, 0.0]
    covariance = np.diag([1e-4, 1e-4, 1e12])
    fixes = [position_fix(t, p, covariance) for t, p in zip(times, flat, strict=True)]
    track = graph(oracle).run(walk, fixes=fixes)
    assert track.health.notes == []
    navigator = graph(oracle)
    for fix in fixes:
        navigator.update_position(fix.time, fix.value, fix.covariance)
    states = stream(navigator, walk)
    assert navigator.health.notes == []
    for state, p_W in ((states[-1], states[-1].p_W), (track, track.trajectory.position_W[-1])):
        true = walk.truth.at(np.array([min(np.atleast_1d(state.time)[-1], 14.0)])).position_W[0]
        assert np.linalg.norm((p_W - true)[:2]) < 0.5
