from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import CONFIG as PHONE
from support import WHITE as CONFIG
from support import WHITE_ERRORS as ERRORS
from support import nav_state, samples, stream

from stario.fusion import Navigator, NavState, SmoothedPose, position_fix
from stario.fusion.values.state import MAX_STEP, advanced
from stario.sequences.accuracy.metrics import align, pose_errors
from stario.sequences.sequence import ImuSequence, Trajectory
from stario.sequences.simulation.magnetometer import MagneticField, simulate_magnetometer


def errors_at(track: Trajectory, walk: ImuSequence) -> np.ndarray:
    return pose_errors(align(track, walk.truth, "first"), walk.truth).position_W


@pytest.fixture(scope="module")
def walks(make_walk, make_oracle):
    """Walks, each with a model that measures its displacements with white noise."""
    walks = [make_walk(seed, 30.0, 50.0, ERRORS) for seed in range(5)]
    oracle = partial(make_oracle, config=CONFIG, noise=0.1, sigma=0.1)
    return [(walk, oracle(walk, walk.truth, seed=k)) for k, walk in enumerate(walks)]


@pytest.fixture(scope="module")
def tracks(walks):
    return [(walk, Navigator(model, CONFIG).run(walk)) for walk, model in walks]


def test_a_recordings_track_is_more_accurate_than_the_filters_and_consistent(tracks):
    filtered, smoothed, nees = [], [], []
    for walk, track in tracks:
        error = errors_at(track.trajectory, walk)[5:]
        smoothed.append(np.square(error).sum(axis=1).mean())
        theirs = errors_at(track.filtered.trajectory, walk)[5:]
        filtered.append(np.square(theirs).sum(axis=1).mean())
        P = align(track.trajectory, walk.truth, "first").position_covariance_W[5:]
        nees.append(np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0]))
    assert np.mean(smoothed) < 0.95 * np.mean(filtered)
    assert 1.2 < np.median(np.concatenate(nees)) < 3.6  # median of chi-square with 3 DoF: 2.4


def test_a_walk_taken_for_closed_is_bent_towards_its_start_and_doubted(walks):
    closed = replace(CONFIG, place=replace(CONFIG.place, closed=True))
    for walk, model in walks[:2]:
        ends = walk.truth.position_W[[0, -1], :2]
        apart = np.linalg.norm(np.diff(ends, axis=0))
        track = Navigator(model, closed).run(walk)
        assert np.linalg.norm(track.trajectory.position_W[-1, :2]) < 0.9 * apart
        assert ["leave out" in note for note in track.health.notes] == [True]


def test_a_closed_walk_is_not_doubted(walk, still_model):
    closed = replace(PHONE, place=replace(PHONE.place, closed=True))
    assert Navigator(still_model, closed).run(walk).health.notes == []


def steps(time: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Distances [m] between positions that the velocity does not explain."""
    moved = 0.5 * np.diff(time)[:, None] * (velocity[1:] + velocity[:-1])
    return np.linalg.norm(np.diff(position, axis=0) - moved, axis=1)


def test_a_recordings_track_moves_by_its_velocity_where_the_filters_steps(tracks):
    for _, track in tracks:
        both = track.trajectory, track.filtered.trajectory
        smoothed, filtered = (steps(t.time, t.position_W, t.velocity_W) for t in both)
        assert smoothed.max() < 0.03
        assert filtered.max() > 0.05


def test_a_bias_known_at_the_end_mends_the_beginning(tracks):
    """The IMU's biases hardly change within half a minute."""
    for _, track in tracks:
        sigma, late = (t.covariance[:, 12, 12] for t in (track, track.filtered))
        assert sigma[0] < 0.5 * late[0]
        assert sigma[0] < 1.5 * late[-1]


def test_the_filters_track_stands_beside_and_is_the_streams(walks, tracks):
    (walk, model), (_, track) = walks[0], tracks[0]
    alone = Navigator(model, CONFIG, backend="ekf").run(walk)
    assert alone.filtered is None
    for name in ("position_W", "velocity_W"):
        ours, theirs = (getattr(t.trajectory, name) for t in (track.filtered, alone))
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(track.filtered.covariance, alone.covariance)
    np.testing.assert_array_equal(track.time, alone.time)
    assert track.filtered.nis == track.nis == alone.nis
    streamed = stream(Navigator(model, CONFIG), walk)[-1]
    np.testing.assert_allclose(streamed.p_W, alone.trajectory.position_W[-1], atol=1e-9)
    np.testing.assert_allclose(track.trajectory.position_W[-1], streamed.p_W, atol=0.1)


def delayed(navigator: Navigator, walk: ImuSequence) -> list[SmoothedPose]:
    """Return the poses that a stream gives one window late."""
    poses: list[SmoothedPose] = []
    for row in samples(walk):
        pose = navigator.smoothed if navigator.push(*row) is not None else None
        if pose is not None and (not poses or pose.time > poses[-1].time):
            poses.append(pose)
    return poses


@pytest.mark.slow
def test_a_streams_smoothed_poses_are_one_window_late_and_better_than_its_states(walks, tracks):
    errors, nees = [], []
    for (walk, model), (_, track) in zip(walks, tracks, strict=True):
        poses = delayed(Navigator(model, CONFIG), walk)
        time = np.array([pose.time for pose in poses])
        np.testing.assert_allclose(np.diff(time), 1.0, atol=1e-9)
        assert time[-1] == pytest.approx(track.time[-1] - 1.0)
        at = np.searchsorted(track.time, time - 1e-6)
        P = np.array([pose.covariance[3:, 3:] for pose in poses])
        covariances = P, track.filtered.covariance[at, 6:9, 6:9]
        sigmas = [np.trace(each, axis1=1, axis2=2) for each in covariances]
        # The gains do not know the network's scale error, which the covariances contain.
        assert (sigmas[0][2:] <= 1.05 * sigmas[1][2:]).all()
        assert np.median(sigmas[0] / sigmas[1]) < 0.99
        attitude = Rotation.from_matrix([pose.R_WB for pose in poses])
        late = Trajectory(time, np.array([pose.p_W for pose in poses]), attitude)
        ours, theirs = errors_at(late, walk)[1:], errors_at(track.filtered.trajectory, walk)[at][1:]
        errors.append([np.square(e).sum(axis=1).mean() for e in (ours, theirs)])
        nees.append(np.einsum("ni,ni->n", ours, np.linalg.solve(P[1:], ours[..., None])[..., 0]))
    ours, theirs = np.mean(errors, axis=0)
    assert ours < theirs
    assert 1.4 < np.median(np.concatenate(nees)) < 3.4  # median of chi-square with 3 DoF: 2.4


def test_a_smoothed_pose_is_as_uncertain_of_its_yaw_as_the_state(make_walk, make_oracle):
    """One position places the track and leaves its yaw in the map unknown."""
    walk = make_walk(1, 8.0, 100.0, ERRORS)
    fix = position_fix(3.0, walk.truth.at(np.array([3.0])).position_W[0], 1e-3 * np.eye(3))
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG), CONFIG)
    for row in samples(walk):
        if row[0] == pytest.approx(3.5):
            navigator.update_position(fix.time, fix.value, fix.covariance)
            released = navigator.smoothed  # before the fix, and now in its frame
            assert released.map_frame == navigator.state.map_frame == 1
        navigator.push(*row)
    pose = navigator.smoothed
    yaw_variance = navigator.state.covariance[2, 2]
    assert yaw_variance > 3.0
    assert pose.covariance[2, 2] == pytest.approx(yaw_variance, rel=0.05)


def state_at(time: float, x: float, **parts: Any) -> NavState:
    v_W, p_W = np.array([[1.0, 0.0, 0.0], [time + x, 0.0, 0.0]])
    return nav_state(np.eye(15), time, v_W=v_W, p_W=p_W, **parts)


def test_a_step_is_bled_in_a_centimetre_at_a_time():
    pose = advanced(None, state_at(0.0, 0.0))
    remaining = []
    for k in range(1, 101):
        before, pose = pose, advanced(pose, state_at(0.1 * k, 0.5))
        assert abs(pose.p_W[0] - before.p_W[0] - 0.1) < MAX_STEP + 1e-12
        np.testing.assert_allclose(pose.p_W + pose.correction_W, state_at(0.1 * k, 0.5).p_W)
        remaining.append(pose.correction_W[0])
    assert (np.diff(remaining) < 0.0).all()
    assert remaining[-1] < 0.01


@pytest.mark.parametrize("changed", [{"map_frame": 1}, {"in_gap": True}])
def test_the_continuous_position_is_reset_where_fixes_move_the_frame_and_after_a_gap(changed):
    after = state_at(3.0, 5.0, **changed)
    pose = advanced(advanced(None, state_at(0.0, 0.0)), after)
    np.testing.assert_array_equal(pose.p_W, after.p_W)
    np.testing.assert_array_equal(pose.correction_W, np.zeros(3))


def test_corrections_cause_no_step_in_the_position(walk, make_oracle):
    """Noise of a quarter of a metre makes the corrected position step, not the continuous one."""
    navigator = Navigator(make_oracle(walk, walk.truth, PHONE, noise=0.25, sigma=0.25), PHONE)
    poses = [navigator.continuous for row in samples(walk) if navigator.push(*row) is not None]
    names = ("time", "p_W", "v_W", "correction_W")
    time, p_W, v_W, correction_W = (np.array([getattr(q, name) for q in poses]) for name in names)
    assert steps(time, p_W, v_W).max() < MAX_STEP + 1e-9
    assert steps(time, p_W + correction_W, v_W).max() > 2.0 * MAX_STEP
    assert np.linalg.norm(correction_W[-1]) < 0.5


def test_a_late_fix_that_moves_the_map_moves_the_continuous_position_at_once(walk, make_oracle):
    walk = walk.slice(0.0, 5.99)
    navigator = Navigator(make_oracle(walk, walk.truth, PHONE), PHONE)
    stream(navigator, walk)
    navigator.update_position(walk.time[590], [1e5, 5e6, 0.0], np.eye(3))
    assert navigator.continuous.map_frame == navigator.state.map_frame == 1
    np.testing.assert_allclose(navigator.continuous.p_W, navigator.state.p_W)


def test_returned_arrays_may_be_overwritten(walk, make_oracle):
    walk, ends = walk.slice(0.0, 5.0), []
    for overwrite in (False, True):
        navigator = Navigator(make_oracle(walk, walk.truth, PHONE), PHONE)
        for row in samples(walk):
            state = navigator.push(*row)
            if state is not None and overwrite:
                for returned in (state, navigator.continuous, navigator.state):
                    for value in vars(returned).values():
                        if isinstance(value, np.ndarray):
                            value *= 57.3
        ends.append((navigator.state.p_W, navigator.state.b_g, navigator.continuous.p_W))
    for clean, written in zip(*ends, strict=True):
        np.testing.assert_array_equal(clean, written)


def test_a_heading_that_the_field_alone_tells_is_not_lost(walks):
    walk, model = walks[0]
    noisy = replace(CONFIG, noise=replace(CONFIG.noise, gyro_noise=0.3))
    navigator = Navigator(model, noisy)
    alone = navigator.run(walk)
    assert alone.covariance[-1, 2, 2] > 1.0
    assert alone.health.notes == []
    magnetometer = simulate_magnetometer(walk.truth, MagneticField())
    track = navigator.run(replace(walk, magnetometer=magnetometer))
    assert track.covariance[-1, 2, 2] < 0.5
    assert any("heading" in note for note in track.health.notes)
