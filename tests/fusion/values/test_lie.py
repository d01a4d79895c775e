import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from se23 import exp_se23

from stario.fusion.values import lie
from stario.sequences.attitude import so3
from stario.sequences.attitude.rotations import yaw_of

ANGLES = [0.0, 1e-9, 1e-4, 0.0316, 0.0317, 0.2, 1.0, 2.5, np.pi - 1e-6]


def rotation_vectors(angle: float) -> np.ndarray:
    axes = np.random.default_rng(3).normal(size=(5, 3))
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


def se23_matrix(R: np.ndarray, v: np.ndarray, p: np.ndarray) -> np.ndarray:
    X = np.eye(5)
    X[:3, :3], X[:3, 3], X[:3, 4] = R, v, p
    return X


def se23_hat(xi: np.ndarray) -> np.ndarray:
    A = np.zeros((5, 5))
    A[:3, :3], A[:3, 3], A[:3, 4] = so3.skew(xi[:3]), xi[3:6], xi[6:]
    return A


@pytest.mark.parametrize("angle", ANGLES)
def test_extended_pose_exp_is_the_matrix_exponential(angle):
    rng = np.random.default_rng(1)
    for theta in rotation_vectors(angle):
        xi = np.concatenate([theta, rng.normal(size=6)])
        np.testing.assert_allclose(
            se23_matrix(*exp_se23(xi)), expm(se23_hat(xi)), rtol=1e-9, atol=1e-10
        )
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
