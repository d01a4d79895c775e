import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walked import walked

from stario.sequences import STANDARD_GRAVITY, ImuSequence
from stario.sequences.attitude.levelling import (
    GravityStart,
    LevelledAttitude,
    integrate,
    levelled_attitudes,
    start_from_gravity,
)
from stario.sequences.attitude.so3 import exp_so3
from stario.sequences.simulation.carrying import CARRYING_MODES
from stario.sequences.simulation.imu import PERFECT_IMU, PHONE_IMU, ImuErrors

UP = np.array([0.0, 0.0, 1.0])


def simulated_walk(seed: int, seconds: float, carry: str, errors: ImuErrors) -> ImuSequence:
    return walked(
        seed, seconds, errors, seed, rate=200.0, carry=carry, mount_rotvec=(0.4, -0.7, 1.1)
    )


def start_at(R_WB: np.ndarray, turn_rate: float = 0.5) -> GravityStart:
    return GravityStart(R_WB, False, STANDARD_GRAVITY, turn_rate)


def advanced(
    attitude: LevelledAttitude, steps: int, samples: int = 21, rate: tuple[float, ...] = (0, 0, 0)
) -> LevelledAttitude:
    """Advance the attitude of a device that measures gravity along z and a constant rate."""
    time = np.arange(samples) / 200.0
    gyro, accel = np.tile(rate, (samples, 1)), np.tile(STANDARD_GRAVITY * UP, (samples, 1))
    for _ in range(steps):
        attitude.advance(time, gyro, accel)
    return attitude


def tilt_error(R_NB: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """Angle [deg] between the true and the estimated vertical, both in B."""
    cosine = np.sum(R_NB[..., 2, :] * R_WB[..., 2, :], axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (1.4, 0.3, -2.0), (3.14, 0.0, 0.0)])
def test_a_device_at_rest_starts_level_to_within_its_noise(mount):
    rng = np.random.default_rng(0)
    R_WB = Rotation.from_rotvec(mount)
    time = np.arange(201) / 200.0
    accel = R_WB.inv().apply(STANDARD_GRAVITY * UP) + 0.05 * rng.standard_normal((201, 3))
    start = start_from_gravity(time, 1e-3 * rng.standard_normal((201, 3)), accel)
    assert start.still
    assert tilt_error(start.R_WB, R_WB.as_matrix()) < 0.1
    quat_xyzw = Rotation.from_matrix(start.R_WB).as_quat()
    assert abs(quat_xyzw[2]) < 1e-9  # the rotation axis is horizontal


@pytest.mark.parametrize("carry", CARRYING_MODES)
def test_a_pedestrian_starts_level_to_within_the_stated_sigma(carry):
    errors = []
    for seed in range(6):
        walk = simulated_walk(seed, 5.0, carry, PHONE_IMU)
        for first in (0, 400, 700):
            part = slice(first, first + 201)
            start = start_from_gravity(walk.time[part], walk.gyro[part], walk.accel[part])
            truth = walk.truth.attitude_WB[first].as_matrix()
            errors.append(tilt_error(start.R_WB, truth))
            if start.still:
                assert errors[-1] < 3 * np.degrees(0.01) + 0.3
    # FilterConfig.tilt_sigma is 0.05 rad (2.9 degrees) for each of two axes; a rig is waved.
    assert np.sqrt(np.mean(np.square(errors))) < 1.4 * 2.9 * np.sqrt(2.0)


def test_a_grid_rounded_to_beyond_the_last_sample_is_levelled():
    """0.09 s plus 420 steps of 0.1 s is later than 42.09 s in floating point."""
    walk = simulated_walk(1, 43.0, "handheld", PERFECT_IMU)
    part = slice(9, 4210)
    time = np.arange(4301)[part] / 100.0
    gyro, accel = walk.gyro[part], walk.accel[part]
    shorter = levelled_attitudes(time[:-1], gyro[:-1], accel[:-1])
    longer = levelled_attitudes(time, gyro, accel)
    np.testing.assert_allclose(longer[:-10], shorter[:-9], rtol=0.0, atol=1e-9)


def test_levelling_tolerates_uncorrected_gyroscope_rates():
    """A phone that does not correct its gyroscope: a bias of 5 deg/s about a body axis."""
    walk = simulated_walk(1, 90.0, "handheld", PERFECT_IMU)
    truth = walk.truth.attitude_WB.as_matrix()
    R_NB = levelled_attitudes(walk.time, walk.gyro + np.array([0.087, 0.0, 0.0]), walk.accel)
    error = tilt_error(R_NB, truth[: len(R_NB)])[len(R_NB) // 2 :]
    assert np.sqrt(np.mean(np.square(error))) < 3.0


def test_levelling_leaves_yaw_unchanged():
    """The tilt of a device at rest is corrected about a horizontal axis only."""
    tilted = exp_so3(np.array([0.08, -0.04, 0.0]))
    attitude = LevelledAttitude(start_at(tilted))
    for _ in range(1200):
        before = attitude.R_NB
        advanced(attitude, 1, 11)
        turn = Rotation.from_matrix(attitude.R_NB @ before.T).as_rotvec()
        # The estimated bias is horizontal too; what remains is of second order.
        assert abs(turn[2]) < 0.1 * np.linalg.norm(turn[:2]) + 1e-10
    assert tilt_error(attitude.R_NB, np.eye(3)) < 0.5
    yaw = Rotation.from_matrix(attitude.R_NB @ tilted.T).as_rotvec()[2]
    assert abs(yaw) < 0.01


def test_after_a_gap_the_tilt_is_gravitys_and_bias_and_yaw_are_kept():
    attitude = advanced(LevelledAttitude(start_at(np.eye(3))), 300, rate=(0.02, -0.01, 0.0))
    learned, before = attitude.b_g.copy(), attitude.R_NB
    np.testing.assert_allclose(learned, [0.02, -0.01, 0.0], atol=3e-3)
    turned = exp_so3(np.array([0.9, 0.4, 0.0]))  # with the device, unobserved
    attitude.level(np.eye(3), start_at(turned.T))
    np.testing.assert_array_equal(attitude.b_g, learned)
    assert not attitude._P[:3, 3:].any()  # gravity's tilt is independent of the bias
    assert tilt_error(attitude.R_NB @ turned, np.eye(3)) < 1e-9
    about = Rotation.from_matrix(attitude.R_NB @ before.T).as_rotvec()
    assert abs(about[2]) < 1e-9


@pytest.mark.parametrize("after_gap", [False, True])
def test_a_livelier_start_is_levelled_more_quickly(after_gap):
    """A runner's first second gives a tilt that is off by ten degrees."""
    off = exp_so3(np.array([0.2, 0.0, 0.0]))
    errors = []
    for turn_rate in (0.5, 1.0, 3.0):
        start = start_at(off, turn_rate)
        attitude = LevelledAttitude(start)
        if after_gap:
            attitude = advanced(LevelledAttitude(start_at(np.eye(3))), 100)
            attitude.level(np.eye(3), start)
        errors.append(tilt_error(advanced(attitude, 20).R_NB, np.eye(3)))
    assert errors[0] == errors[1]
    assert errors[2] < 0.6 * errors[1] < 0.5 * tilt_error(off, np.eye(3))


def test_levelling_leaves_a_rotating_level_device_unchanged():
    attitude = advanced(LevelledAttitude(start_at(np.eye(3))), 100, 11, (0.0, 0.0, 2.0))
    expected = exp_so3(np.array([0.0, 0.0, 2.0 * 100 * 0.05]))
    np.testing.assert_allclose(attitude.R_NB, expected, atol=1e-9)


def test_free_fall_and_a_dead_accelerometer_leave_the_attitude_finite():
    time = np.arange(11) / 200.0
    attitude = LevelledAttitude(start_at(np.eye(3)))
    attitude.advance(time, np.full((11, 3), 0.1), np.zeros((11, 3)))
    expected = exp_so3(np.full(3, 0.1 * 0.05))
    np.testing.assert_allclose(attitude.R_NB, expected, atol=1e-9)
    start = start_from_gravity(time, np.zeros((11, 3)), np.zeros((11, 3)))
    assert np.isfinite(start.R_WB).all()


def test_integration_of_a_constant_rate_is_exact():
    rate = np.array([0.7, -1.9, 2.3])
    time = np.cumsum(np.random.default_rng(0).uniform(0.002, 0.02, 300))
    R = integrate(np.eye(3), time, np.tile(rate, (300, 1)))
    expected = Rotation.from_rotvec(np.outer(time - time[0], rate)).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-10)


def test_integration_of_coning_motion_matches_fine_steps():
    """The rotation axis itself rotates; integrating the mean rate alone would drift steadily."""
    w = 2.0 * np.pi * 5.0
    time = np.arange(0.0, 2.0001, 1.0 / 100.0)
    gyro = np.stack([3.0 * np.cos(w * time), 3.0 * np.sin(w * time), 0.2 + 0.0 * time], axis=1)
    fine = np.linspace(0.0, time[-1], 20 * (len(time) - 1) + 1)
    between = np.stack([np.interp(fine, time, gyro[:, k]) for k in range(3)], axis=1)

    def by_mean_rates(t, rate):
        turns = Rotation.from_rotvec(0.5 * (rate[1:] + rate[:-1]) * np.diff(t)[:, None])
        R = Rotation.identity()
        for turn in turns:
            R = R * turn
        return R

    truth = by_mean_rates(fine, between)
    ours = Rotation.from_matrix(integrate(np.eye(3), time, gyro)[-1])
    plain = by_mean_rates(time, gyro)
    assert (truth.inv() * ours).magnitude() < 2e-4
    assert (truth.inv() * ours).magnitude() < 0.05 * (truth.inv() * plain).magnitude()
