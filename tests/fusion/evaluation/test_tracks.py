"""Tracks without a filter: the IMU alone, and chained displacements."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.evaluation.tracks import (
    inertial_track,
    network_track,
    network_track_true_attitude,
    true_poses,
)
from stario.fusion.navigator import Navigator
from stario.sequences.accuracy.metrics import align, pose_errors
from stario.sequences.attitude.rotations import about_z
from stario.sequences.clean_samples import clean_samples
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, PositionTrack, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_SECONDS, headings_at, imu_in_world

CONFIG = NavigatorConfig(filter=FilterConfig(update_rate=10, covariance_scale=1.0))

Make = Callable[..., Any]


class TrueAttitudeOracle:
    """True displacements of the true-attitude track's windows, in order at ten per second."""

    def __init__(self, sequence: ImuSequence) -> None:
        self.truth, self.start = sequence.truth, clean_samples(sequence)[0][0]
        self.facing = imu_in_world(sequence, sequence.truth, "true").facing

    def predict(self, windows):
        n = len(windows)
        time = self.start + 0.1 * np.arange(n)
        first, last = self.truth.at(time), self.truth.at(time + WINDOW_SECONDS)
        heading = headings_at(self.facing, 20 * np.arange(n))
        moved = about_z(-heading).apply(last.position_W - first.position_W)
        return moved, np.tile(1e-4 * np.eye(3), (n, 1, 1))


def horizontal_errors(trajectory, sequence: ImuSequence) -> np.ndarray:
    errors = pose_errors(align(trajectory, sequence.truth, "first"), sequence.truth)
    return np.linalg.norm(errors.position_W[:, :2], axis=1)


@pytest.fixture(scope="module")
def from_rest() -> ImuSequence:
    """A perfect IMU on a walk that begins at rest, since time along it is slowed to a stop."""
    walk = generate_walk(2, 12.0, style=WalkStyle(carry="handheld", mount_rotvec=(0.4, -0.7, 1.1)))
    time = np.arange(0.0, 12.0, 0.005)
    share = np.clip((time - 1.3) / 2.0, 0.0, 1.0)
    pace = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    warped = walk.at(0.01 + np.cumsum(pace) * 0.005 + 1e-9 * np.arange(len(time)))
    position = make_interp_spline(walk.time, walk.position_W, 5)(warped.time)
    return simulate_imu(Trajectory(time, position, warped.attitude_WB), 200.0, PERFECT_IMU)


def test_the_inertial_track_is_strapdown_from_rest(
    from_rest: ImuSequence, still_model: Any
) -> None:
    track = inertial_track(Navigator(still_model).observe(from_rest), CONFIG)
    aligned = align(track.trajectory, from_rest.truth, "first")
    errors = pose_errors(aligned, from_rest.truth)
    assert from_rest.truth.path_length() > 5.0
    assert np.linalg.norm(errors.position_W, axis=1).max() < 0.05
    turn = errors.estimate.attitude_WB * errors.truth.attitude_WB.inv()
    assert turn.magnitude().max() < 1e-3


def test_chained_displacements_follow_the_truth_within_40_centimetres(
    make_walk: Make, make_oracle: Make
) -> None:
    """The remaining error is due to the mean over a second, which cuts corners."""
    walk = make_walk(5, 30.0, 200.0, PERFECT_IMU)
    preprocessed = Navigator(make_oracle(walk, walk.truth, CONFIG)).observe(walk)
    errors = horizontal_errors(network_track(preprocessed).trajectory, walk)
    assert np.median(errors) < 0.15
    assert errors.max() < 0.4


def test_chained_displacements_with_true_attitude_follow_the_truth(make_walk: Make) -> None:
    walk = make_walk(5, 30.0, 200.0, PERFECT_IMU)
    track = network_track_true_attitude(TrueAttitudeOracle(walk), walk, CONFIG)
    errors = horizontal_errors(track.trajectory, walk)
    # The first half second has the first window's mean speed; its error persists.
    assert np.median(errors) < 0.1
    steps = np.diff(track.trajectory.position_W[::10], axis=0)
    true = np.diff(walk.truth.at(track.time[::10]).position_W, axis=0)
    assert np.linalg.norm(steps - true, axis=1)[1:-1].mean() < 0.05


def test_the_track_with_true_attitude_requires_truth(walk: ImuSequence, still_model: Any) -> None:
    with pytest.raises(InputError, match="truth"):
        network_track_true_attitude(still_model, walk.without_truth(), CONFIG)
    short_truth = replace(walk, truth=walk.truth.slice(3.0, 3.5))
    with pytest.raises(InputError, match="no second without gaps"):
        network_track_true_attitude(still_model, short_truth, CONFIG)


def test_gaps_in_the_truth_are_bridged_by_the_gyroscope(make_walk: Make) -> None:
    walk = make_walk(5, 30.0, 200.0, PERFECT_IMU)
    valid = (walk.truth.time < 8.0) | (walk.truth.time > 14.0)
    with_gap = replace(walk, truth=replace(walk.truth, valid=valid))
    recorded: list[Any] = []

    class Recorder:
        def predict(self, windows: Any) -> Any:
            recorded.append(windows)
            return np.zeros((len(windows), 3)), np.tile(np.eye(3), (len(windows), 1, 1))

    tracks = [network_track_true_attitude(Recorder(), w, CONFIG) for w in (walk, with_gap)]
    np.testing.assert_allclose(tracks[1].time, tracks[0].time)
    assert np.abs(recorded[1] - recorded[0]).max() < 0.02
    turn = tracks[1].trajectory.attitude_WB * tracks[0].trajectory.attitude_WB.inv()
    assert turn.magnitude().max() < 2e-3


class Counting:
    """A recurrent network that predicts how many windows of a stretch it has seen [m]."""

    def __init__(self, seen: int = 0) -> None:
        self.seen = seen

    def stateful_inference(self, updates: int) -> "Counting":
        return Counting()

    def predict(self, windows: Any) -> Any:
        seen, self.seen = self.seen, self.seen + len(windows)
        mean = np.zeros((len(windows), 3))
        mean[:, 2] = seen + np.arange(len(windows))
        return mean, np.tile(np.eye(3), (len(windows), 1, 1))


def test_the_memory_of_a_network_ends_at_a_gap(walk: ImuSequence, without: Make) -> None:
    gaps = [(walk.time > 8.0) & (walk.time < stop) for stop in (8.0, 8.2, 10.0)]
    longest = [
        network_track_true_attitude(Counting(), sequence, CONFIG).trajectory.velocity_W[:, 2].max()
        for sequence in (without(walk, gone) for gone in gaps)
    ]
    assert longest == pytest.approx([190.0, 108.0, 90.0], abs=2.0)  # ten windows a second


def test_tracks_without_a_filter_have_no_covariance(walk: ImuSequence, still_model: Any) -> None:
    preprocessed = Navigator(still_model).observe(walk)
    for track in (inertial_track(preprocessed), network_track(preprocessed)):
        assert track.covariance is None
        assert track.nis is None
        assert set(track.arrays()) == {
            "time", "position_W", "quat_xyzw_WB", "velocity_W", "valid",
        }  # fmt: skip


def test_every_track_continues_across_gaps_in_the_imu_data(
    walk: ImuSequence, make_oracle: Make, without: Make
) -> None:
    with_gap = without(walk, (walk.time > 8.0) & (walk.time < 10.0))
    preprocessed = Navigator(make_oracle(with_gap, walk.truth, CONFIG)).observe(with_gap)
    for track in (inertial_track(preprocessed, CONFIG), network_track(preprocessed)):
        assert np.isfinite(track.trajectory.position_W).all()
        assert (np.diff(track.time) > 0).all()
        assert track.time[-1] > 19.9
    inertial = inertial_track(preprocessed, CONFIG).trajectory
    k = int(np.argmax(np.diff(inertial.time)))
    moved = inertial.position_W[k + 1] - inertial.position_W[k]
    np.testing.assert_allclose(moved, 2.0 * inertial.velocity_W[k], rtol=0.02)


def test_a_recording_without_poses_is_refused_by_what_it_has() -> None:
    walk = simulate_imu(generate_walk(0, 5.0), 100.0, PERFECT_IMU, 0)
    waypoints = PositionTrack(np.array([1.0, 2.0, 3.0]), np.zeros((3, 2)), "waypoints")
    with pytest.raises(InputError, match="truth: found 3 waypoints, no poses, expected"):
        true_poses(replace(walk.without_truth(), positions=waypoints))
