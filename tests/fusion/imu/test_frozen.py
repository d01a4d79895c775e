"""Sensors that stop and repeat their last values, both together or one alone."""

from dataclasses import replace

import numpy as np
import pytest
from support import CONFIG, lying, stream
from told import health_lines

from stario.fusion import Navigator
from stario.fusion.imu.faults import FrozenSensorDetector
from stario.sequences import ImuSequence, InputError


@pytest.mark.parametrize("held", ["last", "zeros"])
def test_a_sensor_that_stops_makes_a_gap(walk, make_oracle, held):
    gyro, accel, time = walk.gyro.copy(), walk.accel.copy(), walk.time
    dead = (time > time[0] + 8.0) & (time < time[0] + 11.0)
    last = np.argmax(dead) - 1
    gyro[dead], accel[dead] = (gyro[last], accel[last]) if held == "last" else (0.0, 0.0)
    stopped = replace(walk, gyro=gyro, accel=accel)
    track = Navigator(make_oracle(stopped, walk.truth, CONFIG), backend="ekf").run(stopped)
    assert track.health.samples["frozen"] > 0.9 * dead.sum()
    assert track.health.gap_count == 1
    ((start, length),) = track.health.gaps
    assert start == pytest.approx(time[dead][0], abs=0.15)
    assert length == pytest.approx(3.0, abs=0.2)


def test_a_sensor_at_rest_may_repeat_its_values(still_model):
    """Simulated without noise, or so coarse that its noise does not show."""
    health = Navigator(still_model, backend="ekf").run(lying(10.0)).health
    assert health.samples["frozen"] == 0


@pytest.mark.parametrize("accel", [0.0, 1.0])
def test_an_unchanging_stream_is_refused_for_its_force(still_model, accel):
    silent = lying(3.0)
    silent.accel[:, 2] = accel
    with pytest.raises(InputError, match="accel"):
        stream(Navigator(still_model), silent)


def held(walk: ImuSequence, sensor: str, start: float, stop: float) -> ImuSequence:
    """The walk with one sensor repeating its value of `start` [s] until `stop` [s]."""
    values, dead = getattr(walk, sensor).copy(), (walk.time >= start) & (walk.time < stop)
    values[dead] = values[np.argmax(dead)]
    return replace(walk, **{sensor: values})


NAMES = {"gyro": "gyroscope", "accel": "accelerometer"}


@pytest.mark.parametrize("sensor", NAMES)
def test_one_sensor_that_stops_makes_a_gap_and_is_named(walk, make_oracle, sensor):
    stopped = held(walk, sensor, 8.0, 12.0)
    track = Navigator(make_oracle(stopped, walk.truth, CONFIG), backend="ekf").run(stopped)
    ((start, length),) = track.health.gaps
    assert 8.4 < start < 9.1
    assert start + length == pytest.approx(12.0, abs=0.05)
    assert track.health.samples["frozen"] == pytest.approx(100.0 * length, abs=5)
    (line,) = [line for line in health_lines(track.health) if "stopped" in line]
    assert line.startswith(f"! The {NAMES[sensor]} stopped")
    assert not any("same rate" in line for line in health_lines(track.health))


@pytest.mark.parametrize("axis", range(3))
def test_one_axis_of_the_gyroscope_that_stops_is_named(walk, still_model, axis):
    gyro, dead = walk.gyro.copy(), (walk.time >= 8.0) & (walk.time < 12.0)
    gyro[dead, axis] = gyro[np.argmax(dead), axis]
    health = Navigator(still_model, backend="ekf").run(replace(walk, gyro=gyro)).health
    assert health.stopped == {"gyroscope": pytest.approx(300, abs=60)}
    ((start, length),) = health.gaps
    assert start + length == pytest.approx(12.0, abs=0.05)


def test_an_axis_may_be_constant_in_a_plane_or_between_coarse_digits(walk):
    """Also one that is constant from the beginning, and one that reaches its limit."""
    coarse = 0.02 * np.round(walk.gyro / 0.02), 0.15 * np.round(walk.accel / 0.15)
    assert frozen_samples(walk.time, *coarse) == 0
    planar = walk.gyro * [1.0, 1.0, 0.0]
    assert frozen_samples(walk.time, planar, walk.accel) == 0
    fast = walk.gyro + [0.0, 0.0, 8.0] * (walk.time[:, None] > 8.0)
    assert frozen_samples(walk.time, np.minimum(fast, 4.0), walk.accel) == 0


@pytest.mark.parametrize("sensor", NAMES)
def test_a_slow_sensor_may_be_repeated_at_the_rate_of_the_other(walk, still_model, sensor):
    slow = getattr(walk, sensor)[np.arange(len(walk)) // 10 * 10]
    track = Navigator(still_model, backend="ekf").run(replace(walk, **{sensor: slow}))
    assert track.health.samples["frozen"] == 0


def frozen_samples(time: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> int:
    detector = FrozenSensorDetector(9.81)
    rows = np.column_stack([time, gyro, accel]).tolist()
    return sum(detector.stopped(tuple(row)) is not None for row in rows)


def test_constant_values_that_the_other_sensor_confirms_are_no_fault():
    """A coarse gyroscope at rest, a turntable, and turning about the vertical without noise."""
    time = np.arange(0.0, 20.0, 0.01)
    rng = np.random.default_rng(0)
    up = np.tile([0.0, 0.0, 9.81], (len(time), 1))
    noisy = up + 0.1 * rng.standard_normal(up.shape)
    spin = np.tile([0.0, 0.0, 0.35], (len(time), 1))
    swing = np.sin(time)[:, None] * [0.0, 0.0, 1.0]
    for gyro, accel in ((0.0 * up, noisy), (spin, noisy), (swing, up)):
        first = np.arange(len(time))[:, None] < 50  # before, both vary
        vary = 0.1 * rng.standard_normal(up.shape)
        before = np.where(first, vary, gyro), np.where(first, up + vary, accel)
        assert frozen_samples(time, *before) == 0


def test_a_gap_while_a_value_repeats_shows_no_motion(walk):
    """A phone that sleeps for three seconds repeats the gyroscope's value when it wakes."""
    gyro, keep = walk.gyro.copy(), (walk.time < 8.0) | (walk.time >= 11.0)
    awake = np.flatnonzero(walk.time >= 11.0)
    gyro[awake[:5]] = gyro[np.flatnonzero(walk.time < 8.0)[-1]]
    assert frozen_samples(walk.time[keep], gyro[keep], walk.accel[keep]) == 0


def test_a_wild_time_does_not_hide_a_sensor_that_has_stopped(walk):
    stopped = held(walk, "gyro", 8.0, 12.0)
    time = stopped.time.copy()
    time[820] = 1e9
    assert frozen_samples(time, stopped.gyro, stopped.accel) > 200


@pytest.mark.parametrize("stop", [8.3, 10.0])
def test_a_restored_stream_knows_what_has_stopped(walk, still_model, stop):
    stopped = held(walk, "gyro", 8.0, 12.0)
    whole, first, second = (Navigator(still_model) for _ in range(3))
    stream(whole, stopped)
    stream(first, stopped.slice(0.0, stop - 1e-9))
    second.restore(first.snapshot())
    stream(second, stopped.slice(stop, 20.1))
    assert second.health == whole.health
    assert second.health.samples["frozen"] > 200
