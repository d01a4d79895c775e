from dataclasses import replace

import numpy as np
import pytest

from stario.sequences import STANDARD_GRAVITY, ImuSequence, MagneticField, PositionTrack
from stario.sequences.attitude.rotations import GyroIntegral
from stario.sequences.simulation import insertion
from stario.sequences.simulation.imu import PERFECT_IMU, PHONE_IMU, simulate_imu
from stario.sequences.simulation.insertion import Inserted, insert_moment
from stario.sequences.simulation.moments import MOMENTS
from stario.sequences.simulation.outside_sensors import simulate_barometer, simulate_satellites
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.units import METRES_PER_HPA

BY_NAME = {moment.name: moment for moment in MOMENTS}


def walk_of(errors=PERFECT_IMU) -> ImuSequence:
    walk = generate_walk(3, 20.0, style=WalkStyle(carry="handheld"))
    return simulate_imu(walk, 100.0, errors, 3, magnetic_field=MagneticField())


@pytest.fixture(scope="module")
def walk():
    return walk_of()


@pytest.fixture
def perfect(monkeypatch):
    monkeypatch.setattr(insertion, "GYRO_ERROR", 0.0)
    monkeypatch.setattr(insertion, "_ERRORS", PERFECT_IMU)


def inserted(walk: ImuSequence, name: str, share: float = 0.5) -> Inserted:
    return insert_moment(walk, walk.truth, BY_NAME[name], share, seed=1)


def within(found: Inserted) -> ImuSequence:
    return found.sequence.slice(found.start, found.stop - 1e-6)


@pytest.mark.usefixtures("perfect")
@pytest.mark.parametrize("moment", MOMENTS, ids=lambda moment: moment.name)
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_samples_lead_from_each_true_pose_to_the_next(walk, moment, share):
    """Across the moment's ends, too; impacts are shorter than the samples' step."""
    whole = insert_moment(walk, walk.truth, moment, share, seed=1).sequence
    assert (np.diff(whole.time) > 0.0).all()
    np.testing.assert_allclose(whole.truth.time, whole.time, atol=1e-6)
    attitude = GyroIntegral(whole.time, whole.gyro).attitude(whole.time)
    integrated = attitude[:-10].inv() * attitude[10:]
    true = whole.truth.attitude_WB[:-10].inv() * whole.truth.attitude_WB[10:]
    assert np.degrees((integrated.inv() * true).magnitude()).max() < 1.0
    if moment.name == "drop":
        return
    force_W = whole.truth.attitude_WB.apply(whole.accel) - [0.0, 0.0, STANDARD_GRAVITY]
    second = np.diff(whole.truth.position_W, 2, axis=0) / 0.01**2
    smooth = np.ones(20) / 20.0
    off = [np.convolve(column, smooth, "valid") for column in (force_W[1:-1] - second).T]
    # A step of the acceleration at the ends, where a walking person begins to halt, is no error.
    assert np.sqrt(np.mean(np.square(off))) < 0.25


def test_the_rest_of_a_recording_is_unchanged_but_for_its_time_and_a_lifts_height(walk):
    found = inserted(walk, "lift")
    whole, later = found.sequence, found.stop - found.start
    assert later == pytest.approx(24.0)
    before, after = walk.time < found.start, walk.time >= found.start
    rest = (whole.time < found.start - 1e-6) | (whole.time > found.stop - 1e-6)
    np.testing.assert_allclose(whole.time[rest], np.r_[walk.time[before], walk.time[after] + later])
    np.testing.assert_allclose(whole.gyro[rest], walk.gyro)
    np.testing.assert_allclose(whole.accel[rest], walk.accel)
    moved = whole.truth.position_W[rest] - walk.truth.position_W
    np.testing.assert_allclose(moved[before], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(moved[after]), np.tile([0.0, 0.0, 12.0], (after.sum(), 1)),
                               atol=0.1)  # fmt: skip


def test_every_moment_is_what_its_name_says(walk):
    def sizes(name):
        part = within(inserted(walk, name))
        return np.linalg.norm(part.gyro, axis=1), np.linalg.norm(part.accel, axis=1)

    rate, force = sizes("shake 10 s")
    assert 15.0 < rate.max() < 19.0
    assert np.median(rate) > 3.0
    assert force.max() > 3.0 * STANDARD_GRAVITY
    rate, force = sizes("drop")
    assert (force < 1.0).sum() > 30  # it falls for 0.45 s
    assert force.max() > 5.0 * STANDARD_GRAVITY
    rate, force = sizes("table")
    assert rate[600:1400].max() < 0.02
    rate, force = sizes("standing")
    turning = np.degrees(rate[300:-300])
    assert 0.3 < np.median(turning) < 3.0
    rate, force = sizes("lift")
    assert np.ptp(force[300:-300]) > 1.5


def test_a_lift_turns_the_field_and_weakens_it_and_standing_does_not(walk):
    def field_W(name):
        whole = inserted(walk, name)
        part = whole.sequence.slice(whole.start + 6.0, whole.stop - 6.0)
        at = whole.sequence.truth.at(part.magnetometer.time)
        return at.attitude_WB.apply(part.magnetometer.field)

    lift, standing = field_W("lift"), field_W("standing")
    bearing = np.degrees(np.unwrap(np.arctan2(lift[:, 1], lift[:, 0])))
    assert 30.0 < np.abs(bearing).mean() < 80.0
    assert np.linalg.norm(lift, axis=1).mean() < 0.7 * 48.0
    np.testing.assert_allclose(np.arctan2(standing[:, 1], standing[:, 0]), 0.0, atol=0.2)


def test_the_gyroscope_keeps_its_bias_and_errors_of_scale_grow_with_the_rotation(walk):
    bias = np.array([0.03, -0.02, 0.01])
    part = within(inserted(replace(walk, gyro=walk.gyro + bias), "table"))
    lying = (part.time > part.time[0] + 5.0) & (part.time < part.time[0] + 15.0)
    np.testing.assert_allclose(part.gyro[lying].mean(axis=0), bias, atol=2e-3)
    found = inserted(walk_of(PHONE_IMU), "shake 25 s")
    whole = found.sequence
    ends = np.array([found.start, found.stop])
    turn = GyroIntegral(whole.time, whole.gyro).attitude(ends)
    true = whole.truth.at(ends).attitude_WB
    wrong = ((turn[0].inv() * turn[1]).inv() * (true[0].inv() * true[1])).magnitude()
    assert np.degrees(wrong) > 5.0


def test_pressure_goes_on_in_a_moment_and_known_positions_after_it(walk):
    time = np.array([2.0, 8.0, 15.0])
    known = PositionTrack(time, walk.truth.at(time).position_W[:, :2], "waypoints")
    full = replace(
        walk,
        truth=None,
        positions=known,
        barometer=simulate_barometer(walk.truth, weather=0.0, door=0.0, noise=0.02),
        satellites=simulate_satellites(walk.truth),
    )
    found = insert_moment(full, walk.truth, BY_NAME["table"], 0.5, seed=1)
    np.testing.assert_allclose(found.sequence.positions.time, [2.0, 8.0, 35.0])
    np.testing.assert_allclose(found.sequence.positions.position_W, known.position_W)
    pressure, reported = found.sequence.barometer, found.sequence.satellites
    assert np.diff(pressure.time).max() < 0.3
    true = inserted(walk, "table").sequence.truth.at(pressure.time).position_W[:, 2]
    height = METRES_PER_HPA * (pressure.pressure_hPa[0] - pressure.pressure_hPa)
    np.testing.assert_allclose(height - height.mean(), true - true.mean(), atol=0.2)
    late = full.satellites.time >= found.start
    moved = np.where(late, found.stop - found.start, 0.0)
    np.testing.assert_allclose(reported.time, full.satellites.time + moved)
    np.testing.assert_array_equal(reported.latlon_deg, full.satellites.latlon_deg)
