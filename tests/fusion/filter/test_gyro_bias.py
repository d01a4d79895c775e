"""The gyroscope bias's prior is replaced exactly and is as wide as the evidence requires."""

from dataclasses import replace

import numpy as np
import pytest
from initial_ekf import Driven
from support import lying, nav_state

from stario.fusion import Navigator, NavigatorConfig, UpdateResult
from stario.fusion.filter import estimator
from stario.fusion.filter.gyro_bias import GyroBiasPrior, with_prior_replaced
from stario.fusion.filter.innovations import InnovationStatistics
from stario.sequences import ImuSequence


def ekf_with_measured_bias(sigma: float) -> Driven:
    """A filter with a prior of the bias, after two measurements of its sum with other states."""
    ekf = Driven(slots=1)
    ekf.initialise(nav_state(np.diag(np.repeat([1e-2, 0.5, 1.0, sigma**2, 1e-2], 3))))
    ekf.clone()
    for value, share in (([2e-3, -1e-3, 4e-3], 0.1), ([1e-3, 2e-3, -3e-3], 0.4)):
        blocks = [(9, np.eye(3)), (12, share * np.eye(3))]
        ekf.update_linear(np.array(value) - ekf.state.b_g, blocks, 1e-6 * np.eye(3))
    return ekf


@pytest.mark.parametrize("new", [1e-4, 2e-3, 1e-2])
def test_replacing_the_prior_equals_having_started_with_it(new):
    old = 1e-3
    ekf = ekf_with_measured_bias(old)
    ekf.state = with_prior_replaced(ekf.state, old**2, new**2)
    expected = ekf_with_measured_bias(new).state
    # Both compute the second residual with b_a as zero, so the comparison is linear.
    np.testing.assert_allclose(ekf.state.P, expected.P, rtol=1e-5, atol=1e-4 * new**2)


def test_a_wider_prior_adds_as_much_to_an_error_that_is_larger_than_assumed():
    """What the gains forget, the error gains; the rest of it stays."""
    ekf = ekf_with_measured_bias(1e-3)
    root = 1e-3 * np.random.default_rng(0).normal(size=ekf.P.shape)
    ekf.covariances = np.stack([ekf.P, ekf.P + root @ root.T])
    ekf.state = with_prior_replaced(ekf.state, 1e-6, 1e-4)
    np.testing.assert_allclose(ekf.state.P_reported - ekf.P, root @ root.T, atol=1e-10)


def test_a_bias_that_has_wandered_beyond_its_prior_keeps_a_valid_covariance():
    """No more information can be removed than there is."""
    ekf = ekf_with_measured_bias(1e-3)
    P = ekf.P.copy()
    P[9:12, 9:12] += 2e-6 * np.eye(3)  # a random walk, twice the prior's variance
    ekf.P = P
    core = slice(0, 15)  # a new clone duplicates the pose, so that the whole P is singular
    before = np.linalg.eigvalsh(P[core, core]).min()
    ekf.state = with_prior_replaced(ekf.state, 1e-6, 1e-5)
    assert np.linalg.eigvalsh(ekf.P[core, core]).min() > 0.5 * before
    assert (np.diag(ekf.P)[9:12] <= 10.0 * np.diag(P)[9:12] * (1.0 + 1e-6)).all()
    assert (np.diag(ekf.P)[9:12] > np.diag(P)[9:12]).all()


def converged(data: float, sigma: float, prior: GyroBiasPrior | None = None) -> float:
    """Sigma of the prior once it follows the data, an estimate of each axis with this sigma."""
    prior = prior or GyroBiasPrior(1e-3, 1e-6)
    for _ in range(200):
        share = prior.variance / (prior.variance + sigma**2)
        b_g, P = np.array([data, 0.0, 0.0]) * share, share * sigma**2 * np.eye(3)
        prior = prior.updated(b_g, P, walked=0.0)
    return float(np.sqrt(prior.variance))


def test_the_prior_follows_a_bias_that_the_data_clearly_show_and_forgets_it():
    assert 0.02 < converged(0.05, 1e-3) < 0.05
    assert converged(0.01, 1e-3) < 0.01
    assert converged(0.0, 1e-3, GyroBiasPrior(1e-3, 0.03**2)) < 1.5e-3


@pytest.mark.parametrize(("bias", "sigma"), [(8e-3, 2e-2), (1e-3, 3e-4), (0.0, 1e-4)])
def test_vague_or_small_data_leave_the_prior_narrow(bias, sigma):
    """Displacements alone determine it to 2e-2 rad/s: their slow errors look like a bias."""
    assert 1e-3 <= converged(bias, sigma) < 2.5e-3


RAW = np.array([0.04, -0.03, 0.05])
"""Bias of an iPhone 5 [rad/s]."""


def biased(walk: ImuSequence, bias: np.ndarray) -> ImuSequence:
    return replace(walk, gyro=walk.gyro + bias)


def test_a_raw_bias_is_within_its_sigma_on_every_axis(make_walk, make_oracle):
    config = NavigatorConfig()
    walk = biased(make_walk(seed=6, seconds=40.0), RAW)
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
    walk = biased(make_walk(seed=4, seconds=20.0, rate=50.0), np.array([size, 0.0, 0.0]))
    preprocessed = Navigator(make_oracle(walk, walk.truth, config), config).observe(walk)
    state = estimator.begin(config, preprocessed.start)
    for interval, measured in zip(preprocessed.intervals, preprocessed.measurements, strict=True):
        state, _ = estimator.step(state, interval, measured, (), config)
    assert 1e-3 <= np.sqrt(state.bias_prior.variance) < max(2.5e-3, size)


def test_the_track_changes_continuously_with_the_bias(make_walk, make_oracle):
    """A slightly larger bias widens the prior slightly: similar recordings end close together."""
    ends = []
    for size in (0.030, 0.0302):
        walk = biased(make_walk(seed=2, seconds=30.0, rate=50.0), np.array([size, 0.0, 0.0]))
        config = NavigatorConfig()
        track = Navigator(make_oracle(walk, walk.truth, config), config, backend="ekf").run(walk)
        ends.append(track.trajectory.position_W[-1])
    assert np.linalg.norm(ends[1] - ends[0]) < 0.1


def test_apparent_rest_that_lasts_long_is_rest(still_model):
    """Flat on a table, gravity does not reveal an uncorrected bias about the vertical."""
    bias = np.array([0.002, -0.001, 0.05])
    graph = Navigator(still_model).run(lying(45.0, 50.0, bias, 2e-3, 0.02))
    for track in (graph, graph.filtered):
        np.testing.assert_allclose(track.arrays()["gyro_bias_B"][-1], bias, atol=1e-3)
        yaw = np.unwrap(track.trajectory.attitude_WB.as_euler("ZYX")[:, 0])
        assert abs(yaw[-1] - yaw[0]) < 0.1


def final_factor(oracle: object, walk: ImuSequence, shake=0.0, false=range(0)) -> float:
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
    walk, config = make_walk(seed=4, seconds=26.0, rate=50.0), NavigatorConfig()
    oracle = make_oracle(walk, walk.truth, config, noise=0.03, sigma=0.05)
    assert final_factor(oracle, walk) < 1.5
    assert final_factor(oracle, walk, shake=3.0) > 2.5
    assert final_factor(oracle, walk, false=range(200, 250)) < 2.5  # outliers for five seconds


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
