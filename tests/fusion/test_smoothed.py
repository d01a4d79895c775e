"""The EKF's poses one window late: more accurate than the filter's, and consistent."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from stario.fusion import Navigator, NavigatorConfig, Track
from stario.fusion.config import FilterConfig
from stario.fusion.fixes import position_fix
from stario.sequences.accuracy.metrics import align, pose_errors
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import ImuSequence, Trajectory
from stario.sequences.simulation.imu import ImuErrors

NOISE = ImuNoise(gyro_noise=1e-3, accel_noise=0.02, gyro_walk=3e-5, accel_walk=1e-3)
ERRORS = ImuErrors(noise=NOISE, gyro_turn_on=3e-3, accel_turn_on=0.05)
CONFIG = NavigatorConfig(
    NOISE,
    FilterConfig(
        update_rate=1,
        covariance_scale=1.0,
        gyro_bias_sigma=3e-3,
        accel_bias_sigma=0.05,
        correlated_errors=False,
    ),
)

Make = Callable[..., Any]


def errors_at(track: Trajectory, walk: ImuSequence) -> np.ndarray:
    return pose_errors(align(track, walk.truth, "first"), walk.truth).position_W


@pytest.fixture(scope="module")
def tracks(make_walk: Make, make_oracle: Make) -> list[tuple[ImuSequence, Track]]:
    made = []
    for seed in range(5):
        walk = make_walk(seed, 25.0, 100.0, ERRORS)
        oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1, seed=seed)
        made.append((walk, Navigator(oracle, CONFIG).run(walk)))
    return made


def test_smoothed_poses_are_one_window_late_and_more_certain_than_the_filters(
    tracks: list[tuple[ImuSequence, Track]],
) -> None:
    for _, track in tracks:
        np.testing.assert_allclose(np.diff(track.smoothed.time), 1.0, atol=1e-9)
        assert track.smoothed.time[-1] == pytest.approx(track.time[-1] - 1.0)
        at = np.searchsorted(track.time, track.smoothed.time - 1e-6)
        filtered = np.trace(track.covariance[at, 6:9, 6:9], axis1=1, axis2=2)
        smoothed = np.trace(track.smoothed.position_covariance_W, axis1=1, axis2=2)
        # The gains do not know the network's scale error, which the covariances contain.
        assert (smoothed[2:] <= 1.05 * filtered[2:]).all()
        assert np.median(smoothed / filtered) < 0.99


def test_smoothed_poses_are_more_accurate_than_the_filters_and_consistent(
    tracks: list[tuple[ImuSequence, Track]],
) -> None:
    filtered, smoothed, nees = [], [], []
    for walk, track in tracks:
        at = np.searchsorted(track.time, track.smoothed.time - 1e-6)[1:]
        error = errors_at(track.smoothed, walk)[1:]
        filtered.append(np.square(errors_at(track.trajectory, walk)[at]).sum(axis=1).mean())
        smoothed.append(np.square(error).sum(axis=1).mean())
        P = track.smoothed.position_covariance_W[1:]
        nees.append(np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0]))
    assert np.mean(smoothed) < np.mean(filtered)
    assert 1.4 < np.median(np.concatenate(nees)) < 3.4  # median of chi-square with 3 DoF: 2.4


def test_a_stream_gives_the_same_poses_as_a_batch(make_walk: Make, make_oracle: Make) -> None:
    walk = make_walk(1, 15.0, 100.0, ERRORS)
    model = make_oracle(walk, walk.truth, CONFIG)
    position = walk.truth.at(np.array([3.0, 11.0])).position_W
    fixes = [
        position_fix(t, p, 1e-3 * np.eye(3)) for t, p in zip((3.0, 11.0), position, strict=True)
    ]
    track, navigator = Navigator(model, CONFIG).run(walk, fixes=fixes), Navigator(model, CONFIG)
    for fix in fixes:
        navigator.update_position(fix.time, fix.value, fix.covariance)
    poses: list[Any] = []
    for row in zip(walk.time, walk.gyro, walk.accel, strict=True):
        navigator.push(*row)
        pose = navigator.smoothed
        if pose is not None and (not poses or pose.time > poses[-1].time):
            poses.append(pose)
    assert [pose.time for pose in poses] == pytest.approx(list(track.smoothed.time))
    last = [pose.map_frame == poses[-1].map_frame for pose in poses]
    ours = np.array([pose.p_W for pose in poses])[last]
    np.testing.assert_allclose(ours, track.smoothed.position_W[last], atol=1e-9)
    covariances = np.array([pose.covariance[3:, 3:] for pose in poses])[last]
    expected = track.smoothed.position_covariance_W[last]
    np.testing.assert_allclose(covariances, expected, rtol=1e-6, atol=1e-10)
    truth = walk.truth.at(track.smoothed.time)
    assert np.linalg.norm(truth.position_W - track.smoothed.position_W, axis=1).max() < 1.0


def test_a_smoothed_pose_of_unknown_direction_is_as_uncertain_as_the_newest_state(
    make_walk: Make, make_oracle: Make
) -> None:
    """One position places the track and leaves its yaw in the map unknown."""
    walk = make_walk(1, 8.0, 100.0, ERRORS)
    fix = position_fix(3.0, walk.truth.at(np.array([3.0])).position_W[0], 1e-3 * np.eye(3))
    model = make_oracle(walk, walk.truth, CONFIG)
    track, navigator = Navigator(model, CONFIG).run(walk, fixes=[fix]), Navigator(model, CONFIG)
    for row in zip(walk.time, walk.gyro, walk.accel, strict=True):
        if row[0] == pytest.approx(3.5):
            navigator.update_position(fix.time, fix.value, fix.covariance)
            released = navigator.smoothed  # before the fix, and now in its frame
            assert released.map_frame == navigator.state.map_frame == 1
        navigator.push(*row)
    pose = navigator.smoothed
    yaw_variance = navigator.state.covariance[2, 2]
    assert yaw_variance > 3.0
    assert pose.covariance[2, 2] == pytest.approx(yaw_variance, rel=0.05)
    expected = track.smoothed.position_covariance_W[-1]
    np.testing.assert_allclose(pose.covariance[3:, 3:], expected, rtol=1e-9)
