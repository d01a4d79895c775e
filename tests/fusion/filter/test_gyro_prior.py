"""Two priors of the gyroscope's bias in one filter."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import support

from stario.fusion import Navigator
from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.estimate import nav_states, smoothed_poses
from stario.fusion.filter.estimator import Estimator
from stario.fusion.filter.gyro_prior import GyroPosterior, GyroPrior
from stario.fusion.fixes import position_fix
from stario.sequences.errors import ConfigError
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import ImuErrors

Make = Callable[..., Any]

NARROW, WIDE = 5e-4, 4e-3


def configured(**values: float) -> NavigatorConfig:
    """The tests' filter, twice a second, with a prior of its own and a bias that stays."""
    noise = replace(support.NOISE, gyro_walk=1e-7)
    return NavigatorConfig(noise, replace(support.GRAPH.filter, **values))


MIXED = configured(gyro_bias_sigma=WIDE, gyro_corrected_sigma=NARROW, gyro_corrected=0.5)
CERTAIN = configured(gyro_bias_sigma=WIDE, gyro_corrected_sigma=NARROW, gyro_corrected=1.0 - 1e-9)
ONLY_WIDE = configured(gyro_bias_sigma=WIDE, gyro_corrected=0.0)
ONLY_NARROW = configured(gyro_bias_sigma=NARROW, gyro_corrected=0.0)


def believed(estimator: Estimator) -> GyroPosterior | None:
    now = estimator.estimate()
    return estimator.gyro_prior.posterior(np.array(now.time), now.b_g, now.P_gg)


def run(config: NavigatorConfig, sequence: ImuSequence, oracle: Any) -> tuple[Estimator, float]:
    """The filter behind a recording, and the log-likelihood of all that it was told."""
    seen = Navigator(oracle, config).observe(sequence)
    assert seen.front_end.start is not None
    estimator, evidence = Estimator(config, seen.front_end.start), 0.0
    for interval, measurement in zip(seen.intervals, seen.measurements, strict=True):
        estimator.step(interval, measurement)
        evidence += estimator.ekf.log_likelihood if measurement is not None else 0.0
    assert not estimator.innovations().gated.any()
    return estimator, evidence


@pytest.fixture(scope="module", params=[0.0, 6e-4, 2e-3], ids=["none", "small", "large"])
def walked(request: Any, make_walk: Make, make_oracle: Make) -> tuple[float, ImuSequence, Any]:
    """A walk of a minute with a bias about every axis [rad/s], and its oracle."""
    errors = ImuErrors(noise=MIXED.noise, gyro_turn_on=0.0, accel_turn_on=0.05)
    walk = make_walk(3, 60.0, 100.0, errors)
    walk = replace(walk, gyro=walk.gyro + request.param)
    return request.param, walk, make_oracle(walk, walk.truth, MIXED, noise=0.05, sigma=0.05)


def test_the_odds_are_the_ratio_of_two_filters_evidences(
    walked: tuple[float, ImuSequence, Any],
) -> None:
    _, walk, oracle = walked
    evidences = [run(config, walk, oracle)[1] for config in (ONLY_NARROW, ONLY_WIDE)]
    posterior = believed(run(MIXED, walk, oracle)[0])
    assert posterior is not None
    odds = np.log(posterior.weight / (1.0 - posterior.weight))
    assert odds == pytest.approx(evidences[0] - evidences[1], abs=0.1)


def test_certain_of_the_narrow_prior_the_state_is_that_filters(
    walked: tuple[float, ImuSequence, Any],
) -> None:
    """Whatever the bias is in truth: conditioning is what the other filter does."""
    _, walk, oracle = walked
    narrow = run(ONLY_NARROW, walk, oracle)[0].nav_state()
    estimator = run(MIXED, walk, oracle)[0]
    wide, certain = estimator.filtered(), GyroPrior(CERTAIN, estimator.gyro_prior._start)
    state = nav_states([estimator.estimate()], certain)[0]
    for name in ("R_WB", "v_W", "p_W", "b_g"):
        apart = np.abs(getattr(wide, name) - getattr(narrow, name)).max()
        assert np.abs(getattr(state, name) - getattr(narrow, name)).max() < 0.03 * apart, name
    sigmas = [np.sqrt(np.diag(s.covariance)) for s in (state, narrow)]
    np.testing.assert_allclose(*sigmas, rtol=0.02)


def test_corrected_devices_are_told_from_others(walked: tuple[float, ImuSequence, Any]) -> None:
    bias, walk, oracle = walked
    estimator = run(MIXED, walk, oracle)[0]
    posterior = believed(estimator)
    assert posterior is not None
    assert posterior.weight < 0.2 if bias > 1e-3 else posterior.weight > 0.8
    state, wide = estimator.nav_state(), estimator.filtered()
    if bias <= 1e-3:  # what does not depend on the mixture is better known by it
        assert np.linalg.norm(state.b_g - bias) < np.linalg.norm(wide.b_g - bias)
        assert state.covariance[2, 2] < 0.5 * wide.covariance[2, 2]


def test_a_mixture_has_the_moments_of_its_parts() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    P, b = root @ root.T, rng.normal(size=3)  # error and bias
    S = P[3:, 3:] + 0.5 * np.eye(3)
    gain = P[:, 3:] @ np.linalg.inv(S)
    posterior = GyroPosterior(np.array(0.3), np.linalg.solve(S, b), np.linalg.inv(S))
    mean, covariance = posterior.moments(P, P[:, 3:])
    parts = [(0.7, np.zeros(6), P), (0.3, -gain @ b, P - gain @ P[3:])]
    expected = sum(w * m for w, m, _ in parts)
    second = sum(w * (C + np.outer(m, m)) for w, m, C in parts)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    np.testing.assert_allclose(covariance, second - np.outer(expected, expected), atol=1e-12)


@pytest.mark.parametrize("alone", [{"gyro_corrected": 0.0}, {"gyro_corrected_sigma": WIDE}])
def test_without_a_narrower_prior_there_is_no_mixture(
    alone: dict[str, float], make_walk: Make, make_oracle: Make
) -> None:
    walk = make_walk()
    config = configured(gyro_bias_sigma=WIDE, **alone)
    estimator, _ = run(config, walk, make_oracle(walk, walk.truth, config))
    assert believed(estimator) is None
    assert estimator.expected_gyro_bias() is None
    np.testing.assert_array_equal(estimator.nav_state().p_W, estimator.filtered().p_W)
    np.testing.assert_array_equal(estimator.nav_state().covariance, estimator.filtered().covariance)


def test_a_clone_is_settled_as_the_state_it_is_a_copy_of(
    make_walk: Make, make_oracle: Make
) -> None:
    walk = make_walk()
    estimator, _ = run(MIXED, walk, make_oracle(walk, walk.truth, MIXED))
    state = estimator.nav_state()  # its newest clone was taken at this time
    clone = estimator.ekf.state.clone_estimate(estimator._clones[-1])
    pose = smoothed_poses([clone], estimator.gyro_prior)[0]
    assert pose.time == state.time
    np.testing.assert_allclose(pose.R_WB, state.R_WB, atol=1e-12)
    np.testing.assert_allclose(pose.p_W, state.p_W, atol=1e-12)
    rows = np.r_[0:3, 6:9]
    np.testing.assert_allclose(pose.covariance, state.covariance[np.ix_(rows, rows)], atol=1e-12)


def test_the_whole_graph_takes_the_bias_for_zero_as_far_as_the_filter_does(
    make_walk: Make, make_oracle: Make
) -> None:
    errors = ImuErrors(noise=MIXED.noise, gyro_turn_on=0.0, accel_turn_on=0.05)
    walk = make_walk(3, 60.0, 100.0, errors)
    oracle = make_oracle(walk, walk.truth, MIXED, noise=0.05, sigma=0.05)
    biases = [
        np.linalg.norm(Navigator(oracle, config, backend="graph").run(walk).b_g[-1])
        for config in (ONLY_WIDE, MIXED, ONLY_NARROW)
    ]
    assert biases[2] < 1.2 * biases[1] < 0.5 * biases[0]


@pytest.mark.parametrize("share", [-0.1, 1.0, float("nan")])
def test_a_probability_is_one(share: float) -> None:
    with pytest.raises(ConfigError, match="gyro_corrected"):
        configured(gyro_corrected=share)


@pytest.fixture(scope="module")
def far_apart(make_walk: Make, make_oracle: Make) -> tuple[ImuSequence, Any]:
    """A walk whose bias is none, on which the two priors lead metres apart."""
    walk = make_walk(3, 120.0, 100.0, ImuErrors(support.NOISE, gyro_turn_on=0.0))
    oracle = make_oracle(walk, walk.truth, MIXED, noise=0.05, sigma=0.05)
    estimator, _ = run(MIXED, walk, oracle)
    assert np.linalg.norm(estimator.nav_state().p_W - estimator.filtered().p_W) > 2.0
    return walk, oracle


def test_fixes_place_and_turn_the_track_that_is_given_out(
    far_apart: tuple[ImuSequence, Any],
) -> None:
    """Not the filter's own, or it would jump where they come."""
    walk, oracle = far_apart
    fixes = [
        position_fix(t, walk.truth.at(np.array([t])).position_W[0], 1e-4 * np.eye(3))
        for t in (60.0, 110.0)
    ]
    track = Navigator(oracle, MIXED).run(walk, fixes=fixes)
    assert track.health.fixes == {"applied": 2}
    steps = np.linalg.norm(np.diff(track.trajectory.position_W, axis=0), axis=1)
    assert steps.max() < 0.5
    smoothed = track.smoothed.position_W
    assert np.linalg.norm(np.diff(smoothed, axis=0), axis=1).max() < 1.5  # twice a second


def test_a_long_gap_does_not_lead_back_to_the_filter(
    far_apart: tuple[ImuSequence, Any], without: Make, make_oracle: Make
) -> None:
    walk, _ = far_apart
    holed = without(walk, (walk.time > 100.0) & (walk.time < 112.0))
    oracle = make_oracle(holed, walk.truth, MIXED, noise=0.05, sigma=0.05)
    estimator, _ = run(MIXED, holed, oracle)
    assert estimator.time > 118.0
    assert np.linalg.norm(estimator.nav_state().p_W - estimator.filtered().p_W) > 2.0


@pytest.mark.parametrize(
    ("wide", "narrow"), [(4e-3, 1e-170), (1e6, 1e-3), (1e-7, 5e-8), (1e-3, 1e-3 - 1e-12)]
)
def test_extreme_priors_leave_finite_weights(wide: float, narrow: float) -> None:
    prior = GyroPrior(configured(gyro_bias_sigma=wide, gyro_corrected_sigma=narrow), 0.0)
    posterior = prior.posterior(np.array(0.0), np.zeros(3), max(wide, 1e-6) ** 2 * np.eye(3))
    assert posterior is not None
    assert posterior.weight == pytest.approx(0.7, abs=1e-3)
