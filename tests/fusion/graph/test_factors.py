from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, T, V, X

from stario.fusion.graph.covariances import marginal_covariances
from stario.fusion.graph.factors import (
    Bearing,
    ConstantVelocity,
    Displacement,
    GyroBias,
    Position,
    Prior,
    SamePlace,
    Tilt,
    Velocity,
    Yaw,
)
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.graph.term import Term, Whitened, linear_factor
from stario.sequences.attitude.so3 import exp_so3

EYE = np.eye(3)
UP = EYE[2]


def random_values(rng: np.random.Generator) -> Any:
    values = gtsam.Values()
    for k in (0, 1):
        KeyframeState(exp_so3(rng.normal(size=3)), *rng.normal(size=(4, 3))).insert_into(values, k)
    return values


def moved(values: Any, key: int, step: np.ndarray) -> Any:
    delta = gtsam.VectorValues()
    delta.insert(key, step)
    return values.retract(delta)


def turned_about(k: int, state: KeyframeState, place: np.ndarray) -> dict[int, np.ndarray]:
    """Tangent of keyframe k as the world turns about the vertical through a place."""
    R_BW, arm = state.R_WB.T, np.cross(UP, state.p_W - place)
    turn = {X(k): np.concatenate([R_BW @ UP, R_BW @ arm]), V(k): np.cross(UP, state.v_W)}
    return turn | {B(k): np.zeros(6)}


def terms(rng: np.random.Generator, values: Any) -> list[Term]:
    state, next_state = (KeyframeState.of(values, k) for k in (0, 1))
    # A window's levelled attitude differs from the world's in yaw, and a little in tilt.
    R_NB = exp_so3(np.array([0.0, 0.0, 0.9])) @ state.R_WB
    return [
        Displacement((0, 1), EYE, rng.normal(size=3), R_NB),
        Position((0,), EYE, rng.normal(size=3), 0.4, rng.normal(size=3)),
        Velocity((0,), EYE, rng.normal(size=3), rng.normal(size=3)),
        Yaw((0,), np.eye(1), 0.7, exp_so3(rng.normal(0.0, 0.3, 3))),
        GyroBias((0,), EYE, rng.normal(size=3)),
        Prior.white(0, (state, next_state), rng.normal(size=(20, 30)), rng.normal(size=20)),
        Prior.white(0, (state,), rng.normal(size=(9, 15)), rng.normal(size=9)),
        Bearing((0,), np.eye(1), state.R_WB, rng.normal(size=3), rng.normal(size=6), 0.7),
        ConstantVelocity((0, 1), np.eye(13), 1.7, exp_so3(rng.normal(0.0, 0.3, 3))),
        Tilt((0,), EYE, np.array([0.6, 0.0, 0.8])),
        SamePlace((0, 1), EYE),
    ]


@pytest.mark.parametrize("which", range(11))
def test_jacobians_agree_with_finite_differences(which):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        values = random_values(rng)
        term = terms(rng, values)[which]
        residual, blocks = term.linearise(values)
        given = {key: H for key, H in blocks}
        assert residual.shape == (len(term.covariance),)
        for key in values.keys():  # noqa: SIM118
            width = 3 if key in (V(0), V(1)) else 6
            for column in range(width):
                step = np.zeros(width)
                step[column] = 1e-5
                ahead = term.linearise(moved(values, key, step))[0]
                behind = term.linearise(moved(values, key, -step))[0]
                expected = given[key][:, column] if key in given else np.zeros(len(residual))
                # The residual is measured minus predicted.
                np.testing.assert_allclose(-(ahead - behind) / 2e-5, expected, atol=2e-6)


def test_a_linear_factor_weighs_a_residual_by_the_inverse_of_its_correlated_covariance():
    rng = np.random.default_rng(8)
    values, root = random_values(rng), rng.normal(size=(3, 3))
    term = Position((0,), root @ root.T, rng.normal(size=3), 0.4, rng.normal(size=3))
    factor = Whitened.of(term, np.inf).factor(values)
    residual, blocks = term.linearise(values)
    H = np.hstack([block for _, block in blocks])
    information = np.linalg.inv(term.covariance)
    A, b = factor.jacobian()
    assert list(factor.keys()) == [key for key, _ in blocks]
    np.testing.assert_allclose(A.T @ A, H.T @ information @ H, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(A.T @ b, H.T @ information @ residual, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_in_a_gap_velocity_and_biases_are_constant_and_a_turn_is_any_turn(yaw):
    values = random_values(np.random.default_rng(5))
    a, turn = KeyframeState.of(values, 0), exp_so3(yaw * UP)
    v = turn @ a.v_W
    R_ij = exp_so3(np.array([0.1, 0.3, -0.2]))  # of the device, known and no turn of the walker
    tilted = exp_so3(np.array([0.5, -1.0, 0.0])) @ a.R_WB @ R_ij
    after = gtsam.Values()
    a.insert_into(after, 0)
    a._replace(R_WB=turn @ tilted, v_W=v, p_W=a.p_W + 3.0 * v).insert_into(after, 1)
    residual, _ = ConstantVelocity((0, 1), np.eye(13), 3.0, R_ij).linearise(after)
    np.testing.assert_allclose(residual, [-yaw, *np.zeros(12)], atol=1e-10)


def test_motion_in_a_gap_observes_no_turn_but_its_own():
    """Not even where the residual is far from zero, as in a first round."""
    values = random_values(np.random.default_rng(7))
    a, b = (KeyframeState.of(values, k) for k in (0, 1))
    _, blocks = ConstantVelocity((0, 1), np.eye(13), 1.7, EYE).linearise(values)
    H = dict(blocks)

    def of_turn(k, s, about):
        turn = turned_about(k, s, about)
        return np.asarray(H[X(k)] @ turn[X(k)] + H[V(k)] @ turn[V(k)])

    world = of_turn(0, a, np.zeros(3)) + of_turn(1, b, np.zeros(3))
    np.testing.assert_allclose(world, 0.0, atol=1e-10)
    np.testing.assert_allclose(of_turn(1, b, a.p_W), [1.0, *np.zeros(12)], atol=1e-10)


def test_a_tilt_is_that_of_the_measured_vertical_at_any_yaw():
    values = random_values(np.random.default_rng(6))
    R = KeyframeState.of(values, 0).R_WB
    turned = exp_so3(np.array([0.0, 0.0, 1.1])) @ R
    residual, ((_, H),) = Tilt((0,), EYE, turned[2]).linearise(values)
    np.testing.assert_allclose(residual, 0.0, atol=1e-10)
    np.testing.assert_allclose(H[:, :3] @ R[2], 0.0, atol=1e-10)  # a turn about the vertical
    off = exp_so3(np.array([0.0, 0.1, 0.0])) @ R
    residual, _ = Tilt((0,), EYE, off[2]).linearise(values)
    assert np.linalg.norm(residual) == pytest.approx(np.sin(0.1))


def test_a_displacement_gives_no_information_about_tilt():
    """Turning the first pose about any horizontal axis leaves the residual unchanged."""
    rng = np.random.default_rng(4)
    values = random_values(rng)
    _, ((_, H_i), *_) = terms(rng, values)[0].linearise(values)
    R_i = values.atPose3(X(0)).rotation().matrix()
    np.testing.assert_allclose(H_i[:, :3] @ R_i.T @ np.eye(3, 2), 0.0, atol=1e-10)


def test_a_prior_without_yaw_information_gains_none_wherever_it_is_linearised():
    """A turn about the vertical stays in its null space as the keyframes move."""
    rng = np.random.default_rng(5)
    there = random_values(rng)
    root = rng.normal(size=(30, 30))
    root[:, 17] = -root[:, 2]  # it constrains the turn from one keyframe to the next
    prior = Prior.white(0, tuple(KeyframeState.of(there, k) for k in (0, 1)), root, np.zeros(30))
    values = random_values(rng)
    a, b = (turned_about(k, KeyframeState.of(values, k), np.zeros(3)) for k in (0, 1))
    turn = a | b
    change = sum(H @ turn[key] for key, H in prior.linearise(values)[1])
    np.testing.assert_allclose(change, 0.0, atol=1e-10)


def test_the_error_from_itself_is_zero_and_of_a_turned_state_is_the_turn():
    state = KeyframeState.of(random_values(np.random.default_rng(6)), 0)
    R, error = exp_so3(0.7 * UP), np.zeros(15)
    np.testing.assert_allclose(state.error_from(state), error, atol=1e-10)
    turned = state._replace(R_WB=R @ state.R_WB, v_W=R @ state.v_W, p_W=R @ state.p_W)
    error[2] = 0.7
    np.testing.assert_allclose(turned.error_from(state), error, atol=1e-10)


WIDTHS = (6, 3, 6, 1)


def system(keyframes: int, height_sigma: float, closed: bool):
    """Return keys, dense Jacobian and factors of keyframes, each linked to the next two.

    If closed, the last one is linked to the first.

    The last axis of each pose is that much less certain than the others.
    """
    rng = np.random.default_rng(3)
    keys = [(X(k), V(k), B(k), T(k)) for k in range(keyframes)]
    graph, rows = gtsam.GaussianFactorGraph(), []
    for k in range(keyframes):
        linked = list(range(k, min(k + 3, keyframes)))
        linked += [0] if closed and k == keyframes - 1 else []
        blocks, row = [], np.zeros((20, 16 * keyframes))
        for j in linked:
            H = rng.normal(size=(20, 16))
            H[:, 5] /= height_sigma
            row[:, 16 * j : 16 * j + 16] = H
            blocks += list(zip(keys[j], np.split(H, np.cumsum(WIDTHS)[:3], axis=1), strict=True))
        graph.push_back(linear_factor(blocks, np.zeros(20)))
        rows.append(row)
    return [key for group in keys for key in group], np.vstack(rows), graph


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("height_sigma", [1.0, 1e6])
def test_covariances_are_blocks_of_the_dense_inverse(height_sigma, closed):
    keys, J, graph = system(7, height_sigma, closed)
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    covariances = dict(marginal_covariances(graph.eliminateSequential(ordering, gtsam.EliminateQR)))
    scale = np.tile([*[1.0] * 5, height_sigma, *[1.0] * 10], 7)
    dense = np.linalg.inv((J * scale).T @ (J * scale))
    assert sorted(covariances) == list(range(7))
    for k, covariance in covariances.items():
        rows = slice(16 * k, 16 * k + 15)
        found = covariance / np.outer(scale[rows], scale[rows])
        np.testing.assert_allclose(found, dense[rows, rows], rtol=1e-6, atol=1e-9)
