"""The gyroscope bias's prior is replaced exactly and is as wide as the evidence requires."""

from __future__ import annotations

import numpy as np
import pytest

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.gyro_bias import GyroBiasPrior, replace_prior
from stario.fusion.state import NavState


def ekf_with_measured_bias(sigma: float) -> StateCloningEkf:
    """A filter with a prior of the bias, after two measurements of its sum with other states."""
    ekf = StateCloningEkf(slots=1)
    zero = np.zeros(3)
    variances = np.repeat([1e-2, 0.5, 1.0, sigma**2, 1e-2], 3)
    ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, np.diag(variances)))
    ekf.clone()
    for value, share in (([2e-3, -1e-3, 4e-3], 0.1), ([1e-3, 2e-3, -3e-3], 0.4)):
        blocks = [(9, np.eye(3)), (12, share * np.eye(3))]
        ekf.update_linear(np.array(value) - ekf.state.b_g, blocks, 1e-6 * np.eye(3))
    return ekf


@pytest.mark.parametrize("new", [1e-4, 2e-3, 1e-2])
def test_replacing_the_prior_equals_having_started_with_it(new: float) -> None:
    old = 1e-3
    ekf = ekf_with_measured_bias(old)
    replace_prior(ekf, old**2, new**2)
    expected = ekf_with_measured_bias(new).state
    # Both compute the second residual with b_a as zero, so the comparison is linear.
    np.testing.assert_allclose(ekf.state.P, expected.P, rtol=1e-5, atol=1e-4 * new**2)


def test_a_wider_prior_adds_as_much_to_an_error_that_is_larger_than_assumed() -> None:
    """What the gains forget, the error gains; the rest of it stays."""
    ekf = ekf_with_measured_bias(1e-3)
    root = 1e-3 * np.random.default_rng(0).normal(size=ekf.P.shape)
    ekf.covariances = np.stack([ekf.P, ekf.P + root @ root.T])
    replace_prior(ekf, 1e-6, 1e-4)
    np.testing.assert_allclose(ekf.state.P_actual - ekf.P, root @ root.T, atol=1e-10)


def test_a_bias_that_has_wandered_beyond_its_prior_keeps_a_valid_covariance() -> None:
    """No more information can be removed than there is."""
    ekf = ekf_with_measured_bias(1e-3)
    P = ekf.P.copy()
    P[9:12, 9:12] += 2e-6 * np.eye(3)  # a random walk, twice the prior's variance
    ekf.P = P
    core = slice(0, 15)  # a new clone duplicates the pose, so that the whole P is singular
    before = np.linalg.eigvalsh(P[core, core]).min()
    replace_prior(ekf, 1e-6, 1e-5)
    assert np.linalg.eigvalsh(ekf.P[core, core]).min() > 0.5 * before
    assert (np.diag(ekf.P)[9:12] <= 10.0 * np.diag(P)[9:12] * (1.0 + 1e-6)).all()
    assert (np.diag(ekf.P)[9:12] > np.diag(P)[9:12]).all()


def updated(prior: GyroBiasPrior, b: float, sigma: float, levelled: float = 0.0) -> GyroBiasPrior:
    P = np.diag([prior.variance, prior.variance, sigma**2])
    return prior.updated(levelled, 0.0, np.array([0.0, 0.0, b]), P, wander=0.0)


def test_a_bias_that_the_data_clearly_show_widens_the_prior() -> None:
    prior = GyroBiasPrior(1e-3, 1e-6)
    # Posterior of a measured 8e-3 +- 1e-3: half of it, since the prior is as certain.
    wider = updated(prior, 4e-3, 1e-3 / np.sqrt(2.0))
    assert wider.variance == pytest.approx(8e-3**2 - 3e-3**2)


@pytest.mark.parametrize(("b", "e"), [(8e-3, 2e-2), (2.5e-3, 1e-3)])
def test_vague_or_consistent_data_leave_the_prior_unchanged(b: float, e: float) -> None:
    """Displacements alone determine it to 2e-2 rad/s: their slow errors look like a bias."""
    prior, share = GyroBiasPrior(1e-3, 1e-6), 1e-6 / (1e-6 + e**2)
    assert updated(prior, share * b, np.sqrt(share) * e).variance == pytest.approx(1e-6)


def test_the_prior_is_wide_until_levelled_and_stays_wide_for_raw_rates() -> None:
    first = GyroBiasPrior(1e-3, 1e-6)
    nothing = np.zeros(3), first.variance * np.eye(3), 0.0
    early = first.updated(0.0, 1e-2, *nothing)
    late = early.updated(0.0, 1e-3, *nothing)
    assert 3e-3 < np.sqrt(early.variance) < 6e-3
    assert np.sqrt(late.variance) < 1.2e-3
    uncorrected = late.updated(0.05, 1e-3, *nothing).updated(0.02, 1e-3, *nothing)
    assert np.sqrt(uncorrected.variance) > 0.03
