import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from told import UP, refusal, told
from walked import walked

from stario.sequences import check_units
from stario.sequences.inspection.samples import dead_axes, sample_findings, stuck_findings
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence


@pytest.mark.parametrize(
    ("sensor", "value", "name"),
    [("gyro", 0.0, "gyroscope"), ("gyro", 0.3, "gyroscope"),
     ("accel", 0.0, "accelerometer"), ("accel", 5.66, "accelerometer")],
)  # fmt: skip
def test_a_constant_sensor_is_refused_while_the_other_varies(walk, sensor, value, name):
    dead = replace(walk, **{sensor: np.full((len(walk), 3), value)})
    for recording in (dead, dead.without_truth()):
        assert f"{name}: found values that never change" in refusal(recording)
    assert len(told(dead.without_truth())) == 1


def test_a_constant_rate_without_noise_and_a_device_at_rest_pass():
    """At rest, on a circle, and rotating in place about an inclined axis."""
    time = np.arange(0.0, 20.0, 0.01)
    turns = Rotation.from_rotvec(np.outer(time, [0.0, 0.5, 0.5]))
    circle = np.tile([0.0, 1.5, STANDARD_GRAVITY], (len(time), 1))
    for rate, accel in (
        ([0.0, 0.0, 0.0], np.tile(UP, (len(time), 1))),
        ([0.0, 0.0, 0.8], circle),
        ([0.0, 0.5, 0.5], turns.apply(UP, inverse=True)),
    ):
        gyro = np.tile(rate, (len(time), 1)).astype(np.float64)
        even = ImuSequence("even", time, gyro, accel)
        check_units(even)
        assert told(even) == []


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_sensor_stuck_for_seconds_is_named(walk, sensor):
    values = getattr(walk, sensor).copy()
    values[2000:2800], values[4000:4300] = values[2000], values[4000]
    stuck = replace(walk, **{sensor: values}).without_truth()
    (problem,) = (p for p in told(stuck) if "repeat exactly" in p)
    assert {"gyro": "gyroscope", "accel": "accelerometer"}[sensor] + ": its values" in problem
    assert "from 10.0 to 14.0 s" in problem
    assert "for 5.5 s" in problem
    held = getattr(walk, sensor)[np.arange(len(walk)) // 2 * 2]
    in_ms = replace(walk, time=1e3 * walk.time, truth=None, **{sensor: held})
    assert "repeat" not in " ".join(told(in_ms))


def test_a_sensor_at_its_limit_is_named_with_the_share_of_samples():
    free = walked(5, 30.0, imu_seed=5, carry="swinging", preferred_speed=1.6).without_truth()
    limits = {"gyro": 3.5, "accel": 16.0}
    for sensor, limit in limits.items():
        values = getattr(free, sensor)
        share = float((np.abs(values) > limit).any(axis=1).mean())
        assert share > 0.02
        clipped = replace(free, **{sensor: np.clip(values, -limit, limit)})
        (problem,) = (p for p in told(clipped) if "limit" in p)
        assert f"limit of {limit:.3g}" in problem
        reported = float(problem.split("%")[0].split()[-1]) / 100.0
        assert 0.5 * share < reported < share
    assert not [p for p in told(free) if "limit" in p]


def test_one_huge_value_neither_refuses_nor_warns(walk):
    gyro = walk.gyro.copy()
    gyro[5, 0] = 1e300
    sequence = replace(walk, gyro=gyro)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_units(sequence)
        (text,) = told(sequence)
    assert text.endswith("in 1 sample")
    accel = walk.accel.copy()
    accel[100] = [9e4, 0.0, 0.0]  # nor does one spike turn the average force
    check_units(replace(walk, accel=accel))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_saturated_accelerometer_is_named_before_its_unit_is_judged(caplog, noise):
    """A runner's steps of up to 4 g, cut at 2 g: the average force is far below gravity."""
    time = np.arange(6000) / 100.0
    step = np.sin(2.0 * np.pi * 2.7 * time)
    force = np.column_stack([np.zeros_like(time), np.zeros_like(time), 9.8 + 60.0 * (step**9)])
    force[:, 2] = np.clip(force[:, 2] - 24.0 * (step > 0.6) + 15.0 * (step < -0.6), -19.6, 19.6)
    force += np.random.default_rng(0).normal(0.0, noise, force.shape)
    gyro = np.column_stack([step, 0.3 * step, np.cos(time)])
    check_units(ImuSequence("runner", time, gyro, force, source="phone"))
    assert "of its samples are at its limit of" in caplog.text


@pytest.fixture(scope="module")
def mounted():
    """A walk of a device whose every axis moves, without truth."""
    return walked(8, 20.0, imu_seed=2, mount_rotvec=(0.4, -0.7, 1.1)).without_truth()


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("value", [0.0, 0.02])
def test_a_dead_axis_is_named(mounted, sensor, axis, value):
    values = getattr(mounted, sensor).copy()
    values[:, axis] = value
    (problem,) = dead_axes(replace(mounted, **{sensor: values}))
    name = {"gyro": "gyroscope", "accel": "accelerometer"}[sensor]
    assert f"{name}: its {'xyz'[axis]} axis never changes" in str(problem)


def test_motion_in_a_plane_is_no_problem():
    """A robot on the floor and a pendulum, simulated without noise, and a device at rest."""
    t = np.arange(0.0, 20.0, 0.01)
    zero, up = np.zeros_like(t), np.full_like(t, STANDARD_GRAVITY)
    turn, angle = np.sin(t), 0.5 * np.sin(t)
    floor = [zero, zero, turn], [zero, turn, up]
    swing = [zero, 0.5 * np.cos(t), zero], [-np.sin(angle) * up, zero, np.cos(angle) * up]
    rng = np.random.default_rng(0)
    rest = [*(0.002 * rng.standard_normal((2, len(t)))), zero], [zero, zero, up]
    for gyro, accel in (floor, swing, rest):
        planar = ImuSequence("planar", t, np.column_stack(gyro), np.column_stack(accel))
        assert dead_axes(planar) == []


def test_two_equal_samples_are_not_stuck_and_few_or_rounded_maxima_are_no_limit(mounted):
    gyro, accel = mounted.gyro.copy(), mounted.accel.copy()
    gyro[501] = gyro[500]
    accel[501, 0] += 9.0
    assert stuck_findings(1e3 * mounted.time, gyro, accel) == []
    short = mounted.slice(0.0, 4.0)
    accel = short.accel.copy()
    accel[100:103, 0] = 40.0  # twice a repetition: a knock
    assert not [f for f in sample_findings(replace(short, accel=accel)) if "limit" in f.code]
    rounded = replace(mounted, gyro=np.clip(np.round(mounted.gyro), -1.0, 1.0))
    assert not [f for f in sample_findings(rounded) if "limit" in f.code]
