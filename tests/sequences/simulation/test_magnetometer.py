"""The simulated magnetometer behaves like a real one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stario.sequences import ImuSequence, InputError, MagneticField, simulate_imu
from stario.sequences.sequence import FloatArray, Trajectory
from stario.sequences.simulation.magnetometer import simulate_magnetometer
from stario.sequences.simulation.walks import generate_walk

QUIET = MagneticField(noise=0.0)


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    return simulate_imu(generate_walk(3, 30.0), 100.0, seed=1)


def in_world(walk: ImuSequence, magnetic_field: MagneticField) -> FloatArray:
    seen = simulate_magnetometer(walk.truth, magnetic_field, seed=5)
    at = walk.truth.at(np.clip(seen.time, *walk.truth.time[[0, -1]]))
    return np.asarray(at.attitude_WB.apply(seen.field))


def test_the_earths_field_is_constant_in_the_world(walk: ImuSequence) -> None:
    field_W = in_world(walk, replace(QUIET, azimuth=0.7))
    np.testing.assert_allclose(np.linalg.norm(field_W, axis=1), 48.0)
    np.testing.assert_allclose(np.ptp(field_W, axis=0), 0.0, atol=1e-9)
    assert math.atan2(field_W[0, 1], field_W[0, 0]) == pytest.approx(0.7)
    assert field_W[0, 2] == pytest.approx(-48.0 * math.sin(QUIET.dip))


def test_a_buildings_field_has_its_strength_and_depends_on_position_only(walk: ImuSequence) -> None:
    building = replace(QUIET, strength=0.0, disturbance=8.0, length=2.0, rate=100.0)
    time = np.arange(0.0, 400.0, 0.01)
    path = np.stack([0.9 * time, 30.0 * np.sin(0.01 * time), 0.0 * time], axis=1)
    truth = walk.truth
    long = Trajectory(time, path, truth.attitude_WB[np.zeros(len(time), dtype=int)])
    sizes = np.linalg.norm(simulate_magnetometer(long, building, seed=2).field, axis=1)
    assert np.sqrt(np.square(sizes).mean()) == pytest.approx(8.0, rel=0.3)
    back = replace(long, position_W=path[::-1])
    again = simulate_magnetometer(back, building, seed=2).field[::-1]
    np.testing.assert_allclose(
        again, simulate_magnetometer(long, building, seed=2).field, atol=1e-9
    )


def test_magnets_act_while_near_and_hard_iron_always(walk: ImuSequence) -> None:
    iron = (3.0, -2.0, 4.0)
    disturbed = replace(QUIET, hard_iron=iron, magnets=((10.0, 20.0, 150.0),), lag=0.03)
    plain = simulate_magnetometer(walk.truth, QUIET)
    seen = simulate_magnetometer(walk.truth, disturbed)
    np.testing.assert_allclose(seen.time, plain.time + 0.03)
    added = seen.field - plain.field
    near = (plain.time >= 10.0) & (plain.time <= 20.0)
    np.testing.assert_allclose(added[~near], np.tile(iron, ((~near).sum(), 1)))
    np.testing.assert_allclose(np.linalg.norm(added[near] - iron, axis=1), 150.0)


def test_the_imu_is_the_same_with_and_without_a_magnetometer(walk: ImuSequence) -> None:
    both = simulate_imu(walk.truth, 100.0, seed=1, magnetic_field=MagneticField())
    alone = simulate_imu(walk.truth, 100.0, seed=1)
    np.testing.assert_array_equal(both.gyro, alone.gyro)
    assert alone.magnetometer is None
    assert len(both.magnetometer) == pytest.approx(50 * both.duration, abs=2)


@pytest.mark.parametrize(
    "change", [{"rate": 0.0}, {"length": -1.0}, {"noise": -1.0}, {"hard_iron": (math.nan, 0, 0)}]
)
def test_invalid_field_parameters_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        replace(QUIET, **change)
