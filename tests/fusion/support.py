from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, NavState, PriorPose, Track
from stario.sequences.accuracy.metrics import Alignment, evaluate_track
from stario.sequences.attitude.rotations import about_z
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence
from stario.sequences.simulation.imu import ImuErrors

# Settings for the oracle and the simulated phone; the defaults are for networks and real phones.
FILTER = FilterConfig(
    update_rate=10,
    covariance_scale=1.0,
    gyro_bias_sigma=3e-3,
    accel_bias_sigma=0.05,
    correlated_errors=False,
)
NOISE = ImuNoise(gyro_noise=2e-3, accel_noise=0.1, gyro_walk=3e-5, accel_walk=1e-3)
CONFIG = NavigatorConfig(NOISE, FILTER)
GRAPH = NavigatorConfig(NOISE, replace(FILTER, update_rate=2))

# An IMU of known white errors and a filter that takes them as they are, updated once a second.
WHITE_NOISE = ImuNoise(gyro_noise=1e-3, accel_noise=0.02, gyro_walk=3e-5, accel_walk=1e-3)
WHITE_ERRORS = ImuErrors(noise=WHITE_NOISE, gyro_turn_on=3e-3, accel_turn_on=0.05)
WHITE = NavigatorConfig(WHITE_NOISE, replace(FILTER, update_rate=1))


def samples(sequence: ImuSequence) -> Iterator[tuple[float, Any, Any]]:
    return zip(sequence.time, sequence.gyro, sequence.accel, strict=True)


def stream(navigator: Navigator, sequence: ImuSequence) -> list[NavState]:
    """States of a stream of the IMU's samples and, at their times, of the magnetometer's."""
    states, fields = [], sequence.magnetometer
    waiting = list(zip(fields.time.tolist(), fields.field, strict=True)) if fields else []
    for row in samples(sequence):
        while waiting and waiting[0][0] <= row[0]:
            navigator.push_magnetometer(*waiting.pop(0))
        states.append(navigator.push(*row))
    return [state for state in states if state is not None]


def nav_state(covariance: np.ndarray, time: float = 0.0, **parts: Any) -> NavState:
    """A level state at the origin and at rest, but for the given parts."""
    zero = np.zeros(3)
    state = NavState(time, np.eye(3), zero, zero, zero, zero, covariance)
    return replace(state, **parts)


def lying(
    seconds: float,
    rate: float = 100.0,
    gyro: ArrayLike = (0.0, 0.0, 0.0),
    gyro_noise: float = 0.0,
    accel_noise: float = 0.0,
) -> ImuSequence:
    """A phone on a table whose gyroscope shows a rate, with noise of its samples."""
    rng, count = np.random.default_rng(0), round(seconds * rate) + 1
    noise = rng.standard_normal((2, count, 3))
    force = np.array([0.0, 0.0, STANDARD_GRAVITY]) + accel_noise * noise[1]
    return ImuSequence("lying", np.arange(count) / rate, gyro + gyro_noise * noise[0], force)


def true_start(walk: ImuSequence) -> PriorPose:
    truth = walk.truth
    return PriorPose(truth.attitude_WB[0].as_matrix(), truth.velocity_W[0], truth.position_W[0])


def stream_deviation(states: list[NavState], track: Track) -> float:
    """Maximum distance [m] between a stream's states and the track, at the stream's times."""
    rows = np.searchsorted(track.time, [s.time for s in states])
    np.testing.assert_array_equal(track.time[rows], [s.time for s in states])
    position = np.array([s.p_W for s in states])
    return float(np.linalg.norm(track.trajectory.position_W[rows] - position, axis=1).max())


def ate(track: Track, sequence: ImuSequence, alignment: Alignment = "first") -> float:
    return evaluate_track(track.trajectory, sequence.truth, alignment=alignment).ate_m


class Altered:
    """A network whose predictions a function changes in place, given their numbers."""

    def __init__(self, inner: Any, change: Callable[..., object]) -> None:
        self.inner, self.change, self.count = inner, change, 0

    def predict(self, windows):
        mean, covariance = self.inner.predict(windows)
        self.change(np.arange(self.count, self.count + len(mean)), mean, covariance)
        self.count += len(mean)
        return mean, covariance


def broken(inner: Any, mean: float, variance: float) -> Altered:
    """Adds an error in x to every third prediction and replaces its variance."""

    def change(number, means, covariances):
        third = number % 3 == 2
        means[third, 0] += mean
        covariances[third, 0, 0] = variance

    return Altered(inner, change)


def off_by_a_metre(inner: Any, first: int, stop: int) -> Altered:
    """Adds a metre in x to the predictions number `first` to `stop` - 1."""

    def change(number, means, covariances):
        means[(number >= first) & (number < stop), 0] += 1.0

    return Altered(inner, change)


class Counting:
    """A recurrent network: a metre upwards per window in its memory, by default of each series."""

    is_recurrent = True

    def __init__(self, series: int | None = None) -> None:
        self.series = series

    def predict(self, windows):
        raise AssertionError("a network with memory must be called through `predict_next`")

    def predict_next(self, windows, updates, memory):
        first, n = memory or 0, len(windows)
        mean = np.zeros((n, 3))
        mean[:, 2] = (first + np.arange(n)) // (self.series or updates)
        return mean, np.tile(np.eye(3), (n, 1, 1)), first + n


def swivelled(walk: ImuSequence, rate: float) -> ImuSequence:
    """Return a walk whose device also turns about the vertical, at a rate [rad/s]."""
    before = walk.truth.at(walk.time).attitude_WB
    after = about_z(rate * walk.time) * before
    gyro = walk.gyro + before.inv().apply([0.0, 0.0, rate])
    attitude_WB = about_z(rate * walk.truth.time) * walk.truth.attitude_WB
    truth = replace(walk.truth, attitude_WB=attitude_WB)
    accel = after.inv().apply(before.apply(walk.accel))
    return replace(walk, gyro=gyro, accel=accel, truth=truth)
