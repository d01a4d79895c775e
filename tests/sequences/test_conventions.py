import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import STANDARD_GRAVITY, Barometer, ImuSequence, Magnetometer, Satellites
from stario.sequences.conventions import (
    axes_matrix,
    axes_named,
    with_axes,
    with_conventions,
    with_gravity,
)
from stario.sequences.errors import InputError
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import generate_walk
from stario.sequences.units import MAGNETIC_UNITS


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(3, 20.0), 100.0, seed=1)


def without_gravity(sequence: ImuSequence) -> ImuSequence:
    """The recording with gravity removed by means of the true attitude."""
    up_B = sequence.truth.at(sequence.time).attitude_WB.apply([0, 0, STANDARD_GRAVITY], True)
    return replace(sequence, accel=sequence.accel - up_B)


def test_axes_name_the_file_axis_used_as_each_new_axis(walk):
    turned = with_axes(walk, "y, -x, +Z")
    assert np.array_equal(turned.gyro, walk.gyro[:, [1, 0, 2]] * [1, -1, 1])
    assert np.array_equal(turned.accel, walk.accel[:, [1, 0, 2]] * [1, -1, 1])
    assert turned.truth is walk.truth
    field = Magnetometer(walk.time[:3], np.arange(9.0).reshape(3, 3))
    seen = with_axes(replace(walk, magnetometer=field), "y,-x,z").magnetometer
    assert np.array_equal(seen.field, field.field[:, [1, 0, 2]] * [1, -1, 1])
    assert with_axes(walk, "x,y,z") is walk
    twice = with_axes(with_axes(walk, "y,z,x"), "y,-x,z")
    assert twice.axes == "z,-y,x"
    assert np.array_equal(twice.gyro, with_axes(walk, twice.axes).gyro)


def test_conventions_and_parts_keep_pressure_and_satellites(walk):
    air = Barometer(np.array([1.0, 5.0, 9.0]), np.array([1000.0, 1000.5, 1001.0]))
    reported = Satellites(np.array([2.0, 6.0]), np.array([[48.0, 11.0], [48.1, 11.0]]))
    full = replace(walk, barometer=air, satellites=reported)
    other = replace(full, gyro=np.degrees(walk.gyro), accel=without_gravity(walk).accel)
    found = with_conventions(other, gyro_unit="deg/s", gravity="removed")
    found = with_axes(found, "y,-x,z")
    assert found.barometer is air
    assert found.satellites is reported
    part = found.slice(4.0, 8.0)
    np.testing.assert_array_equal(part.barometer.pressure_hPa, [1000.5])
    np.testing.assert_array_equal(part.satellites.latlon_deg, [[48.1, 11.0]])


def test_all_24_right_handed_axes_are_rotations_and_are_named():
    names = {axes_named(R.as_matrix()) for R in Rotation.create_group("O")}
    assert len(names) == 24
    for name in names:
        R = axes_matrix(name)
        np.testing.assert_allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1.0)
        tilted = Rotation.from_rotvec([0.2, -0.1, 0.2]).as_matrix() @ R
        assert axes_named(tilted) == name


NONE = ("", "x,y", "x,x,z", "x,y,w", "x y z", "--x,y,z", "x,y,z,z", ",,")
LEFT = ("y,x,z", "-x,y,z", "x,-z,-y", "-x,-y,-z")


@pytest.mark.parametrize("axes", [*NONE, *LEFT])
def test_axes_that_are_no_permutation_or_left_handed_are_refused(walk, axes):
    words = r"left-handed.*change the sign" if axes in LEFT else "expected x, y and z once each"
    with pytest.raises(InputError, match=f"axes: found .*{words}"):
        with_axes(walk, axes)


def test_apples_sign_is_reversed_unless_the_reader_did_so(walk):
    apple = replace(walk, accel=-walk.accel / STANDARD_GRAVITY)
    back = with_conventions(apple, accel_unit="g", accel_sign="apple")
    np.testing.assert_allclose(back.accel, walk.accel)
    named = replace(walk, accel=-walk.accel, converted=frozenset({"accel"}))  # `ax [g]`
    back = with_conventions(named, accel_sign="apple")
    np.testing.assert_allclose(back.accel, walk.accel)
    stated_twice = with_conventions(walk, accel_unit="-m/s^2", accel_sign="apple")
    np.testing.assert_allclose(stated_twice.accel, walk.accel)
    for sign, doubted in (("apple", False), ("up", True)):
        maybe = with_conventions(replace(walk, maybe_apple=True), accel_sign=sign)
        assert maybe.maybe_apple == doubted
    turned = replace(walk, converted=frozenset({"sign"}))
    assert np.array_equal(with_conventions(turned).accel, walk.accel)
    with pytest.raises(InputError, match=r"accel_unit: .*sign was already turned .*omit"):
        with_conventions(turned, accel_sign="apple")


def test_magnetic_units_agree():
    units = {"uT": 50.0, "nT": 5e4, "mT": 0.05, "T": 5e-5, "gauss": 0.5, "g": 0.5, "mg": 500.0}
    assert {unit: 50.0 / value for unit, value in units.items()} == pytest.approx(MAGNETIC_UNITS)


def test_all_conventions_are_undone_at_once_with_a_warning_of_doubtful_degrees(walk, caplog):
    """Apple's user acceleration in g, rates in deg/s, axes rotated relative to the truth's."""
    bare = with_axes(without_gravity(walk), "-y,x,z")
    apple = replace(bare, gyro=np.degrees(bare.gyro), accel=-bare.accel / STANDARD_GRAVITY)
    corrected = with_conventions(apple, "deg/s", "-g", "y,-x,z", "removed")
    np.testing.assert_allclose(corrected.gyro, walk.gyro, atol=1e-9)
    np.testing.assert_allclose(corrected.accel, walk.accel, atol=1e-9)
    with_conventions(replace(walk, gyro=np.degrees(walk.gyro)), gyro_unit="deg/s")
    assert not caplog.records
    with_conventions(walk, gyro_unit="dps")
    assert "fit rad/s; --gyro-unit deg/s divides them by 57" in caplog.text


def test_samples_of_unknown_attitude_are_dropped_and_counted(walk, caplog):
    time = walk.time.copy()
    time[7] = np.nan
    half = replace(without_gravity(walk), time=time, truth=walk.truth.slice(0.0, 10.0))
    with caplog.at_level(logging.WARNING):
        corrected = with_gravity(half)
    assert f"{len(walk) - len(corrected)} of {len(walk)} samples dropped" in caplog.text
    assert corrected.time[-1] == pytest.approx(10.0)
    assert np.isfinite(corrected.time).all()
    np.testing.assert_allclose(corrected.accel[:7], walk.accel[:7], atol=1e-9)


def test_without_an_attitude_gravity_is_not_guessed(walk):
    for blind in (
        walk.without_truth(),
        replace(walk, truth=replace(walk.truth, valid=np.zeros(len(walk.truth), dtype=bool))),
        replace(walk, truth=replace(walk.truth, time=walk.truth.time + 1000.0)),
    ):
        with pytest.raises(InputError, match=r"gravity: found removed and no .*record the raw"):
            with_gravity(blind)
