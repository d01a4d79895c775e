"""The network's correlated errors: part of the covariances, and of no gain."""

from dataclasses import replace

import numpy as np
import pytest
from initial_ekf import Driven
from support import nav_state, stream

from stario.fusion import Navigator, NavigatorConfig
from stario.fusion.filter import estimator, map_frame
from stario.fusion.filter.correlated_errors import (
    DRIFTING,
    LASTING,
    WHITE,
    displacement_errors,
)
from stario.fusion.filter.ekf_state import CONSIDERED_SECONDS
from stario.fusion.filter.estimates import Estimate
from stario.fusion.filter.frame_transform import frame_rotation
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.innovations import MAX_LEVEL, MIN_LEVEL, InnovationStatistics
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.filter.map_frame import Mapped
from stario.fusion.graph.covariances import with_reported_covariances
from stario.fusion.imu.preintegration import preintegrate
from stario.fusion.recording import cut_recording
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.fixes import position_fix
from stario.sequences import STANDARD_GRAVITY, ImuNoise, about_z, evaluate_track

F = FilterConfig()
SPEED = 1.2
"""Speed of a straight walk [m/s]."""


def config(correlated: bool) -> NavigatorConfig:
    return NavigatorConfig(filter=replace(F, correlated_errors=correlated))


def test_shares_add_up_along_a_displacement_and_vanish_with_the_level():
    d_W, covariance = np.array([1.2, -0.5, 0.0]), np.diag([0.02, 0.02, 0.01])
    u = d_W[:2] / np.linalg.norm(d_W)
    white, considered = displacement_errors(d_W, covariance, 1.0, F)
    total = white + considered @ considered.T
    assert u @ total[:2, :2] @ u == pytest.approx(0.02 * (WHITE + DRIFTING + LASTING))
    _, lasting = displacement_errors(d_W, covariance, 0.0, F)
    assert u @ (lasting @ lasting.T)[:2, :2] @ u == pytest.approx(0.02 * LASTING)


def test_the_floors_slope_is_no_error_of_the_network():
    """It is part of the height's variance, lasts longer, and does not depend on the level."""
    d_W, own, slope = np.array([1.2, -0.5, 0.0]), 1e-4, (0.03 * 1.3) ** 2
    covariance = np.diag([0.02, 0.02, own + slope])
    for level in (1.0, 0.2):
        white, considered = displacement_errors(d_W, covariance, level, F)
        height = white[2, 2] + considered[2] @ considered[2]
        assert height == pytest.approx(slope + level * own * (WHITE + DRIFTING))


def test_a_second_of_white_errors_is_the_same_at_any_update_rate():
    """More windows a second repeat each other's errors instead of averaging them."""
    d_W, covariance = np.array([1.2, -0.5, 0.0]), np.diag([0.02, 0.02, 0.01])
    configs = (FilterConfig(update_rate=rate) for rate in (2, 10))
    slow, fast = (displacement_errors(d_W, covariance, 1.0, each) for each in configs)
    np.testing.assert_allclose(fast.white / 10.0, slow.white / 2.0)
    np.testing.assert_allclose(fast.considered, slow.considered)


def test_errors_turn_with_the_world():
    rng = np.random.default_rng(0)
    R = about_z(1.1).as_matrix()
    root = rng.normal(size=(3, 3))
    d_W, covariance = rng.normal(size=3), 0.01 * root @ root.T + 0.01 * np.eye(3)
    errors = displacement_errors(d_W, covariance, 0.7, F)
    turned = displacement_errors(R @ d_W, R @ covariance @ R.T, 0.7, F)
    np.testing.assert_allclose(turned.white, R @ errors.white @ R.T, atol=1e-10)
    drifting = R @ errors.considered[:, :3] @ R.T  # they are those of W's axes
    np.testing.assert_allclose(turned.considered[:, :3], drifting, atol=1e-10)
    np.testing.assert_allclose(turned.considered[:, 3:], R @ errors.considered[:, 3:], atol=1e-10)


@pytest.mark.parametrize(("nis", "bound"), [(0.0, MIN_LEVEL), (1e6, MAX_LEVEL)])
def test_the_level_stays_within_its_bounds(nis, bound):
    statistics = InnovationStatistics()
    for _ in range(1000):
        statistics = statistics.updated(UpdateResult(nis=nis, gate_nis=nis), F)
    assert statistics.error_level == pytest.approx(bound)


def test_the_level_makes_the_mean_nis_three():
    """Innovations twice as large as predicted: their variance, and so the level, is four times."""
    rng, statistics, nis = np.random.default_rng(0), InnovationStatistics(), []
    for _ in range(2000):
        nis.append(4.0 / statistics.error_level * rng.chisquare(3))
        statistics = statistics.updated(UpdateResult(nis=nis[-1], gate_nis=nis[-1]), F)
    assert np.mean(nis[200:]) == pytest.approx(3.0, rel=0.1)


def test_one_displacement_changes_the_level_by_a_fifth_at_most():
    after = InnovationStatistics(gain=0.05).updated(UpdateResult(nis=1e6, gate_nis=1e6), F)
    assert after.error_level == pytest.approx(np.exp(0.2))


def test_a_network_that_claims_a_fifth_of_its_sigma_costs_little(make_walk, make_oracle):
    """As weights do that were trained on few walks, or do not know a way of carrying."""
    walk, settings = make_walk(2, 60.0), NavigatorConfig()
    found = []
    for sigma in (0.1, 0.02):
        oracle = make_oracle(walk, walk.truth, settings, noise=0.1, sigma=sigma)
        track = Navigator(oracle, settings, backend="ekf").run(walk)
        found.append((evaluate_track(track.trajectory, walk.truth).ate_m, track.nis))
    (honest, _), (overconfident, nis) = found
    assert overconfident < honest + 0.2  # 0.5 if the gains believed it
    assert nis < 10.0  # 32 at a level of at most 5


def straight_walk(rng: np.random.Generator, seconds: int) -> tuple[Driven, np.ndarray, float]:
    """Walk straight with errors as the model has them; return filter, true end and mean NIS."""
    ekf, zero = Driven(slots=1), np.zeros(3)
    P = np.diag(np.repeat([1e-6, 1e-2, 1e-6, 1e-12, 1e-6], 3))
    ekf.initialise(nav_state(P, v_W=np.array([SPEED, 0.0, 0.0])))
    noise = ImuNoise(gyro_noise=1e-5, accel_noise=0.1)
    time = np.arange(0.0, 1.0 + 1e-9, 0.1)
    accel = np.tile([0.0, 0.0, STANDARD_GRAVITY], (len(time), 1))
    errors, nis = rng.normal(size=len(CONSIDERED_SECONDS)), []
    kept = np.exp(-1.0 / CONSIDERED_SECONDS)
    speed = np.array([SPEED, 0.0, 0.0]) - 0.1 * rng.normal(size=3)  # true minus estimate
    slot = ekf.clone()
    for second in range(seconds):
        jolt = 0.1 * np.sqrt(10.0) * rng.normal(size=accel.shape)
        samples = float(second) + time, np.zeros_like(accel), accel + jolt
        segment = preintegrate(*samples, zero, zero, noise, STANDARD_GRAVITY)
        ekf.propagate(segment)
        errors = kept * errors + np.sqrt(1.0 - kept**2) * rng.normal(size=len(kept))
        d_W, covariance = speed, 0.1**2 * np.eye(3)
        model = displacement_errors(d_W, covariance, 1.0, F)
        d_W = d_W + model.considered @ errors
        d_W = d_W + np.linalg.cholesky(model.white) @ rng.normal(size=3)
        result = ekf.update_displacement(slot, d_W, covariance, errors=model)
        nis.append(result.nis)
        slot = ekf.clone(instead_of=slot)
    return ekf, seconds * speed, float(np.mean(nis[3:]))


@pytest.mark.slow
def test_the_covariance_is_that_of_drawn_errors():
    """Of 60 walks; what the gains assume is a fraction of it."""
    rng, seconds = np.random.default_rng(1), 30
    filters, ends, nis = zip(*(straight_walk(rng, seconds) for _ in range(60)), strict=True)
    found = np.square([ekf.state.p_W - end for ekf, end in zip(filters, ends, strict=True)])
    reported = np.diag(filters[0].state.nav_state().covariance)[6:9]
    np.testing.assert_allclose(found.mean(axis=0)[:2], reported[:2], rtol=0.3)
    assert np.mean(nis) == pytest.approx(3.0, rel=0.1)
    assert filters[0].P[6, 6] < 0.6 * reported[0]


@pytest.fixture(scope="module")
def walk(make_walk):
    return make_walk(3, 24.0, 50.0)


@pytest.fixture(scope="module")
def oracle(walk, make_oracle):
    return make_oracle(walk, walk.truth, config(True), sigma=0.05)


@pytest.fixture(scope="module")
def track(walk, oracle):
    return Navigator(oracle, config(True)).run(walk)


def test_the_track_does_not_depend_on_them(walk, oracle, track):
    assumed_white = Navigator(oracle, config(False)).run(walk)
    pairs = (assumed_white, track), (assumed_white.filtered, track.filtered)
    for white, correlated in pairs:
        ours, theirs = (each.trajectory.position_W for each in (correlated, white))
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9)
        assert not np.allclose(white.covariance, correlated.covariance)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_stream_gives_the_covariances_of_its_filter(walk, oracle, track, backend):
    recording = track.filtered
    navigator = Navigator(oracle, config(True), backend=backend)
    for state in stream(navigator, walk.slice(0.0, 12.0))[20::20]:
        k = int(np.argmin(np.abs(recording.time - state.time)))
        expected = np.sqrt(np.diag(recording.covariance[k])[6:8])
        found = np.sqrt(np.diag(state.position_covariance)[:2])
        np.testing.assert_allclose(found, expected, rtol=0.2)


def test_a_position_fix_removes_them(walk, oracle):
    truth = walk.truth.at(np.array([2.0, 13.0, 22.0]))
    known = zip(truth.time, truth.position_W, strict=True)
    fixes = [position_fix(t, p, 1e-4 * np.eye(3)) for t, p in known]
    track = Navigator(oracle, config(True), backend="ekf").run(walk, fixes=fixes)
    variance = np.trace(track.covariance[:, 6:8, 6:8], axis1=1, axis2=2)
    before, after = np.searchsorted(track.time, (21.85, 22.05))
    assert variance[before] > 0.01
    assert variance[after] < 0.05 * variance[before]


def test_the_first_fix_after_a_straight_walk_is_believed():
    """A lasting error moves the end of a straight walk by many sigmas of white errors."""
    ekf, zero = Driven(slots=2), np.zeros(3)
    ekf.initialise(nav_state(np.diag(np.repeat([1e-4, 1e-2, 1e-4, 1e-8, 1e-4], 3))))
    rng, length, scale = np.random.default_rng(0), 1.2, 1.03
    time = np.arange(0.0, 1.0 + 1e-9, 0.1)
    accel = np.tile([0.0, 0.0, STANDARD_GRAVITY], (len(time), 1))
    noise = ImuNoise(gyro_noise=1e-3, accel_noise=0.1)
    frame = map_frame.first_frame(PriorPose(np.eye(3), zero, zero))
    slot = ekf.clone()
    for second in range(200):
        samples = float(second) + time, np.zeros_like(accel), accel
        ekf.propagate(preintegrate(*samples, zero, zero, noise, STANDARD_GRAVITY))
        d_W, covariance = np.array([scale * length, 0.0, 0.0]), 0.1**2 * np.eye(3)
        d_W = d_W + rng.normal(0.0, 0.05, 3)
        errors = displacement_errors(d_W, covariance, 1.0, F)
        ekf.update_displacement(slot, d_W, covariance, gate=14.0, errors=errors)
        slot = ekf.clone(instead_of=slot)
    truth = np.array([200.0 * length, 0.0, 0.0])
    assert ekf.state.p_W[0] - truth[0] > 3.0 * np.sqrt(ekf.P[6, 6])
    fix = position_fix(200.0, truth, np.eye(3))
    (after, _), result = map_frame.update_with(fix, Mapped(ekf.state, frame), F)
    assert result.accepted
    assert result.scale == 1.0
    assert np.linalg.norm(after.p_W - truth) < 1.0


def test_a_gap_is_as_uncertain_as_the_gains_assume(walk, without):
    """Elsewhere the accelerometer is better than they assume."""
    holed = without(walk, (walk.time >= 10.0) & (walk.time <= 12.0))
    intervals, front_end = cut_recording(holed, config(True))
    state = estimator.begin(config(True), front_end.start)
    added = {}  # by the first interval of its kind, before biases matter
    for interval in intervals:
        before = state.estimate().covariances[:, 5, 5]
        state, record = estimator.step(state, interval, None, (), config(True))
        added.setdefault(interval.gap, record.estimate.covariances[:, 5, 5] - before)
    assert added[True][1] == pytest.approx(added[True][0], rel=0.05)
    assert added[False][1] < 0.5 * added[False][0]


def test_no_measurement_estimates_them():
    """Their gain is zero, also where a fix is weighted by the covariance that contains them."""
    ekf, end, _ = straight_walk(np.random.default_rng(3), 30)
    rows = ekf.state.considered_rows
    for update in (
        lambda: ekf.update_position_W(end, 0.01 * np.eye(3)),
        lambda: ekf.update_velocity_W(end / 30.0, 0.01 * np.eye(3)),
        lambda: ekf.update_yaw(0.0, 0.1),
    ):
        update()
        np.testing.assert_allclose(np.diag(ekf.state.P_reported)[rows], 1.0, rtol=1e-9)
        assert not ekf.P[rows].any()


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(15, 15))
    return root @ root.T + np.eye(15)


def estimate(P: np.ndarray, Q: np.ndarray) -> Estimate:
    zero = np.zeros(3)
    X = np.eye(3, 5)  # at the origin and at rest: plain errors equal invariant ones
    return Estimate(0.0, X, zero, zero, zero, np.stack([P, Q]))


def test_a_graph_in_a_turned_frame_gets_the_filters_covariance_turned():
    rng = np.random.default_rng(3)
    P, Q = (random_covariance(rng) for _ in range(2))
    A = frame_rotation(about_z(1.1).as_matrix())
    (state,) = with_reported_covariances([nav_state(A @ P @ A.T)], [estimate(P, Q)], A[None])
    np.testing.assert_allclose(state.covariance, A @ Q @ A.T, atol=1e-8 * np.abs(Q).max())


def test_a_graph_as_certain_as_the_filter_gets_the_filters_covariance():
    rng = np.random.default_rng(2)
    P, Q, smaller = (random_covariance(rng) for _ in range(3))
    (state,) = with_reported_covariances([nav_state(P)], [estimate(P, Q)])
    np.testing.assert_allclose(state.covariance, Q, atol=1e-8 * np.abs(Q).max())
    (unchanged,) = with_reported_covariances([nav_state(smaller)], [estimate(P, P)])
    np.testing.assert_allclose(unchanged.covariance, smaller, atol=1e-8 * smaller.max())
