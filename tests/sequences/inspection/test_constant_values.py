"""Axes that never change are named, unless the motion is one in a plane."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from told import told

from stario.sequences.findings import warn
from stario.sequences.inspection.constant_values import (
    dead_axes,
    stuck_findings,
)
from stario.sequences.inspection.samples import sample_findings
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk


@pytest.fixture(scope="module")
def walk():
    style = WalkStyle(mount_rotvec=(0.4, -0.7, 1.1))
    return simulate_imu(
        generate_walk(8, 20.0, style=style), 100.0, seed=2, name="w"
    ).without_truth()


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("value", [0.0, 0.02])
def test_a_dead_axis_is_named(walk, sensor, axis, value):
    values = getattr(walk, sensor).copy()
    values[:, axis] = value
    (problem,) = dead_axes(replace(walk, **{sensor: values}))
    name = {"gyro": "gyroscope", "accel": "accelerometer"}[sensor]
    assert f"{name}: its {'xyz'[axis]} axis never changes" in str(problem)


def test_inspect_reports_it_and_the_log_warns_once(walk, caplog):
    dead = replace(walk, gyro=walk.gyro * [1.0, 1.0, 0.0])
    assert any("its z axis" in problem for problem in told(dead))
    assert "axis" not in caplog.text
    with caplog.at_level(logging.WARNING):
        warn(dead.name, dead_axes(dead))
    assert caplog.text.count("its z axis") == 1


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


def test_two_equal_samples_are_not_stuck_for_the_seconds_of_a_wrong_unit(walk):
    gyro, accel = walk.gyro.copy(), walk.accel.copy()
    gyro[501] = gyro[500]
    accel[501, 0] += 9.0
    assert stuck_findings(1e3 * walk.time, gyro, accel) == []


def test_few_or_coarsely_rounded_maxima_are_no_limit(walk):
    short = walk.slice(0.0, 4.0)
    accel = short.accel.copy()
    accel[100:103, 0] = 40.0  # twice a repetition: a knock
    assert not [f for f in sample_findings(replace(short, accel=accel)) if "limit" in f.code]
    rounded = replace(walk, gyro=np.clip(np.round(walk.gyro), -1.0, 1.0))
    assert not [f for f in sample_findings(rounded) if "limit" in f.code]
