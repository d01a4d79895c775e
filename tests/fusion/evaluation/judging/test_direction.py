import numpy as np
import pytest

from stario.fusion.evaluation.judging.direction import Direction, direction
from stario.sequences import PHONE_IMU, generate_walk, simulate_imu
from stario.sequences.levelled_stream import TICK_SAMPLES, levelled_streams
from stario.sequences.windows import WINDOW_SAMPLES


@pytest.fixture(scope="module")
def walked():
    """A simulated walk's levelled stream, and its true displacements in the stream's frame N."""
    sequence = simulate_imu(generate_walk(3, 90.0), 200.0, PHONE_IMU, 3)
    (stream,) = levelled_streams(sequence)
    truth = sequence.truth
    starts = stream.start + TICK_SAMPLES / 200.0 * np.arange(stream.window_count)
    begin, end = (truth.at(t) for t in (starts, starts + WINDOW_SAMPLES / 200.0))
    R_WN = begin.attitude_WB[0].as_matrix() @ stream.R_NB[0].T
    return stream, (end.position_W - begin.position_W) @ R_WN


def test_true_displacements_go_where_the_accelerometer_says(walked):
    found = direction(*walked)
    assert abs(found.turn) < 3.0 * found.sigma < np.radians(45.0)


@pytest.mark.parametrize("degrees", [-120.0, 45.0, 180.0])
def test_turned_displacements_are_told_their_turn(walked, degrees):
    stream, displacement = walked
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turned = displacement @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    away = np.exp(1j * (direction(stream, turned).turn + np.radians(degrees)))
    assert np.angle(away) == pytest.approx(direction(*walked).turn, abs=1e-9)


def test_noise_has_no_direction_and_says_so(walked):
    stream, displacement = walked
    noise = np.random.default_rng(0).normal(size=displacement.shape)
    assert direction(stream, noise).sigma > 3.0 * direction(*walked).sigma


def test_stretches_add_up_and_nothing_has_no_direction(walked):
    stream, displacement = walked
    once = direction(stream, displacement)
    twice = once + once
    assert twice.turn == pytest.approx(once.turn)
    assert twice.sigma == pytest.approx(once.sigma / 2**0.5)
    assert np.isnan(Direction().turn)
    assert Direction().sigma == np.pi
