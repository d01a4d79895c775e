"""The accelerometer's noise factor follows the innovations, but not a few false displacements."""

from dataclasses import replace

import numpy as np
import pytest

from stario.fusion import Navigator, NavigatorConfig
from stario.fusion.filter import estimator
from stario.fusion.filter.innovations import InnovationStatistics
from stario.fusion.filter.kalman import UpdateResult
from stario.sequences.sequence import ImuSequence


def final_factor(
    oracle: object, walk: ImuSequence, shake: float = 0.0, false: range = range(0)
) -> float:
    """Factor with accelerometer errors `shake` [m/s^2] of 0.1 s each and `false` displacements."""
    config, rng = NavigatorConfig(), np.random.default_rng(3)
    preprocessed = Navigator(oracle, config).observe(walk)
    state = estimator.begin(config, preprocessed.start)
    pairs = zip(preprocessed.intervals, preprocessed.measurements, strict=True)
    for k, (interval, measured) in enumerate(pairs):
        table = interval.table.copy()
        table[:, 4:] += rng.normal(0.0, shake, 3)
        if measured is not None and k in false:
            measured = measured._replace(d_N=measured.d_N + np.eye(3)[0])
        shaken = replace(interval, table=table)
        state, _ = estimator.step(state, shaken, measured, (), config)
    return state.statistics.accel_factor


def test_the_factor_rises_for_a_bad_accelerometer_but_not_for_outliers(make_walk, make_oracle):
    walk, config = make_walk(seed=4, seconds=40.0), NavigatorConfig()
    oracle = make_oracle(walk, walk.truth, config, noise=0.03, sigma=0.05)
    assert final_factor(oracle, walk) < 1.5
    assert final_factor(oracle, walk, shake=3.0) > 2.5
    assert final_factor(oracle, walk, false=range(340, 390)) < 2.5  # outliers for five seconds


@pytest.mark.parametrize(("nis", "sign"), [(1e9, 1), (0.0, -1)])
def test_one_displacement_moves_the_log_factor_by_the_gain_at_most(nis, sign):
    before = InnovationStatistics(log_accel_factor=1.0, gain=0.05)
    after = before.updated(UpdateResult(nis=nis, gate_nis=nis), NavigatorConfig().filter)
    change = after.log_accel_factor - before.log_accel_factor
    assert change == pytest.approx(sign * 0.05, abs=1e-6)


def test_an_update_without_innovation_leaves_the_noise_unchanged():
    before = InnovationStatistics(log_accel_factor=1.0, log_error_level=1.0)
    after = before.updated(UpdateResult("value that is not finite"), NavigatorConfig().filter)
    assert replace(after, outlier_share=before.outlier_share) == before
