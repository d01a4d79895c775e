import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stario.fusion import lie

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
    A[:3, :3], A[:3, 3], A[:3, 4] = lie.skew(xi[:3]), xi[3:6], xi[6:]
    return A


def test_skew_is_the_cross_product() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3))
    np.testing.assert_allclose((lie.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_agrees_with_scipy(angle: float) -> None:
    theta = rotation_vectors(angle)
    expected = Rotation.from_rotvec(theta).as_matrix()
    np.testing.assert_allclose(lie.exp_so3(theta), expected, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle: float) -> None:
    theta = rotation_vectors(angle)
    np.testing.assert_allclose(lie.log_so3(lie.exp_so3(theta)), theta, rtol=1e-9, atol=1e-14)


def test_log_of_half_turns() -> None:
    theta = np.pi * np.eye(3)
    turned = lie.log_so3(lie.exp_so3(theta))
    np.testing.assert_allclose(np.abs(turned), theta, atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_left_jacobian_agrees_with_finite_differences(angle: float) -> None:
    step = 1e-6
    for theta in rotation_vectors(angle):
        R = lie.exp_so3(theta)
        left = np.empty((3, 3))
        for k, d in enumerate(step * np.eye(3)):
            plus, minus = lie.exp_so3(theta + d), lie.exp_so3(theta - d)
            left[:, k] = (lie.log_so3(plus @ R.T) - lie.log_so3(minus @ R.T)) / (2 * step)
        np.testing.assert_allclose(lie.exp_and_left_jacobian(theta)[1], left, atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_extended_pose_exp_is_the_matrix_exponential(angle: float) -> None:
    rng = np.random.default_rng(1)
    for theta in rotation_vectors(angle):
        xi = np.concatenate([theta, rng.normal(size=6)])
        np.testing.assert_allclose(
            se23_matrix(*lie.exp_se23(xi)), expm(se23_hat(xi)), rtol=1e-12, atol=1e-13
        )
        np.testing.assert_allclose(lie.log_se23(*lie.exp_se23(xi)), xi, rtol=1e-7, atol=1e-9)


def test_a_stack_of_mixed_angles_equals_one_at_a_time() -> None:
    theta = np.concatenate([rotation_vectors(angle) for angle in ANGLES])
    singly = np.stack([lie.exp_so3(row) for row in theta])
    np.testing.assert_allclose(lie.exp_so3(theta), singly, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_times_is_the_product_with_the_exponential(angle: float) -> None:
    rng = np.random.default_rng(2)
    theta = rotation_vectors(angle)
    rho, X = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 3, 5))
    R, J = lie.exp_and_left_jacobian(theta)
    expected = R @ X
    expected[:, :, 3:] += J @ rho
    np.testing.assert_allclose(lie.exp_times(theta, rho, X), expected, atol=1e-13)
