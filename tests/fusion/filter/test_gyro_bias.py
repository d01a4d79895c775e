"""The gyroscope bias's prior is replaced exactly and is as wide as the evidence requires."""

import numpy as np
import pytest
from initial_ekf import Driven

from stario.fusion.filter.gyro_bias import GyroBiasPrior, with_prior_replaced
from stario.fusion.values.state import NavState


def ekf_with_measured_bias(sigma: float) -> Driven:
    """A filter with a prior of the bias, after two measurements of its sum with other states."""
    ekf = Driven(slots=1)
    zero = np.zeros(3)
    variances = np.repeat([1e-2, 0.5, 1.0, sigma**2, 1e-2], 3)
    ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, np.diag(variances)))
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


def test_the_prior_follows_a_bias_that_the_data_clearly_show():
    assert 0.02 < converged(0.05, 1e-3) < 0.05
    assert converged(0.01, 1e-3) < 0.01


@pytest.mark.parametrize(("bias", "sigma"), [(8e-3, 2e-2), (1e-3, 3e-4), (0.0, 1e-4)])
def test_vague_or_small_data_leave_the_prior_narrow(bias, sigma):
    """Displacements alone determine it to 2e-2 rad/s: their slow errors look like a bias."""
    assert 1e-3 <= converged(bias, sigma) < 2.5e-3


def test_a_bias_that_the_data_no_longer_show_is_forgotten():
    """What a shaken gyroscope seemed to have does not stay."""
    wide = GyroBiasPrior(1e-3, 0.03**2)
    assert converged(0.0, 1e-3, wide) < 1.5e-3
