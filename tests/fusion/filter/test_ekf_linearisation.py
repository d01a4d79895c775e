"""The filter's Jacobians and its retraction, against finite differences and the exponential."""

import numpy as np
import pytest
from initial_ekf import Driven, initialised
from scipy.spatial.transform import Rotation
from se23 import exp_se23

from stario.fusion.filter.jacobians import (
    displacement_jacobian,
    plain_covariance,
    position_jacobian,
    propagated_in_gap,
    velocity_jacobian,
    yaw_jacobian,
)
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.lie import yaw_twist
from stario.sequences.attitude.rotations import about_z
from stario.sequences.attitude.so3 import exp_so3

YAW = np.array([0.0, 0.0, 1.0])


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
        return exp_so3(-yaw * YAW) @ (ends[1] - ends[0])

    numeric = np.stack(
        [(measured(d) - measured(-d)) / (2 * step) for d in step * np.eye(dim)], axis=1
    )
    H = np.zeros((3, dim))
    for first, block in displacement_jacobian(p_i, p_j, 0):
        H[:, first : first + block.shape[1]] += block
    np.testing.assert_allclose(H, numeric, atol=1e-6)


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
    sideways = np.cross(YAW, v) * psi[:, None]
    q = f.gap_accel_noise**2 * np.array(
        [[seconds, seconds**2 / 2], [seconds**2 / 2, seconds**3 / 3]]
    )
    dv, dp = np.moveaxis(rng.multivariate_normal(np.zeros(2), q, (n, 3)), -1, 0)
    tilt = rng.normal(0.0, f.gap_gyro_noise * np.sqrt(seconds), (n, 3)) * (1.0 - YAW)
    theta = tilt + psi[:, None] * YAW
    drawn = np.concatenate([theta, dv + sideways, dp + seconds * sideways], axis=1)
    plain = plain_covariance(after.noise, np.array((after.v_W, after.p_W)))
    scale = np.sqrt(np.diag(plain[0])[:9])
    for which in plain[:, :9, :9]:
        np.testing.assert_allclose(
            which / np.outer(scale, scale), np.cov(drawn.T) / np.outer(scale, scale), atol=0.02
        )


def test_a_tilt_is_corrected_by_the_smallest_rotation():
    ekf = initialised(0)
    covariance = ekf.state.nav_state().covariance
    before, p, v = ekf.state.R_WB, ekf.state.p_W, ekf.state.v_W
    turned = exp_so3(np.array([0.3, -0.2, 0.0])) @ before  # the true attitude
    ekf.update_tilt(turned.T @ YAW, 1e-6)
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
    jacobian = {
        "position": lambda: position_jacobian(p),
        "velocity": lambda: velocity_jacobian(v),
        "yaw": lambda: yaw_jacobian(R),
    }[kind]()
    for first, block in jacobian:
        H[:, first : first + block.shape[1]] = block
    numeric = np.stack(
        [(measured(d) - measured(-d)) / (2 * step) for d in step * np.eye(9)], axis=1
    )
    np.testing.assert_allclose(H, numeric, atol=1e-7 * max(1.0, np.abs(numeric).max()))


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
    for found, old, shift in zip(
        after.state.clone_pose(0), before.state.clone_pose(0), (0.0, p), strict=True
    ):
        np.testing.assert_allclose(found, R @ old + shift, atol=1e-9)
