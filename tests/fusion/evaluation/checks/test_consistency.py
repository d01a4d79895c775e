"""Monte Carlo test of the filter's consistency.

The average NEES of N runs of a consistent filter follows chi-square with 15 N degrees of freedom,
divided by N.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stario.fusion.evaluation.checks.consistency import (
    YAW_SIGMA,
    consistency,
    consistency_text,
    summary,
)
from stario.fusion.evaluation.scores import joined
from stario.fusion.values.config import FilterConfig, NavigatorConfig
from stario.sequences import PHONE_IMU, ImuNoise, InputError
from stario.sequences.accuracy.nees import nees_bounds

# Initial errors of metres per second and degrees of yaw interact beyond first order.
CONFIG = NavigatorConfig(noise=ImuNoise(), filter=FilterConfig(velocity_sigma=0.1))
BIASES = {"gyro_bias_sigma": PHONE_IMU.gyro_turn_on, "accel_bias_sigma": PHONE_IMU.accel_turn_on}
PHONE = NavigatorConfig(noise=PHONE_IMU.noise, filter=FilterConfig(velocity_sigma=0.1, **BIASES))


def averages(config: NavigatorConfig, runs: int = 20, seconds: float = 300.0) -> SimpleNamespace:
    scores = joined(consistency(config, seconds=seconds, seed=seed) for seed in range(runs))
    return SimpleNamespace(**summary(scores, seconds))


def assert_consistent(result: SimpleNamespace) -> None:
    low, high = nees_bounds(15, result.runs, confidence=0.999)  # few seeds
    assert low < result.nees < high
    assert low < result.nees_end < high
    assert 0.5 < result.yaw < 1.7
    assert 2.5 < result.nis < 3.5


def test_nees_of_a_short_walk_is_within_its_bounds():
    assert_consistent(averages(CONFIG, runs=10, seconds=12.0))


@pytest.mark.slow
def test_nees_of_five_minutes_is_within_its_bounds():
    result = averages(CONFIG, seconds=300.0)
    assert 12.7 < result.nees < 17.5
    assert_consistent(result)


@pytest.mark.slow
def test_nees_of_a_quarter_of_an_hour_with_a_phone_is_within_its_bounds():
    # A hand's tilts show little of the bias about the vertical to gravity: yaw drifts.
    result = averages(PHONE, seconds=900.0)
    assert result.yaw_sigma > 1.2 * YAW_SIGMA
    assert 12.7 < result.nees < 17.5
    assert 0.5 < result.yaw < 1.7


def test_runs_are_determined_by_the_seed():
    first, again, other = (consistency(CONFIG, seconds=5.0, seed=seed) for seed in (3, 3, 4))
    assert "2 runs of 5 s" in consistency_text(summary(joined([first, other]), 5.0))
    assert first.equals(again)
    assert not first.drop(columns="recording").equals(other.drop(columns="recording"))


def test_the_filter_is_consistent_at_one_update_a_second():
    config = replace(CONFIG, filter=replace(CONFIG.filter, update_rate=1))
    result = averages(config, runs=6, seconds=10.0)
    # Chi-square with 90 degrees of freedom, divided by six runs: 99.9 % lies below 22.9.
    assert 9.0 < result.nees_end < 22.9
    assert 2.0 < result.nis < 3.6


@pytest.mark.parametrize("seconds", [1.5, np.nan])
def test_a_duration_below_two_seconds_is_refused(seconds):
    with pytest.raises(InputError, match="at least 2 s"):
        consistency(CONFIG, seconds=seconds)
