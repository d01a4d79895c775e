"""Monte Carlo: does the filter know how wrong it is?

The average NEES of N runs of an honest filter follows chi-square with 15 N degrees of freedom,
divided by N.
"""

import numpy as np
import pytest

from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.consistency import Consistency, Trial, analytic_walk, consistency, trial_of
from stario.fusion.lie import exp_so3
from stario.fusion.preintegration import preintegrate
from stario.sequences.errors import InputError
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.simulate import PHONE_IMU

TRIAL = Trial(noise=ImuNoise())
PHONE = Trial(
    noise=PHONE_IMU.noise,
    gyro_bias_sigma=PHONE_IMU.gyro_turn_on,
    accel_bias_sigma=PHONE_IMU.accel_turn_on,
)


def assert_honest(result: Consistency) -> None:
    low, high = result.nees_bounds
    assert low < result.nees < high
    assert low < result.nees_end < high
    assert 0.5 < result.yaw < 1.7
    assert 2.5 < result.nis < 3.5


def test_nees_of_a_minute_is_within_its_bounds() -> None:
    assert_honest(consistency(TRIAL, seconds=60.0))


@pytest.mark.slow
def test_nees_of_five_minutes_is_within_its_bounds() -> None:
    result = consistency(TRIAL, seconds=300.0)
    assert 12.7 < result.nees < 17.5
    assert_honest(result)


@pytest.mark.slow
def test_nees_of_half_an_hour_with_a_phone_is_within_its_bounds() -> None:
    result = consistency(PHONE, seconds=1800.0)
    assert 12.7 < result.nees < 17.5
    assert 0.5 < result.yaw < 1.7


def test_the_analytic_walk_is_its_own_dead_reckoning() -> None:
    walk = analytic_walk(5.0, np.random.default_rng(0), STANDARD_GRAVITY)
    R, v, p, zero = walk.R_WB[0], walk.v_W[0], walk.p_W[0], np.zeros(3)
    for k in range(0, len(walk.time) - 1, 20):
        part = slice(k, k + 21)
        samples = walk.time[part], walk.gyro[part], walk.accel[part]
        segment = preintegrate(*samples, zero, zero, ImuNoise(), STANDARD_GRAVITY)
        R, v, p = segment.predict(R, v, p, zero, zero)
    np.testing.assert_allclose(p, walk.p_W[-1], atol=2e-3)
    np.testing.assert_allclose(v, walk.v_W[-1], atol=2e-3)
    np.testing.assert_allclose(R, walk.R_WB[-1], atol=1e-3)
    np.testing.assert_allclose(exp_so3(zero), np.eye(3))


def test_runs_come_from_the_seed() -> None:
    first, again = (consistency(TRIAL, runs=2, seconds=5.0, seed=3) for _ in range(2))
    assert first == again
    assert first != consistency(TRIAL, runs=2, seconds=5.0, seed=4)


def test_a_trial_takes_its_sizes_from_a_configuration() -> None:
    config = NavigatorConfig(
        ImuNoise(gyro_noise=5e-3), FilterConfig(tilt_sigma=0.2, gyro_bias_sigma=7e-3), gravity=9.81
    )
    trial = trial_of(config, 0.3)
    assert trial.noise.gyro_noise == 5e-3
    assert (trial.tilt_sigma, trial.gyro_bias_sigma, trial.gravity) == (0.2, 7e-3, 9.81)
    np.testing.assert_allclose(trial.sigma[:3], [0.2, 0.2, 0.3])
    assert any("expected 15" in line for line in consistency(trial, 1, 2.0).lines())


@pytest.mark.parametrize(("runs", "seconds"), [(0, 10.0), (1, 0.5), (1, np.nan)])
def test_nothing_to_run_is_refused(runs: int, seconds: float) -> None:
    with pytest.raises(InputError, match="at least 1 run"):
        consistency(TRIAL, runs, seconds)
