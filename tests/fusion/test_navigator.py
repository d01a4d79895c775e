from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import CONFIG, GRAPH, ate, nav_state, samples, stream, stream_deviation, swivelled

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, PriorPose, Track, inertial_track
from stario.sequences import InputError, about_z, align, read_tum, write_tum, yaw_of
from stario.sequences.accuracy.metrics import pose_errors

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def track(walk, make_oracle):
    return Navigator(make_oracle(walk, walk.truth, CONFIG), backend="ekf").run(walk)


def test_results_print_without_their_arrays(track, walk, still_model):
    assert str(track.health).splitlines() == track.health.lines()
    navigator = Navigator(still_model)
    state = stream(navigator, walk.slice(0.0, 3.0))[-1]
    poses = state, navigator.continuous, navigator.smoothed
    for result in (track, navigator.observe(walk), *poses):
        assert repr(result).startswith(f"{type(result).__name__}(")
        assert len(repr(result)) < 80


def test_the_states_of_a_stream_become_a_track_that_can_be_written(walk, still_model, tmp_path):
    states = stream(Navigator(still_model), walk.slice(0.0, 4.0))
    written = Track.from_states(states).trajectory
    write_tum(tmp_path / "walk.tum", written)
    read = read_tum(tmp_path / "walk.tum")
    np.testing.assert_allclose(read.time, [state.time for state in states])
    np.testing.assert_allclose(read.position_W, [state.p_W for state in states], atol=1e-8)
    moved = [*states, replace(states[-1], time=9.0, map_frame=1)]
    for wrong, words in (([], "none"), (moved, "2 map frames"), ([None], "push")):
        with pytest.raises(InputError, match=words):
            Track.from_states(wrong)
    with pytest.raises(InputError, match=r"Track\.from_states"):
        write_tum(tmp_path / "walk.tum", states)


@pytest.mark.parametrize("carry", ["handheld", "pocket"])
def test_the_error_stays_far_below_that_of_dead_reckoning(make_walk, make_oracle, carry):
    walk = make_walk(3, 30.0, carry=carry)
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG), CONFIG)
    preprocessed = navigator.observe(walk)
    track = navigator.track(preprocessed)
    alone = ate(inertial_track(preprocessed, CONFIG), walk)
    assert ate(track, walk) < 0.6
    assert ate(track, walk) < 0.03 * alone


def test_the_blocks_of_the_covariance_have_names():
    state = nav_state(np.arange(225.0).reshape(15, 15))
    names = ("attitude", "velocity", "position", "gyro_bias", "accel_bias")
    for k, name in enumerate(names):
        block = slice(3 * k, 3 * k + 3)
        expected = state.covariance[block, block]
        np.testing.assert_array_equal(getattr(state, f"{name}_covariance"), expected)


def test_attitude_and_speed_are_estimated_too(walk, track):
    aligned = align(track.trajectory, walk.truth, "first")
    errors = pose_errors(aligned, walk.truth)
    late = errors.estimate.time > 5.0
    off = errors.estimate.velocity_W - errors.truth.velocity_W
    assert np.linalg.norm(off[late], axis=1).mean() < 0.3
    turn = errors.estimate.attitude_WB * errors.truth.attitude_WB.inv()
    assert np.degrees(turn.magnitude()[late].mean()) < 3.0


@pytest.mark.parametrize(
    ("rate", "update_rate"),
    [(50.0, 2), (1000.0, 2), (100.0, 1), (100.0, 5), pytest.param(100.0, 20, marks=slow)],
)
def test_the_track_is_accurate_at_any_rate(make_walk, make_oracle, rate, update_rate):
    walk = make_walk(4, 12.0, rate)
    config = NavigatorConfig(filter=FilterConfig(update_rate=update_rate))
    track = Navigator(make_oracle(walk, walk.truth, config), config, backend="ekf").run(walk)
    assert ate(track, walk) < 0.2
    np.testing.assert_allclose(np.diff(track.time), 1.0 / config.filter.output_rate, atol=1e-9)


def test_a_track_starts_at_the_prior_pose(walk, make_oracle):
    """The prior sets yaw, position and velocity, none of which gravity determines."""
    truth = walk.truth
    shift = np.array([100.0, -50.0, 3.0])
    prior = PriorPose(truth.attitude_WB[0].as_matrix(), truth.velocity_W[0], shift)
    navigator = Navigator(make_oracle(walk, truth, CONFIG), CONFIG, prior)
    track = navigator.run(walk)
    known = truth.at(np.clip(track.time, truth.time[0], truth.time[-1]))
    error = track.trajectory.position_W - shift - (known.position_W - truth.position_W[0])
    assert np.linalg.norm(error, axis=1).max() < 0.5
    off = track.trajectory.velocity_W - known.velocity_W
    assert np.linalg.norm(off[:20], axis=1).max() < 0.3
    assert stream_deviation(stream(navigator, walk), track.filtered) < 1e-9


def test_stream_equals_batch_through_gaps_and_bad_samples(walk, make_oracle, without):
    rng = np.random.default_rng(0)
    gone = (rng.random(len(walk)) < 0.1) | ((walk.time > 7.0) & (walk.time < 8.3))
    holed = without(walk, gone)
    holed.gyro[100:104] = np.nan
    oracle = make_oracle(holed, walk.truth, CONFIG)
    track, navigator = Navigator(oracle, backend="ekf").run(holed), Navigator(oracle)
    assert stream_deviation(stream(navigator, holed), track) < 1e-9
    ours, theirs = navigator.health, track.health
    assert (ours.gaps, ours.samples, ours.updates) == (theirs.gaps, theirs.samples, theirs.updates)
    assert ours.mean_nis == pytest.approx(theirs.mean_nis)
    np.testing.assert_allclose(navigator.state.covariance, track.covariance[-1], rtol=1e-9)


def test_run_does_not_disturb_a_stream_in_progress(walk, make_oracle, track):
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG))
    half = len(walk) // 2
    rows = list(samples(walk))
    states = [navigator.push(*row) for row in rows[:half]]
    again = navigator.run(walk)
    states += [navigator.push(*row) for row in rows[half:]]
    assert stream_deviation([s for s in states if s is not None], track) < 1e-9
    filtered = again.filtered.trajectory
    np.testing.assert_array_equal(filtered.position_W, track.trajectory.position_W)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_ground_truth_is_never_used(walk, make_oracle, backend):
    walk = walk.slice(0.0, 10.0)
    navigator = Navigator(make_oracle(walk, walk.truth, GRAPH), GRAPH, backend=backend)
    known, blind = (navigator.run(each).arrays() for each in (walk, walk.without_truth()))
    for name, values in known.items():
        np.testing.assert_array_equal(blind[name], values, err_msg=name)


def test_times_since_1970_give_the_same_track(walk, make_oracle, track):
    late = replace(walk, time=walk.time + 1.7e9)
    truth = replace(walk.truth, time=walk.truth.time + 1.7e9)
    ours = Navigator(make_oracle(late, truth, CONFIG), backend="ekf").run(late.without_truth())
    assert np.abs(ours.trajectory.position_W - track.trajectory.position_W).max() < 5e-3


@pytest.mark.parametrize(
    ("backend", "mount", "atol"),
    [("ekf", (3.1, 0.0, 0.0), 1e-6), ("graph", (1.5, 1.0, -0.5), 1e-4)],
)
def test_another_mount_only_turns_the_track(walk, make_oracle, backend, mount, atol):
    R_BM = Rotation.from_rotvec(mount)
    config = CONFIG if backend == "ekf" else GRAPH
    walk = walk.slice(0.0, 10.0)
    gyro, accel = (R_BM.apply(values, inverse=True) for values in (walk.gyro, walk.accel))
    truth = replace(walk.truth, attitude_WB=walk.truth.attitude_WB * R_BM)
    tracks = []
    for each in (replace(walk, gyro=gyro, accel=accel, truth=truth), walk):
        oracle = make_oracle(each, each.truth, config)
        tracks.append(Navigator(oracle, config, backend=backend).run(each).trajectory)
    ours, theirs = tracks
    turn = ours.attitude_WB * (theirs.attitude_WB * R_BM).inv()
    assert np.ptp(np.unwrap(yaw_of(turn))) < atol
    back = about_z(float(yaw_of(turn)[0])).apply(ours.position_W, inverse=True)
    assert np.abs(back - theirs.position_W).max() < 10.0 * atol


def test_the_first_tilt_is_less_certain_the_faster_the_device_turns(make_walk, still_model):
    walk = make_walk(3, 3.0)
    tracks = (Navigator(still_model, backend="ekf").run(s) for s in (walk, swivelled(walk, 3.0)))
    slow, fast = (np.sqrt(track.covariance[0, 0, 0]) for track in tracks)
    assert fast > 2.0 * slow
