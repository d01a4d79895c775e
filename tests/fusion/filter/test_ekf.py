from dataclasses import replace

import numpy as np
import pytest
from initial_ekf import Driven, initialised
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from se23 import exp_se23
from support import nav_state

from stario.fusion import NavigatorConfig, Segment, preintegrate
from stario.fusion.filter.estimates import plain_covariances
from stario.fusion.filter.initial import VELOCITY_SIGMA, with_velocity_bounded
from stario.fusion.filter.jacobians import (
    displacement_jacobian,
    plain_covariance,
    position_jacobian,
    propagated_in_gap,
    velocity_jacobian,
    yaw_jacobian,
)
from stario.fusion.values import lie
from stario.fusion.values.lie import yaw_twist
from stario.sequences import STANDARD_GRAVITY, ImuNoise, about_z, yaw_of
from stario.sequences.attitude import so3
from stario.sequences.attitude.so3 import exp_so3

NOISE = ImuNoise()
YAW = np.array([0.0, 0.0, 1.0])


def segments(count: int, seed: int = 0) -> list[Segment]:
    """A device that is turned and shaken at random, 50 ms each."""
    rng = np.random.default_rng(seed)
    t = 10.0 + np.arange(10 * count + 1) / 200.0
    gyro = np.cumsum(rng.normal(0.0, 0.1, (len(t), 3)), axis=0) * 0.3
    accel = rng.normal([0.0, 0.0, STANDARD_GRAVITY], 1.0, (len(t), 3))
    parts = [slice(10 * k, 10 * k + 11) for k in range(count)]
    rest = np.zeros(3), np.zeros(3), NOISE, STANDARD_GRAVITY
    return [preintegrate(t[s], gyro[s], accel[s], *rest) for s in parts]


def drive(ekf: Driven, count: int, window: int = 6, seed: int = 0) -> list[float]:
    """Propagate, clone, measure and release as a navigator does; return every NIS."""
    rng = np.random.default_rng(seed)
    held, nis = [ekf.clone()], []
    for k, segment in enumerate(segments(count, seed)):
        ekf.propagate(segment)
        d = rng.normal(0.0, 0.3, 3)
        if len(held) == window:
            result = ekf.update_displacement(held[0], d, 0.04 * np.eye(3), gate=7.8)
            ekf.release(held.pop(0))
            nis.append(result.nis)
        if k % 10 == 9:
            ekf.update_position_W(ekf.state.p_W + d, 0.25 * np.eye(3))
        held.append(ekf.clone())
    return nis


@pytest.fixture
def driven():
    ekf = initialised(6)
    drive(ekf, 20)
    return ekf


def test_covariance_stays_symmetric_and_positive():
    ekf = initialised(6)
    drive(ekf, 400)
    P = ekf.P[: 15 + 6 * 6, : 15 + 6 * 6]
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-10 * P.max())
    sigma = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(sigma, sigma)).min() > -1e-9
    assert np.linalg.eigvalsh(ekf.state.nav_state().covariance).min() > 0.0
    np.testing.assert_allclose(ekf.state.R_WB @ ekf.state.R_WB.T, np.eye(3), atol=1e-10)


def clone_position_covariance(ekf: Driven, slot: int) -> np.ndarray:
    return plain_covariances([ekf.state.clone_estimate(slot)])[0, 6:9, 6:9]


def test_a_precise_fix_of_an_unknown_position_keeps_the_covariance_valid(driven):
    fresh = initialised(6)
    held = [fresh.clone()]
    fresh.propagate(segments(1)[0])
    between = clone_position_covariance(fresh, held[0])
    fresh.state = fresh.state.with_position_inflated(1e5)
    fresh.update_position_W(fresh.state.p_W, 1e-8 * np.eye(3))
    covariance = fresh.state.nav_state().covariance
    sigma = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(sigma, sigma)).min() > -1e-6
    np.testing.assert_allclose(sigma[6:9], 1e-4, rtol=1e-3)
    assert np.trace(clone_position_covariance(fresh, held[0])) < np.trace(between) + 1.0


def test_turning_the_world_turns_the_estimate_and_nothing_else():
    yaw = 1.1
    Z = exp_so3(yaw * YAW)
    ekf, turned = initialised(6), initialised(6)
    s = ekf.state
    moved = {name: Z @ getattr(s, name) for name in ("R_WB", "v_W", "p_W")}
    turned.initialise(replace(s.nav_state(), **moved))
    rng = np.random.default_rng(2)
    slots = [(ekf.clone(), turned.clone())]
    for segment in segments(60):
        for filter_ in (ekf, turned):
            filter_.propagate(segment)
        slots.append((ekf.clone(), turned.clone()))
        if len(slots) == 6:
            d = rng.normal(0.0, 0.2, 3)
            covariance = np.diag([0.02, 0.05, 0.01])
            i = slots[0]
            first = ekf.update_displacement(i[0], d, covariance, gate=7.8)
            second = turned.update_displacement(i[1], Z @ d, Z @ covariance @ Z.T, gate=7.8)
            assert first.nis == pytest.approx(second.nis, rel=1e-9)
            ekf.release(i[0])
            turned.release(i[1])
            slots.pop(0)
    np.testing.assert_allclose(turned.state.R_WB, Z @ ekf.state.R_WB, atol=1e-9)
    np.testing.assert_allclose(turned.state.v_W, Z @ ekf.state.v_W, atol=1e-9)
    np.testing.assert_allclose(turned.state.p_W, Z @ ekf.state.p_W, atol=1e-8)
    np.testing.assert_allclose(turned.state.b_g, ekf.state.b_g, atol=1e-9)
    T = np.eye(len(ekf.P))  # biases and the network's errors, the last ones, do not change
    n = ekf.state.considered_rows.start
    T[:n, :n] = np.kron(np.eye(n // 3), Z)
    T[9:15, 9:15] = np.eye(6)
    np.testing.assert_allclose(turned.P, T @ ekf.P @ T.T, atol=1e-9 * ekf.P.max())


def test_once_the_yaw_is_lost_levelling_a_far_track_leaves_it_where_it_is():
    ekf = Driven(2)
    ekf.initialise(nav_state(1e-4 * np.eye(15), p_W=np.array([300.0, -200.0, 0.0])))
    ekf.clone()
    ekf.state = ekf.state.with_yaw_inflated(np.zeros(3), 1.5).with_lost_yaw_forgotten()
    before = ekf.state.p_W
    ekf.update_tilt(exp_so3(np.array([0.05, 0.05, 0.0]))[2], 1e-3)
    assert np.abs(ekf.state.R_WB[2, :2]).max() > 0.04
    assert np.linalg.norm(ekf.state.p_W - before) < 0.1


def test_displacements_carry_no_information_about_yaw_and_position(driven):
    newest = max(range(6), key=lambda slot: driven.state.clone_estimate(slot).time)
    driven.release(newest)  # it equals the current pose, P has no inverse with it
    held = np.flatnonzero(np.diag(driven.P))
    N = np.zeros((len(driven.P), 4))
    clones = range(15, driven.state.considered_rows.start, 6)
    for first, rho in ((0, 6), *((k, k + 3) for k in clones)):
        N[first + 2, 0] = 1.0
        N[rho : rho + 3, 1:] = np.eye(3)
    N = N[held]

    def information():
        P = driven.P[np.ix_(held, held)]
        return N.T @ np.linalg.solve(P, N)

    before, P_before = information(), driven.P.copy()
    slots = [slot for slot in range(6) if slot != newest]
    for slot in slots:
        driven.update_displacement(slot, np.array([2.0, 1.0, 0.0]), 1e-3 * np.eye(3))
    assert np.trace(driven.P) < 0.9 * np.trace(P_before), "the measurements must have weight"
    np.testing.assert_allclose(information(), before, rtol=1e-3, atol=1e-3 * before.max())


def test_the_plain_covariance_is_returned_as_it_was_set():
    ekf = initialised(0)
    A = np.random.default_rng(0).normal(size=(15, 15))
    covariance = A @ A.T
    ekf.initialise(replace(ekf.state.nav_state(), covariance=covariance))
    np.testing.assert_allclose(ekf.state.nav_state().covariance, covariance, rtol=1e-9, atol=1e-9)


def test_outliers_are_inflated_by_their_nis(driven):
    before = driven.state.p_W
    result = driven.update_displacement(0, np.array([50.0, 0, 0]), 0.01 * np.eye(3), gate=7.8)
    assert result.accepted
    assert result.scale == pytest.approx(result.nis / 7.8)
    assert np.linalg.norm(driven.state.p_W - before) < 3.0


def test_a_position_far_off_turns_a_track_no_further_than_one_at_the_gate():
    """It is more certain than the track: by NIS / gate alone it would turn it by 18 sigmas."""
    turn, gate = 0.1, 9.0
    arm = np.zeros(15)
    arm[[2, 7]] = 1.0, 20.0  # at 20 m along x, a turn moves the position along y
    covariance = turn**2 * np.outer(arm, arm) + 1e-4 * np.eye(15)
    ekf = Driven(0, nav_state(covariance, p_W=np.array([20.0, 0.0, 0.0])))
    result = ekf.update_position_W(np.array([20.0, 40.0, 0.0]), 0.01 * np.eye(3), gate=gate)
    assert result.nis == pytest.approx(400.0, rel=0.02)
    assert 0.0 < yaw_twist(ekf.state.R_WB) < np.sqrt(gate) * turn


def test_estimates_share_no_memory_with_the_filter(driven):
    # Views would keep every covariance: an hour at 20 updates a second then took twenty gigabytes.
    for estimate in (driven.state.estimate(), driven.state.clone_estimate(2)):
        assert not np.shares_memory(estimate.covariances, driven.covariances)
        assert not np.shares_memory(estimate.X, driven.state.X)


@pytest.mark.parametrize("sigma", [0.5, 10.0])
def test_a_pedestrians_velocity_is_told_only_where_less_is_known(sigma):
    ekf, covariance = Driven(2), 0.01 * np.eye(15)
    covariance[3:6, 3:6] = sigma**2 * np.eye(3)
    ekf.initialise(nav_state(covariance, v_W=np.array([5.0, 0.0, 0.0])))
    bounded = with_velocity_bounded(ekf.state)
    if sigma < VELOCITY_SIGMA:
        assert bounded is ekf.state
    else:
        assert abs(bounded.v_W[0]) < 0.5
        assert np.sqrt(bounded.P[3, 3]) < VELOCITY_SIGMA


ANGLES = [0.0, 1e-9, 1e-4, 0.0316, 0.0317, 0.2, 1.0, 2.5, np.pi - 1e-6]


def rotation_vectors(angle: float) -> np.ndarray:
    axes = np.random.default_rng(3).normal(size=(5, 3))
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_extended_pose_exp_is_the_matrix_exponential(angle):
    rng = np.random.default_rng(1)
    for theta in rotation_vectors(angle):
        xi, hat, X = np.concatenate([theta, rng.normal(size=6)]), np.zeros((5, 5)), np.eye(5)
        hat[:3] = np.column_stack([so3.skew(theta), xi[3:6], xi[6:]])
        X[:3] = np.column_stack(exp_se23(xi))
        np.testing.assert_allclose(X, expm(hat), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(lie.log_se23(*exp_se23(xi)), xi, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_times_is_the_product_with_the_exponential(angle):
    rng = np.random.default_rng(2)
    theta = rotation_vectors(angle)
    rho, X = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 3, 5))
    R, J = so3.exp_and_left_jacobian(theta)
    expected = R @ X
    expected[:, :, 3:] += J @ rho
    np.testing.assert_allclose(lie.exp_times(theta, rho, X), expected, atol=1e-10)


def test_yaw_twist_agrees_with_yaw_of_and_is_undefined_upside_down():
    attitude = Rotation.random(50, rng=np.random.default_rng(0))
    ours = np.array([lie.yaw_twist(R) for R in attitude.as_matrix()])
    known = np.isfinite(ours)
    assert known.sum() > 45
    off = ours[known] - yaw_of(attitude[known])
    np.testing.assert_allclose(np.sin(off), 0.0, atol=1e-9)
    assert np.isnan(lie.yaw_twist(so3.exp_so3(np.array([np.pi, 0.0, 0.0]))))


TURN = np.array([0.0, 0.0, 1.0])


def test_displacement_jacobian_agrees_with_finite_differences():
    p_i, p_j = np.array([30.0, -20.0, 1.0]), np.array([31.0, -19.4, 1.2])
    dim, step = 27, 1e-6
    columns = {0: (0, 6), 1: (15, 18)}

    def measured(error):
        """Displacement measured by a network that is turned by the estimate's yaw error."""
        ends = []
        for pose, p in ((1, p_i), (0, p_j)):
            theta, rho = (error[c : c + 3] for c in columns[pose])
            R, _, shift = exp_se23(np.concatenate([theta, np.zeros(3), rho]))
            ends.append(R @ p + shift)
        yaw = error[columns[1][0] + 2]
        return exp_so3(-yaw * TURN) @ (ends[1] - ends[0])

    numeric = [(measured(d) - measured(-d)) / (2 * step) for d in step * np.eye(dim)]
    H = np.zeros((3, dim))
    for first, block in displacement_jacobian(p_i, p_j, 0):
        H[:, first : first + block.shape[1]] += block
    np.testing.assert_allclose(H.T, numeric, atol=1e-6)


def test_a_gap_is_propagated_as_its_motion_and_its_turn_are_drawn():
    """The mean and covariance of a pedestrian whose motion nothing measures."""
    seconds, turn_variance, config = 2.0, 0.3**2, NavigatorConfig()
    R, v, p = exp_so3(np.array([0.4, -0.7, 1.0])), np.array([1.0, -0.5, 0.1]), np.ones(3)
    after = propagated_in_gap(seconds, turn_variance, R, v, p, config)
    np.testing.assert_array_equal(after.R_WB, R)
    np.testing.assert_array_equal(after.v_W, v)
    np.testing.assert_allclose(after.p_W, p + seconds * v)

    step, numeric = 1e-6, np.empty((9, 9))
    for k, error in enumerate(step * np.eye(9)):  # of the state before, in the invariant error
        turn, shift_v, shift_p = exp_se23(error)
        v_k, p_k = turn @ v + shift_v, turn @ p + shift_p
        end_v, end_p = v_k - turn @ v, p_k + seconds * v_k - turn @ (p + seconds * v)
        numeric[:, k] = np.concatenate([error[:3], end_v, end_p]) / step
    np.testing.assert_allclose(after.transition[:9, :9], numeric, atol=1e-5)

    f, rng, n = config.filter, np.random.default_rng(0), 100_000
    psi = rng.normal(0.0, np.sqrt(turn_variance), n)
    sideways = np.cross(TURN, v) * psi[:, None]
    q = np.array([[seconds, seconds**2 / 2], [seconds**2 / 2, seconds**3 / 3]])
    q *= f.gap_accel_noise**2
    dv, dp = np.moveaxis(rng.multivariate_normal(np.zeros(2), q, (n, 3)), -1, 0)
    tilt = rng.normal(0.0, f.gap_gyro_noise * np.sqrt(seconds), (n, 3)) * (1.0 - TURN)
    theta = tilt + psi[:, None] * TURN
    drawn = np.concatenate([theta, dv + sideways, dp + seconds * sideways], axis=1)
    plain = plain_covariance(after.noise, np.array((after.v_W, after.p_W)))
    scale = np.sqrt(np.diag(plain[0])[:9])
    for which in plain[:, :9, :9]:
        outer = np.outer(scale, scale)
        np.testing.assert_allclose(which / outer, np.cov(drawn.T) / outer, atol=0.02)


def test_a_tilt_is_corrected_by_the_smallest_rotation():
    ekf = initialised(0)
    covariance = ekf.state.nav_state().covariance
    before, p, v = ekf.state.R_WB, ekf.state.p_W, ekf.state.v_W
    turned = exp_so3(np.array([0.3, -0.2, 0.0])) @ before  # the true attitude
    ekf.update_tilt(turned.T @ TURN, 1e-6)
    np.testing.assert_allclose(ekf.state.R_WB, turned, atol=1e-6)
    after = ekf.state.nav_state().covariance
    assert after[0, 0] < 1e-8
    assert after[2, 2] == pytest.approx(covariance[2, 2])
    # Neither place nor velocity hang on the tilt: the device was turned, not carried elsewhere.
    np.testing.assert_allclose(ekf.state.p_W, p, atol=1e-9)
    np.testing.assert_allclose(ekf.state.v_W, v, atol=1e-9)


@pytest.mark.parametrize("kind", ["position", "velocity", "yaw"])
@pytest.mark.parametrize("seed", range(4))
def test_jacobians_agree_with_finite_differences(kind, seed):
    rng = np.random.default_rng(seed)
    tilt = Rotation.from_rotvec([*rng.normal(0.0, 0.8, 2), 0.0])
    R = (about_z(rng.uniform(-3.0, 3.0)) * tilt).as_matrix()
    v, p = rng.normal(0.0, 2.0, 3), rng.normal(0.0, 20.0, 3)

    def measured(error):
        turn, shift_v, shift_p = exp_se23(error)
        if kind == "position":
            return turn @ p + shift_p
        return turn @ v + shift_v if kind == "velocity" else np.array([yaw_twist(turn @ R)])

    step, H = 1e-6, np.zeros((1 if kind == "yaw" else 3, 9))
    jacobians = {"position": position_jacobian(p), "velocity": velocity_jacobian(v)}
    jacobian = jacobians.get(kind, yaw_jacobian(R))
    for first, block in jacobian:
        H[:, first : first + block.shape[1]] = block
    numeric = [(measured(d) - measured(-d)) / (2 * step) for d in step * np.eye(9)]
    np.testing.assert_allclose(H.T, numeric, atol=1e-7 * max(1.0, np.abs(numeric).max()))


def injected(dx: np.ndarray) -> Driven:
    """A filter after an exact measurement of its error: an identity update without noise."""
    ekf = initialised(1)
    ekf.clone()
    ekf.P = np.eye(len(ekf.P))
    n = len(dx)
    ekf.update_linear(dx, [(0, np.eye(n))], 1e-14 * np.eye(n))
    return ekf


def test_corrections_of_any_size_follow_the_exponential_map():
    dx = np.random.default_rng(0).normal(size=21)
    before, after = injected(np.zeros(21)), injected(dx)
    R, v, p = exp_se23(dx[:9])
    np.testing.assert_allclose(after.state.R_WB, R @ before.state.R_WB, atol=1e-9)
    np.testing.assert_allclose(after.state.v_W, R @ before.state.v_W + v, atol=1e-9)
    np.testing.assert_allclose(after.state.p_W, R @ before.state.p_W + p, atol=1e-9)
    np.testing.assert_allclose(after.state.b_g - before.state.b_g, dx[9:12], atol=1e-9)
    np.testing.assert_allclose(after.state.b_a - before.state.b_a, dx[12:15], atol=1e-9)
    R, _, p = exp_se23(np.concatenate([dx[15:18], np.zeros(3), dx[18:]]))
    poses = after.state.clone_pose(0), before.state.clone_pose(0)
    for found, old, shift in zip(*poses, (0.0, p), strict=True):
        np.testing.assert_allclose(found, R @ old + shift, atol=1e-9)
