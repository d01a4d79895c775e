import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from stario.sequences.attitude import so3
from stario.sequences.attitude.stacks import composed, slerp

ANGLES = [0.0, 1e-9, 1e-4, 0.0316, 0.0317, 0.2, 1.0, 2.5, np.pi - 1e-6]


def rotation_vectors(angle: float) -> np.ndarray:
    axes = np.random.default_rng(3).normal(size=(5, 3))
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


def test_skew_is_the_cross_product():
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3))
    np.testing.assert_allclose((so3.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-10)
    np.testing.assert_allclose(so3.cross(a, b), np.cross(a, b), atol=1e-10)


def test_exp_agrees_with_scipy_and_log_inverts_it():
    theta = np.concatenate([rotation_vectors(angle) for angle in ANGLES])
    expected = Rotation.from_rotvec(theta).as_matrix()
    singly = np.stack([so3.exp_so3(row) for row in theta])
    for found in (so3.exp_so3(theta), singly):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(so3.log_so3(found), theta, rtol=1e-6, atol=1e-12)


def test_log_of_half_turns():
    theta = np.pi * np.eye(3)
    turned = so3.log_so3(so3.exp_so3(theta))
    np.testing.assert_allclose(np.abs(turned), theta, atol=1e-10)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_left_jacobian_agrees_with_finite_differences(angle):
    step = 1e-6
    for theta in rotation_vectors(angle):
        R = so3.exp_so3(theta)
        left = np.empty((3, 3))
        for k, d in enumerate(step * np.eye(3)):
            plus, minus = so3.exp_so3(theta + d), so3.exp_so3(theta - d)
            left[:, k] = (so3.log_so3(plus @ R.T) - so3.log_so3(minus @ R.T)) / (2 * step)
        np.testing.assert_allclose(so3.exp_and_left_jacobian(theta)[1], left, atol=1e-6)


def same(found: Rotation, expected: Rotation) -> None:
    np.testing.assert_allclose(found.as_quat(), expected.as_quat(), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("counts", [(50, 50), (50, None), (None, 50), (None, None), (0, 0)])
def test_products_are_scipys(counts):
    p, q = (Rotation.random(count, rng=seed) for seed, count in enumerate(counts))
    same(composed(p, q), p * q)


@pytest.mark.parametrize("count", [0, 7, 1000])
def test_interpolated_rotations_are_scipys(count):
    """At fewer times than are known and at more, in any order, at the ends and at known times."""
    rng = np.random.default_rng(0)
    known = np.cumsum(rng.uniform(0.01, 0.1, 40))
    rotations = Rotation.random(40, rng=1)
    time = np.concatenate([rng.uniform(known[0], known[-1], count), known[[3, 0, -1]]])
    same(slerp(known, rotations, time), Slerp(known, rotations)(time))
