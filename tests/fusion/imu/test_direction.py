from dataclasses import replace

import numpy as np
import pytest

from stario.fusion.imu.direction import Direction, direction, weighted_force
from stario.sequences import PHONE_IMU, generate_walk, simulate_imu
from stario.sequences.levelled_stream import TICK_SAMPLES, TICKS_PER_SECOND, levelled_streams
from stario.sequences.simulation.imu import PERFECT_IMU
from stario.sequences.windows import WINDOW_SAMPLES


def compared(stream, displacement) -> Direction:
    return direction(weighted_force(stream.windows()), displacement, TICKS_PER_SECOND)


@pytest.fixture(scope="module")
def stream_and_truth():
    """Levelled stream of a simulated walk, and its true displacements in the stream's frame N."""
    sequence = simulate_imu(generate_walk(3, 90.0), 200.0, PHONE_IMU, 3)
    (stream,) = levelled_streams(sequence)
    truth = sequence.truth
    starts = stream.start + TICK_SAMPLES / 200.0 * np.arange(stream.window_count)
    begin, end = (truth.at(t) for t in (starts, starts + WINDOW_SAMPLES / 200.0))
    R_WN = begin.attitude_WB[0].as_matrix() @ stream.R_NB[0].T
    return stream, (end.position_W - begin.position_W) @ R_WN


def test_true_displacements_agree_in_direction_with_the_accelerometer(stream_and_truth):
    found = compared(*stream_and_truth)
    assert abs(found.turn) < 3.0 * found.sigma < np.radians(45.0)


def test_with_an_exact_attitude_both_directions_agree_exactly():
    """The accelerometer's changes of velocity are those of the displacements."""
    sequence = simulate_imu(generate_walk(3, 30.0), 200.0, PERFECT_IMU)
    (stream,) = levelled_streams(sequence)
    force_W = sequence.truth.attitude_WB.apply(sequence.accel)[: len(stream)]
    exact = replace(stream, imu_N=np.concatenate([stream.imu_N[:, :3], force_W], axis=1))
    starts = stream.ticks[: stream.window_count]
    first, last = (sequence.truth.at(t).position_W for t in (starts, starts + 1.0))
    found = compared(exact, last - first)
    assert abs(found.turn) < 2e-3
    assert found.sigma < 2e-3
    assert abs(found.product) / found.network == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("degrees", [-120.0, 45.0, 180.0])
def test_the_rotation_of_rotated_displacements_is_found(stream_and_truth, degrees):
    stream, displacement = stream_and_truth
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotated = displacement @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    rotated_back = np.exp(1j * (compared(stream, rotated).turn + np.radians(degrees)))
    assert np.angle(rotated_back) == pytest.approx(compared(*stream_and_truth).turn, abs=1e-9)


def test_changes_of_velocity_over_three_seconds_count_once_in_that_time(stream_and_truth):
    assert compared(*stream_and_truth).count == pytest.approx(90.0 / 3.0, abs=1.5)


def test_the_direction_of_noise_has_a_large_sigma(stream_and_truth):
    stream, displacement = stream_and_truth
    noise = np.random.default_rng(0).normal(size=displacement.shape)
    assert compared(stream, noise).sigma > 3.0 * compared(*stream_and_truth).sigma


def test_directions_of_stretches_add_up_and_an_empty_one_is_undefined(stream_and_truth):
    stream, displacement = stream_and_truth
    once = compared(stream, displacement)
    twice = once + once
    assert twice.turn == pytest.approx(once.turn)
    assert twice.sigma == pytest.approx(once.sigma / 2**0.5)
    assert np.isnan(Direction().turn)
    assert Direction().sigma == np.pi
