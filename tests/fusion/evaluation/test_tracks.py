from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import DATA
from scipy.interpolate import make_interp_spline
from support import Counting

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, inertial_track, network_track
from stario.fusion.evaluation.pedestrian import (
    WEINBERG_CONSTANT,
    pedestrian_path,
    pedestrian_track,
    steps_of,
)
from stario.fusion.evaluation.tracks import network_track_true_attitude
from stario.sequences.accuracy.metrics import align, evaluate_track, pose_errors
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.clean_samples import clean_samples
from stario.sequences.errors import InputError
from stario.sequences.levelled_stream import TICK_SAMPLES, LevelledStream
from stario.sequences.readers import read_recording
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_RATE, WINDOW_SECONDS, headings_at, imu_in_world

CONFIG = NavigatorConfig(filter=FilterConfig(update_rate=10, covariance_scale=1.0))


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
def from_rest():
    """A perfect IMU on a walk that begins at rest, since time along it is slowed to a stop."""
    walk = generate_walk(2, 12.0, style=WalkStyle(carry="handheld", mount_rotvec=(0.4, -0.7, 1.1)))
    time = np.arange(0.0, 12.0, 0.005)
    share = np.clip((time - 1.3) / 2.0, 0.0, 1.0)
    pace = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    warped = walk.at(0.01 + np.cumsum(pace) * 0.005 + 1e-9 * np.arange(len(time)))
    position = make_interp_spline(walk.time, walk.position_W, 5)(warped.time)
    return simulate_imu(Trajectory(time, position, warped.attitude_WB), 200.0, PERFECT_IMU)


def test_the_inertial_track_is_strapdown_from_rest(from_rest, still_model):
    track = inertial_track(Navigator(still_model).observe(from_rest), CONFIG)
    aligned = align(track.trajectory, from_rest.truth, "first")
    errors = pose_errors(aligned, from_rest.truth)
    assert from_rest.truth.path_length() > 5.0
    assert np.linalg.norm(errors.position_W, axis=1).max() < 0.05
    turn = errors.estimate.attitude_WB * errors.truth.attitude_WB.inv()
    assert turn.magnitude().max() < 1e-3


def test_chained_displacements_follow_the_truth_within_40_centimetres(make_walk, make_oracle):
    """The remaining error is due to the mean over a second, which cuts corners."""
    walk = make_walk(5, 30.0, 200.0, PERFECT_IMU)
    preprocessed = Navigator(make_oracle(walk, walk.truth, CONFIG)).observe(walk)
    errors = horizontal_errors(network_track(preprocessed).trajectory, walk)
    assert np.median(errors) < 0.15
    assert errors.max() < 0.4


def test_chained_displacements_with_true_attitude_follow_the_truth(make_walk):
    walk = make_walk(5, 30.0, 200.0, PERFECT_IMU)
    track = network_track_true_attitude(TrueAttitudeOracle(walk), walk, CONFIG)
    errors = horizontal_errors(track.trajectory, walk)
    # The first half second has the first window's mean speed; its error persists.
    assert np.median(errors) < 0.1
    steps = np.diff(track.trajectory.position_W[::10], axis=0)
    true = np.diff(walk.truth.at(track.time[::10]).position_W, axis=0)
    assert np.linalg.norm(steps - true, axis=1)[1:-1].mean() < 0.05


def test_the_track_with_true_attitude_requires_truth(walk, still_model):
    with pytest.raises(InputError, match="truth"):
        network_track_true_attitude(still_model, walk.without_truth(), CONFIG)
    short_truth = replace(walk, truth=walk.truth.slice(3.0, 3.5))
    with pytest.raises(InputError, match="gaps"):
        network_track_true_attitude(still_model, short_truth, CONFIG)


def test_gaps_in_the_truth_are_bridged_by_the_gyroscope(make_walk):
    walk = make_walk(5, 30.0, 200.0, PERFECT_IMU)
    valid = (walk.truth.time < 8.0) | (walk.truth.time > 14.0)
    with_gap = replace(walk, truth=replace(walk.truth, valid=valid))
    recorded = []

    class Recorder:
        def predict(self, windows):
            recorded.append(windows)
            return np.zeros((len(windows), 3)), np.tile(np.eye(3), (len(windows), 1, 1))

    tracks = [network_track_true_attitude(Recorder(), w, CONFIG) for w in (walk, with_gap)]
    np.testing.assert_allclose(tracks[1].time, tracks[0].time)
    assert np.abs(recorded[1] - recorded[0]).max() < 0.02
    turn = tracks[1].trajectory.attitude_WB * tracks[0].trajectory.attitude_WB.inv()
    assert turn.magnitude().max() < 2e-3


def test_the_memory_of_a_network_ends_at_a_gap(walk, without):
    gaps = [(walk.time > 8.0) & (walk.time < stop) for stop in (8.0, 8.2, 10.0)]
    longest = [
        network_track_true_attitude(Counting(1), sequence, CONFIG).trajectory.velocity_W[:, 2].max()
        for sequence in (without(walk, gone) for gone in gaps)
    ]
    assert longest == pytest.approx([190.0, 108.0, 90.0], abs=2.0)  # ten windows a second


def test_every_track_continues_across_gaps_in_the_imu_data(walk, make_oracle, without):
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


RIDI = DATA / "archives/ridi.h5"
RATE, SIZE = 1.8, 2.0


def walking_stream(course: np.ndarray, mount: float = 0.0) -> LevelledStream:
    """Return a stream at 200 Hz of steps at 1.8 Hz, 4 m/s^2 from crest to trough.

    The acceleration along the course lags by a quarter of a step, as in real walking.

    Args:
        course: (N,) direction of walking [rad].
        mount: yaw of the device relative to the course [rad].
    """
    time = np.arange(len(course)) / WINDOW_RATE
    phase = 2.0 * np.pi * RATE * time
    imu = np.zeros((len(course), 6), np.float32)
    imu[:, 3] = -np.sin(phase) * np.cos(course)
    imu[:, 4] = -np.sin(phase) * np.sin(course)
    imu[:, 5] = STANDARD_GRAVITY + SIZE * np.cos(phase)
    heading = course + mount
    facing = np.stack([np.cos(heading), np.sin(heading)], axis=1).astype(np.float32)
    return LevelledStream(0.0, imu, facing, about_z(heading[::TICK_SAMPLES]).as_matrix())


@pytest.mark.parametrize(("course", "mount"), [(0.0, 3.0), (2.0, 0.0), (-2.5, 1.3)])
def test_straight_steps_add_up_to_a_straight_path(course, mount):
    stream = walking_stream(np.full(6000, course), mount)
    _, ends, displacements = steps_of(stream)
    lengths = np.abs(displacements)
    assert len(ends) == pytest.approx(30.0 * RATE, abs=2)
    np.testing.assert_allclose(lengths[3:-3], WEINBERG_CONSTANT * (2.0 * SIZE) ** 0.25, rtol=0.02)
    end = pedestrian_path(stream)[-1]
    assert np.angle(end * np.exp(-1j * course)) == pytest.approx(0.0, abs=0.03)
    assert abs(end) == pytest.approx(lengths.sum(), rel=0.01)


def test_a_turn_is_followed_by_the_heading_of_the_device():
    course = np.where(np.arange(8000) < 4000, 0.0, np.pi / 2.0)
    path = pedestrian_path(walking_stream(course, mount=-0.7))
    for part, direction in ((path[:3800], 1.0), (path[4200:], 1j)):
        moved = (part[-1] - part[0]) / direction
        assert np.angle(moved) == pytest.approx(0.0, abs=0.1)
        assert moved.real > 15.0


def test_a_standing_pedestrian_does_not_move():
    stream = walking_stream(np.zeros(4000))
    rng = np.random.default_rng(0)
    still = 0.05 * rng.standard_normal(stream.imu_N.shape).astype(np.float32)
    still[:, 5] += STANDARD_GRAVITY
    assert np.abs(pedestrian_path(replace(stream, imu_N=still))).max() == 0.0


@pytest.mark.skipif(not RIDI.exists(), reason=f"no recordings at {RIDI}")
def test_a_real_walk_is_reproduced_within_4_percent_of_its_length():
    sequence = read_recording(Path(f"{RIDI}:hang_body_normal1"))
    assert sequence.truth is not None
    found = evaluate_track(pedestrian_track(sequence).trajectory, sequence.truth, alignment="yaw")
    assert found.ate_m < 0.04 * found.path_m


def test_position_and_heading_are_kept_across_a_gap():
    time = np.arange(0.0, 40.0, 0.01)
    rate = np.where((time > 10.0) & (time < 12.0), 0.25 * np.pi, 0.0)
    phase = 2.0 * np.pi * RATE * time
    accel = np.stack([-np.sin(phase), 0.0 * phase, STANDARD_GRAVITY + SIZE * np.cos(phase)], axis=1)
    gyro = np.stack([0.0 * rate, 0.0 * rate, rate], axis=1)
    kept = (time < 19.0) | (time > 23.0)
    track = pedestrian_track(ImuSequence("g", time[kept], gyro[kept], accel[kept])).trajectory
    for start, stop in ((14.0, 18.0), (25.0, 39.0)):
        inside = (track.time > start) & (track.time < stop)
        moved = np.ptp(track.position_W[inside], axis=0)
        assert moved[1] > 0.7 * (stop - start)
        assert moved[0] < 0.2 * moved[1]
        np.testing.assert_allclose(yaw_of(track.attitude_WB[inside]), 0.5 * np.pi, atol=0.05)
    before, after = track.position_W[track.time < 19.0][-1], track.position_W[track.time > 23.0][0]
    assert np.linalg.norm(after - before) < 1.0
