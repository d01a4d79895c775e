import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import GRAPH, swivelled

from stario.fusion import Navigator, NavigatorConfig
from stario.fusion.imu.buffers import FieldBuffer
from stario.fusion.imu.gap import INTERPOLATED, gap_rotation, yaw_variance
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.recording import cut_recording
from stario.sequences import PHONE_IMU, generate_walk, simulate_imu
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.sequence import ImuSequence, Magnetometer

RATE, BIAS = np.array([0.3, -0.2, 2.0]), np.array([0.01, 0.02, -0.03])


def ends(seconds: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.array([[5.0, *before, 0.0, 0.0, 0.0], [5.0 + seconds, *after, 0.0, 0.0, 0.0]])


def test_a_short_gap_is_turned_through_at_the_rates_of_its_ends():
    table = ends(0.4, RATE + BIAS, RATE + BIAS)
    expected = Rotation.from_rotvec(0.4 * RATE).as_matrix()
    np.testing.assert_allclose(gap_rotation(table, 0.4, BIAS), expected, atol=1e-9)
    about = ends(0.4, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 3.0]))
    turned = Rotation.from_matrix(gap_rotation(about, 0.4, np.zeros(3))).as_rotvec()
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.8], atol=1e-9)


def test_a_long_gap_keeps_the_attitude():
    length = INTERPOLATED + 0.1
    np.testing.assert_array_equal(gap_rotation(ends(length, RATE, RATE), length, BIAS), np.eye(3))


def gap_of(length: float, turn_rate: float) -> ImuInterval:
    """Return a gap before a second in which the device turns at a rate [rad/s]."""
    after = Start(np.eye(3), False, 9.81, turn_rate, time=length, rate=100.0)
    ends = np.zeros((2, 7))
    ends[1, 0] = length
    return ImuInterval(ends, np.eye(3), levelled=after)


@pytest.mark.parametrize("length", [0.3, 0.9, 3.0])
def test_the_yaw_is_ever_less_certain_until_it_is_unknown(length):
    gap = gap_of(length, 0.5)
    sigma = np.sqrt([yaw_variance(s, gap) for s in np.linspace(0.0, length, 20)])
    assert sigma[0] == 0.0
    assert (np.diff(sigma) > 0.0).all()
    assert yaw_variance(length, gap_of(length, 3.0)) > 1.4 * sigma[-1] ** 2
    unknown = yaw_variance(9.0, gap_of(9.0, 0.5))
    assert unknown == yaw_variance(9.0, gap_of(9.0, 3.0)) < np.pi**2


def test_the_yaw_is_kept_through_gaps_while_the_device_turns(make_walk, make_oracle, without):
    """A kept attitude would lose 20 degrees in each of these four gaps, and know as much."""
    walk = swivelled(make_walk(3, 32.0, 50.0), 1.0)
    gone = (walk.time > 10.0) & (walk.time < 28.0) & (walk.time % 5.0 < 0.35)
    holed = without(walk, gone)
    graph = Navigator(make_oracle(holed, walk.truth, GRAPH), GRAPH).run(holed)
    for track in (graph, graph.filtered):
        rows = [0, int(np.searchsorted(track.time, 29.5))]
        errors = yaw_of(track.trajectory.attitude_WB[rows])
        errors -= yaw_of(walk.truth.at(track.time[rows]).attitude_WB)
        off = abs(np.angle(np.exp(1j * (errors[1] - errors[0]))))
        sigma = np.sqrt(track.covariance[rows[1], 2, 2])
        assert off < np.radians(20.0)
        assert off < 3.0 * sigma
        assert 0.15 < sigma < 0.35


def test_the_network_sees_the_same_turn(make_walk, without):
    """The levelled frame, along which a network's displacements are chained, keeps its yaw."""
    walk = swivelled(make_walk(3, 20.0), 1.0)
    holed = without(walk, (walk.time > 10.0) & (walk.time < 10.4))
    intervals, _ = cut_recording(holed, GRAPH)
    (k,) = [k for k, each in enumerate(intervals) if each.gap]
    ends = np.array([intervals[k - 1].stop, intervals[k].stop])
    R_NB = Rotation.from_matrix([intervals[k - 1].R_NB, intervals[k].R_NB])
    turn = np.diff(yaw_of(R_NB)) - np.diff(yaw_of(walk.truth.at(ends).attitude_WB))
    assert np.abs(np.angle(np.exp(1j * turn)))[0] < np.radians(8.0)


def test_gravity_levels_a_recording_that_ends_soon_after_a_gap(make_walk, make_oracle, without):
    walk = make_walk(1, 19.2)
    holed = without(walk, (walk.time > 15.0) & (walk.time < 18.0))
    oracle = make_oracle(holed, walk.truth, GRAPH)
    graph = Navigator(oracle, GRAPH).run(holed)
    for track in (graph, graph.filtered):
        row = int(np.searchsorted(track.time, 18.05))
        true_WB = walk.truth.at(track.time[row : row + 1]).attitude_WB
        off = (track.trajectory.attitude_WB[row] * true_WB.inv()).apply([0.0, 0.0, 1.0])
        sigma = np.sqrt(np.diag(track.covariance[row])[:2])
        assert np.linalg.norm(off[:, :2]) < 3.0 * np.linalg.norm(sigma)
        assert (sigma < 0.06).all()


FIELD_B = np.array([20.0, 0.0, -40.0])


def noisy(k: int) -> np.ndarray:
    """Sample k of a sensor whose last digit changes."""
    return FIELD_B + 0.1 * (k % 2)


@pytest.fixture(scope="module")
def walk():
    sequence = simulate_imu(generate_walk(3, 20.0), 100.0, PHONE_IMU, 3)
    time = sequence.time[::4]
    field = np.array([noisy(k) for k in range(len(time))])
    return replace(sequence, magnetometer=Magnetometer(time, field))


def count_with_field(sequence: ImuSequence) -> int:
    intervals, _ = cut_recording(sequence, NavigatorConfig())
    return sum(interval.field_B is not None for interval in intervals)


def test_a_wild_sample_time_costs_at_most_one_interval_its_field(walk):
    time = walk.time.copy()
    time[1000] += 1e4
    assert count_with_field(replace(walk, time=time)) >= count_with_field(walk) - 1 > 150


@pytest.mark.parametrize("wild", [1e4, -1e4, math.nan])
def test_a_wild_field_time_costs_one_field(wild):
    buffer = FieldBuffer()
    for k in range(200):
        time = 0.02 * k
        buffer.add(time + wild if k == 100 else time, noisy(k), now=time)
        if k != 100:
            assert buffer.at(time) is not None


def test_a_block_of_fields_may_come_before_its_samples_and_what_does_not_fit_is_counted():
    buffer = FieldBuffer()
    kept = [buffer.add(0.01 * k, noisy(k), now=-0.01) for k in range(1200)]
    assert kept == [True] * 1000 + [False] * 200
    assert buffer.at(1.0) is None
    assert all(buffer.at(0.1 * k + 0.001) is not None for k in range(21, 119))


def test_a_field_too_late_for_any_interval_is_refused():
    buffer = FieldBuffer()
    assert buffer.add(1.0, FIELD_B, 1.0)
    assert buffer.at(1.5) is None
    assert not buffer.add(1.3, FIELD_B, 1.5)
    assert buffer.add(1.45, FIELD_B, 1.5)


def test_a_sensor_that_repeats_its_value_has_stopped():
    buffer = FieldBuffer()
    used = [buffer.add(0.1 * k, FIELD_B, now=0.1 * k) for k in range(20)]
    assert used == [True] * 6 + [False] * 14  # slow sensors are logged several times
    assert buffer.add(2.0, noisy(1), now=2.0)


@pytest.mark.parametrize(("seconds", "calibrated"), [(0.01, True), (0.5, False)])
def test_only_a_sensor_changes_a_field_within_a_sample(seconds, calibrated):
    """A magnet that comes near takes as long as a hand."""
    buffer, told = FieldBuffer(), []
    for k in range(200):
        time = 0.02 * k
        buffer.add(time, noisy(k) + 60.0 * np.clip((time - 2.0) / seconds, 0.0, 1.0), now=time)
        told.append(buffer.calibrated(time))
    assert sum(told) == calibrated
