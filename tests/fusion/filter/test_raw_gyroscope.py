"""A gyroscope with uncorrected bias: gravity reveals it, and the filter's prior widens."""

from dataclasses import replace

import numpy as np
import pytest

from stario.fusion import Navigator, NavigatorConfig
from stario.fusion.filter import estimator
from stario.sequences import ImuSequence

RAW = np.array([0.04, -0.03, 0.05])
"""Bias of an iPhone 5 [rad/s]."""


def biased(walk: ImuSequence, bias: np.ndarray) -> ImuSequence:
    return replace(walk, gyro=walk.gyro + bias)


def test_a_raw_bias_is_within_its_sigma_on_every_axis(make_walk, make_oracle):
    config = NavigatorConfig()
    walk = biased(make_walk(seed=2, seconds=40.0), RAW)
    track = Navigator(make_oracle(walk, walk.truth, config), config, backend="ekf").run(walk)
    error = track.arrays()["gyro_bias_B"][-1] - RAW
    sigma = np.sqrt(np.diagonal(track.covariance[-1])[9:12])
    # Forty seconds do not determine it well; a prior of 2.5e-3 rad/s would have excluded it.
    assert np.linalg.norm(error) < 0.6 * np.linalg.norm(RAW)
    assert (np.abs(error) < 3.0 * sigma).all()


@pytest.mark.parametrize("size", [0.0, 6e-3])
def test_a_corrected_gyroscope_keeps_its_prior(make_walk, make_oracle, size):
    """As wide as such a bias, and no wider."""
    config = NavigatorConfig()
    walk = biased(make_walk(seed=4, seconds=20.0), np.array([size, 0.0, 0.0]))
    preprocessed = Navigator(make_oracle(walk, walk.truth, config), config).observe(walk)
    state = estimator.begin(config, preprocessed.start)
    for interval, measured in zip(preprocessed.intervals, preprocessed.measurements, strict=True):
        state, _ = estimator.step(state, interval, measured, (), config)
    assert 1e-3 <= np.sqrt(state.bias_prior.variance) < max(2.5e-3, size)


def test_the_track_changes_continuously_with_the_bias(make_walk, make_oracle):
    """A slightly larger bias widens the prior slightly: similar recordings end close together."""
    ends = []
    for size in (0.030, 0.0302):
        walk = biased(make_walk(seed=2, seconds=30.0), np.array([size, 0.0, 0.0]))
        config = NavigatorConfig()
        track = Navigator(make_oracle(walk, walk.truth, config), config, backend="ekf").run(walk)
        ends.append(track.trajectory.position_W[-1])
    assert np.linalg.norm(ends[1] - ends[0]) < 0.1


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_apparent_rest_that_lasts_long_is_rest(still_model, backend):
    """Flat on a table, gravity does not reveal an uncorrected bias about the vertical."""
    rng, n, bias = np.random.default_rng(1), 4500, np.array([0.002, -0.001, 0.05])
    gyro = bias + rng.normal(0.0, 2e-3, (n, 3))
    accel = np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.02, (n, 3))
    still = ImuSequence(name="table", time=np.arange(n) / 100.0, gyro=gyro, accel=accel)
    track = Navigator(still_model, backend=backend).run(still)
    np.testing.assert_allclose(track.arrays()["gyro_bias_B"][-1], bias, atol=1e-3)
    yaw = np.unwrap(track.trajectory.attitude_WB.as_euler("ZYX")[:, 0])
    assert abs(yaw[-1] - yaw[0]) < 0.1
