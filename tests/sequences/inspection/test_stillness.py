import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import ImuNoise, WalkStyle, generate_walk, simulate_imu
from stario.sequences.inspection.stillness import find_rest, scatter_bound
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence

NOISE = ImuNoise(gyro_noise=8e-4, accel_noise=6e-3)
BIAS = np.array([0.01, -0.02, 0.005])
UP_B = np.array([0.6, 0.0, 0.8])


def device_at_rest(seconds: float, rate: float, seed: int = 0) -> ImuSequence:
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    gyro = BIAS + NOISE.gyro_noise * np.sqrt(rate) * rng.normal(size=(len(time), 3))
    accel = (STANDARD_GRAVITY + 0.05) * UP_B
    accel = accel + NOISE.accel_noise * np.sqrt(rate) * rng.normal(size=(len(time), 3))
    return ImuSequence("lying", time, gyro, accel)


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_noise_and_bias_match_the_sensor_at_any_rate(rate):
    rest = find_rest(device_at_rest(60.0, rate))
    assert rest.seconds == pytest.approx(60.0, abs=0.6)
    assert len(rest.stretches) == 1
    np.testing.assert_allclose(rest.gyro_bias_rad_s, BIAS, atol=5e-4)
    assert rest.accel_norm_m_s2 == pytest.approx(STANDARD_GRAVITY + 0.05, abs=2e-3)
    assert rest.gyro_noise_rad_s_sqrt_hz == pytest.approx(NOISE.gyro_noise, rel=0.1)
    assert rest.accel_noise_m_s2_sqrt_hz == pytest.approx(NOISE.accel_noise, rel=0.1)


def test_a_walk_contains_no_rest_and_less_than_a_second_is_too_short():
    assert find_rest(device_at_rest(0.8, 100.0)) is None
    assert find_rest(device_at_rest(0.2, 100.0)) is None
    assert find_rest(simulate_imu(generate_walk(2, 20.0, style=WalkStyle()), 200.0)) is None


def test_rest_is_found_between_motions_but_not_across_a_gap():
    still = device_at_rest(10.0, 100.0)
    rng = np.random.default_rng(1)
    gyro = still.gyro.copy()
    gyro[300:500] += rng.normal(size=(200, 3)).cumsum(axis=0) * 0.05
    time = still.time + np.where(np.arange(len(still)) >= 700, 2.0, 0.0)
    rest = find_rest(ImuSequence("m", time, gyro, still.accel))
    (a, b), (c, d), (e, f) = rest.stretches
    assert a == 0.0
    assert 2.4 <= b <= 3.0
    assert 5.0 <= c <= 5.6
    assert d <= 7.0
    assert e >= 9.0
    assert f == pytest.approx(12.0, abs=0.5)


def test_a_slow_turn_is_no_bias_and_a_large_bias_without_a_turn_is_one():
    still = device_at_rest(10.0, 100.0)
    about_up = ImuSequence("t", still.time, still.gyro + 0.1 * UP_B, still.accel)
    assert find_rest(about_up) is None
    rate = np.array([0.0, 0.1, 0.0])
    gravity = Rotation.from_rotvec(-np.outer(still.time, rate)).apply(still.accel)
    assert find_rest(ImuSequence("t", still.time, still.gyro + rate, gravity)) is None
    still, bias = device_at_rest(10.0, 100.0), np.array([-0.12, 0.0, 0.02])
    rest = find_rest(ImuSequence("t", still.time, still.gyro - BIAS + bias, still.accel))
    assert rest.seconds == pytest.approx(10.0, abs=0.6)
    np.testing.assert_allclose(rest.gyro_bias_rad_s, bias, atol=1e-3)


def test_one_in_a_thousand_stretches_at_rest_fails_the_test_whatever_their_length():
    for count in (3, 20):
        white = np.random.default_rng(0).normal(size=(200_000 // count, count, 3)) * np.sqrt(100.0)
        squares = np.square(white - white.mean(axis=1, keepdims=True)).sum(axis=(1, 2))
        failing = (squares > scatter_bound(count, count / 100.0, 1.0)).mean()
        assert 0.0005 < failing < 0.0015
