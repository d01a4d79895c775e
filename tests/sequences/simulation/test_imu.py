import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import PERFECT_IMU, ImuErrors, ImuNoise, MagneticField, simulate_imu
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.magnetometer import EARTH_W, simulate_magnetometer
from stario.sequences.simulation.walks import generate_walk

UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def waving(rate: float = 100.0, duration: float = 20.0) -> Trajectory:
    """A device moved and turned about all axes, up to about 3 rad/s and 5 m/s^2."""
    t = np.arange(round(duration * rate) + 1) / rate
    position = np.stack([np.sin(1.3 * t) + 0.3 * t, np.cos(0.7 * t), 0.05 * np.sin(9.0 * t)], 1)
    turn = np.stack([np.sin(1.1 * t), 0.8 * np.cos(1.7 * t), 0.4 * np.sin(4.0 * t)], axis=1)
    R_WB = Rotation.from_rotvec(np.outer(0.9 * t, [0, 0, 1])) * Rotation.from_rotvec(turn)
    return Trajectory(t, position, R_WB)


def standing(duration: float, rate: float = 1.0) -> Trajectory:
    t = np.arange(round(duration * rate) + 1) / rate
    return Trajectory(t, np.zeros((len(t), 3)), Rotation.identity(len(t)))


def test_truth_passes_through_the_given_poses_and_samples_are_its_derivatives():
    imu = simulate_imu(waving(), rate=2000.0, errors=PERFECT_IMU, gravity=9.7)
    truth, h = imu.truth, 1.0 / 2000.0
    p = truth.position_W
    velocity = (p[2:] - p[:-2]) / (2.0 * h)
    assert np.abs(velocity - truth.velocity_W[1:-1]).max() < 1e-5
    acceleration = (p[2:] - 2.0 * p[1:-1] + p[:-2]) / h**2
    measured = truth.attitude_WB.apply(np.array(imu.accel)) - [0.0, 0.0, 9.7]
    assert np.abs(acceleration - measured[1:-1]).max() < 1e-4
    turned = (truth.attitude_WB[:-2].inv() * truth.attitude_WB[2:]).as_rotvec() / (2.0 * h)
    assert np.abs(turned - imu.gyro[1:-1]).max() < 1e-5
    given = waving()
    truth = simulate_imu(given, rate=200.0, errors=PERFECT_IMU).truth
    assert np.abs(truth.position_W[::2] - given.position_W).max() < 1e-9
    assert (truth.attitude_WB[::2].inv() * given.attitude_WB).magnitude().max() < 1e-7


@pytest.mark.parametrize("rate", [50.0, 400.0])
def test_white_noise_has_its_density_at_any_rate(rate):
    errors = ImuErrors(noise=ImuNoise(2e-3, 3e-2, 0.0, 0.0))
    imu = simulate_imu(standing(200.0), rate=rate, errors=errors, seed=3)
    assert np.allclose(imu.gyro.std(axis=0), 2e-3 * math.sqrt(rate), rtol=0.04)
    assert np.allclose((imu.accel - UP).std(axis=0), 3e-2 * math.sqrt(rate), rtol=0.04)


def test_bias_walk_grows_with_the_square_root_of_time():
    errors = ImuErrors(noise=ImuNoise(0.0, 0.0, 1e-3, 2e-2))
    for lag in (1.0, 10.0):
        gyro, accel = [], []
        for seed in range(4):
            imu = simulate_imu(standing(1000.0), rate=20.0, errors=errors, seed=seed)
            k = round(lag * 20.0)
            gyro.append(imu.gyro[k::k] - imu.gyro[:-k:k])
            accel.append(imu.accel[k::k] - imu.accel[:-k:k])
        assert np.concatenate(gyro).std() == pytest.approx(1e-3 * math.sqrt(lag), rel=0.1)
        assert np.concatenate(accel).std() == pytest.approx(2e-2 * math.sqrt(lag), rel=0.1)


def test_turn_on_bias_scale_and_misalignment_have_their_deviations():
    errors = ImuErrors(
        noise=PERFECT_IMU.noise, gyro_turn_on=0.01, accel_turn_on=0.1, accel_scale=0.02
    )
    runs = [simulate_imu(standing(6.0), 10.0, errors, seed) for seed in range(300)]
    assert np.std([run.gyro[0] for run in runs]) == pytest.approx(0.01, rel=0.1)
    assert np.std([run.accel[-1, :2] for run in runs]) == pytest.approx(0.1, rel=0.1)
    along_z = math.hypot(0.1, 0.02 * STANDARD_GRAVITY)
    assert np.std([run.accel[0, 2] for run in runs]) == pytest.approx(along_z, rel=0.15)
    tilted = ImuErrors(noise=PERFECT_IMU.noise, misalignment=0.01)
    rows = [simulate_imu(standing(6.0), 10.0, tilted, seed).accel[0] for seed in range(300)]
    assert np.std([row[:2] for row in rows]) == pytest.approx(0.01 * STANDARD_GRAVITY, rel=0.15)
    assert np.allclose(np.linalg.norm(rows, axis=1), STANDARD_GRAVITY)


def test_saturation_clips_the_samples():
    free = simulate_imu(waving(), errors=PERFECT_IMU)
    errors = ImuErrors(noise=PERFECT_IMU.noise, gyro_range=1.0, accel_range=9.0)
    clipped = simulate_imu(waving(), errors=errors)
    assert np.abs(free.gyro).max() > 1.5
    assert np.array_equal(clipped.gyro, np.clip(free.gyro, -1.0, 1.0))
    assert np.array_equal(clipped.accel, np.clip(free.accel, -9.0, 9.0))


@pytest.mark.parametrize("rate", [50.0, 200.0, 333.0])
def test_samples_cover_the_track_at_the_given_rate(rate):
    imu = simulate_imu(waving(duration=7.0), rate=rate)
    assert imu.rate == pytest.approx(rate)
    assert imu.time[0] == 0.0
    assert 7.0 - 1.0 / rate < imu.time[-1] <= 7.0


def test_short_gaps_are_bridged_and_long_ones_refused():
    track = waving()
    valid = np.ones(len(track), dtype=bool)
    valid[500:505] = False
    bad = track.position_W.copy()
    bad[~valid] += 1.0
    short = Trajectory(track.time, bad, track.attitude_WB, valid=valid)
    imu, whole = simulate_imu(short, errors=PERFECT_IMU), simulate_imu(track, errors=PERFECT_IMU)
    assert np.abs(imu.accel - whole.accel).max() < 1e-2
    valid[500:550] = False
    long = Trajectory(track.time, bad, track.attitude_WB, valid=valid)
    for gappy in (long, track.select(valid)):
        with pytest.raises(InputError, match=r"no valid pose for .* after 4\.990 s"):
            simulate_imu(gappy)


def test_the_last_pose_is_measured_despite_rounding():
    """In floating point, 0.29 s at 100 Hz are 28.999999999999996 steps."""
    track = waving(duration=0.29)
    assert len(simulate_imu(track, 100.0, PERFECT_IMU)) == len(track) == 30


QUIET = MagneticField(noise=0.0)


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(3, 30.0), 100.0, seed=1)


def in_world(walk: ImuSequence, magnetic_field: MagneticField) -> FloatArray:
    seen = simulate_magnetometer(walk.truth, magnetic_field, seed=5)
    at = walk.truth.at(np.clip(seen.time, *walk.truth.time[[0, -1]]))
    return np.asarray(at.attitude_WB.apply(seen.field))


def test_the_earths_field_is_constant_hard_iron_is_added_and_stamps_are_late(walk):
    field_W = in_world(walk, QUIET)
    np.testing.assert_allclose(field_W, np.tile(EARTH_W, (len(field_W), 1)), atol=1e-9)
    iron = (3.0, -2.0, 4.0)
    plain = simulate_magnetometer(walk.truth, QUIET)
    seen = simulate_magnetometer(walk.truth, replace(QUIET, hard_iron=iron, lag=0.03))
    np.testing.assert_allclose(seen.time, plain.time + 0.03)
    np.testing.assert_allclose(seen.field - plain.field, np.tile(iron, (len(plain), 1)))


def test_a_buildings_field_has_its_strength_and_depends_on_position_only(walk):
    building = replace(QUIET, disturbance=8.0, length=2.0)
    time = np.arange(20_001) / 50.0
    path = np.stack([0.9 * time, 30.0 * np.sin(0.01 * time), 0.0 * time], axis=1)
    truth = walk.truth
    long = Trajectory(time, path, truth.attitude_WB[np.zeros(len(time), dtype=int)])
    sizes = np.linalg.norm(in_world(replace(walk, truth=long), building) - EARTH_W, axis=1)
    assert np.sqrt(np.square(sizes).mean()) == pytest.approx(8.0, rel=0.3)
    back = replace(long, position_W=path[::-1])
    again = simulate_magnetometer(back, building, seed=2).field[::-1]
    np.testing.assert_allclose(
        again, simulate_magnetometer(long, building, seed=2).field, atol=1e-9
    )


def test_the_imu_is_the_same_with_and_without_a_magnetometer(walk):
    both = simulate_imu(walk.truth, 100.0, seed=1, magnetic_field=MagneticField())
    alone = simulate_imu(walk.truth, 100.0, seed=1)
    np.testing.assert_array_equal(both.gyro, alone.gyro)
    assert alone.magnetometer is None
    assert len(both.magnetometer) == pytest.approx(50 * both.duration, abs=2)
