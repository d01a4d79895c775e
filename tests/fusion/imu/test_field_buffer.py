"""A wild timestamp of a field or a sample costs that one, not all that follow."""

import math
from dataclasses import replace

import numpy as np
import pytest

from stario.fusion.config import NavigatorConfig
from stario.fusion.imu.buffers import FieldBuffer
from stario.fusion.recording import cut_recording
from stario.sequences import PHONE_IMU, generate_walk, simulate_imu
from stario.sequences.sequence import ImuSequence, Magnetometer

FIELD_B = np.array([20.0, 0.0, -40.0])


def noisy(k: int) -> np.ndarray:
    """Sample k of a sensor whose last digit changes."""
    return FIELD_B + 0.1 * (k % 2)


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    sequence = simulate_imu(generate_walk(3, 20.0), 100.0, PHONE_IMU, 3)
    time = sequence.time[::4]
    field = np.array([noisy(k) for k in range(len(time))])
    return replace(sequence, magnetometer=Magnetometer(time, field))


def count_with_field(sequence: ImuSequence) -> int:
    intervals, _ = cut_recording(sequence, NavigatorConfig())
    return sum(interval.field_B is not None for interval in intervals)


def test_a_wild_sample_time_costs_at_most_one_interval_its_field(walk: ImuSequence) -> None:
    time = walk.time.copy()
    time[1000] += 1e4
    assert count_with_field(replace(walk, time=time)) >= count_with_field(walk) - 1 > 150


@pytest.mark.parametrize("wild", [1e4, -1e4, math.nan])
def test_a_wild_field_time_costs_one_field(wild: float) -> None:
    buffer = FieldBuffer()
    for k in range(200):
        time = 0.02 * k
        buffer.add(time + wild if k == 100 else time, noisy(k), now=time)
        if k != 100:
            assert buffer.at(time) is not None


def test_late_repeated_and_infinite_fields_are_refused() -> None:
    buffer = FieldBuffer()
    assert buffer.add(1.0, FIELD_B, now=1.0)
    assert not buffer.add(1.0, FIELD_B, now=1.0)
    assert not buffer.add(0.5, FIELD_B, now=1.0)
    assert not buffer.add(1.5, np.full(3, math.inf), now=1.5)
    assert buffer.at(1.05) is FIELD_B
    assert buffer.at(1.2) is None


def test_fields_may_arrive_seconds_before_their_samples() -> None:
    buffer = FieldBuffer()
    for batch in range(5):
        for k in range(60):
            assert buffer.add(3.0 * batch + 0.05 * k, noisy(k), now=3.0 * batch - 0.01)
        assert buffer.at(3.0 * batch + 0.12) is not None


def test_a_block_of_fields_may_come_before_its_samples_and_what_does_not_fit_is_counted() -> None:
    buffer = FieldBuffer()
    kept = [buffer.add(0.01 * k, noisy(k), now=-0.01) for k in range(1200)]
    assert kept == [True] * 1000 + [False] * 200
    assert buffer.at(1.0) is None
    assert all(buffer.at(0.1 * k + 0.001) is not None for k in range(21, 119))
    assert len(buffer._waiting) < 50


def test_a_field_too_late_for_any_interval_is_refused() -> None:
    buffer = FieldBuffer()
    assert buffer.add(1.0, FIELD_B, 1.0)
    assert buffer.at(1.5) is None
    assert not buffer.add(1.3, FIELD_B, 1.5)
    assert buffer.add(1.45, FIELD_B, 1.5)


def test_a_sensor_that_repeats_its_value_has_stopped() -> None:
    buffer = FieldBuffer()
    used = [buffer.add(0.1 * k, FIELD_B, now=0.1 * k) for k in range(20)]
    assert used == [True] * 6 + [False] * 14  # slow sensors are logged several times
    assert buffer.add(2.0, noisy(1), now=2.0)
