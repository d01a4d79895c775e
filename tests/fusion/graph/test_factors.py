"""Jacobians of the graph's terms against finite differences, and what they must not observe."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, T, V, X

from stario.fusion.graph.bearing import Bearing
from stario.fusion.graph.factors import (
    Displacement,
    GyroBias,
    Position,
    Prior,
    Term,
    TurnProcess,
    Velocity,
    Yaw,
)
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.sequences.attitude.so3 import exp_so3

EYE = np.eye(3)


def random_values(rng: np.random.Generator) -> Any:
    values = gtsam.Values()
    for k in (0, 1):
        R = exp_so3(rng.normal(size=3))
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(R), rng.normal(size=3)))
        values.insert(V(k), rng.normal(size=3))
        values.insert(B(k), gtsam.imuBias.ConstantBias(rng.normal(size=3), rng.normal(size=3)))
        values.insert(T(k), rng.normal(size=1))
    return values


def moved(values: Any, key: int, step: np.ndarray) -> Any:
    delta = gtsam.VectorValues()
    delta.insert(key, step)
    return values.retract(delta)


def terms(rng: np.random.Generator, values: Any) -> list[Term]:
    state, next_state = (KeyframeState.of(values, k) for k in (0, 1))
    # A window's levelled attitude differs from the world's in yaw, and a little in tilt.
    R_NB = exp_so3(np.array([0.0, 0.0, 0.9])) @ state.R_WB
    return [
        Displacement(0, 1, rng.normal(size=3), R_NB, EYE),
        Position(0, rng.normal(size=3), EYE, 0.4, rng.normal(size=3)),
        Velocity(0, rng.normal(size=3), EYE, rng.normal(size=3)),
        Yaw(0, exp_so3(np.array([0.0, 0.0, 0.3])) @ state.R_WB, np.eye(1)),
        GyroBias(0, rng.normal(size=3), EYE),
        Prior(0, (state, next_state), rng.normal(size=(20, 30)), rng.normal(size=20)),
        Displacement(0, 1, rng.normal(size=3), R_NB, EYE, turned=True),
        TurnProcess(0, 1, 0.6, np.eye(1)),
        TurnProcess(1, 1, 0.0, np.eye(1)),
        Prior(0, (state,), rng.normal(size=(9, 16)), rng.normal(size=9), ((0, 0.2),)),
        Bearing(0, state.R_WB, rng.normal(size=3), rng.normal(size=6), 0.7, np.eye(1)),
    ]


@pytest.mark.parametrize("which", range(11))
def test_jacobians_agree_with_finite_differences(which: int) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        values = random_values(rng)
        term = terms(rng, values)[which]
        residual, blocks = term.linearise(values)
        given = {key: H for key, H in blocks}
        assert residual.shape == (len(term.covariance),)
        for key in values.keys():  # noqa: SIM118
            width = {V(0): 3, V(1): 3, T(0): 1, T(1): 1}.get(key, 6)
            for column in range(width):
                step = np.zeros(width)
                step[column] = 1e-5
                ahead = term.linearise(moved(values, key, step))[0]
                behind = term.linearise(moved(values, key, -step))[0]
                expected = given[key][:, column] if key in given else np.zeros(len(residual))
                # The residual is measured minus predicted.
                np.testing.assert_allclose(-(ahead - behind) / 2e-5, expected, atol=2e-6)


def in_turned_world(values: Any, yaw: float, shift: np.ndarray) -> Any:
    R = exp_so3(np.array([0.0, 0.0, yaw]))
    turned = gtsam.Values()
    for k in (0, 1):
        state = KeyframeState.of(values, k)
        pose = gtsam.Pose3(gtsam.Rot3(R @ state.R_WB), R @ state.p_W + shift)
        turned.insert(X(k), pose)
        turned.insert(V(k), R @ state.v_W)
        turned.insert(B(k), values.atConstantBias(B(k)))
    return turned


def test_a_displacement_does_not_depend_on_the_turn_of_the_world() -> None:
    rng = np.random.default_rng(3)
    values = random_values(rng)
    term = terms(rng, values)[0]
    turned = in_turned_world(values, 2.0, np.array([5.0, -3.0, 1.0]))
    ours, theirs = (term.linearise(v)[0] for v in (turned, values))
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_a_displacement_gives_no_information_about_tilt() -> None:
    """Turning the first pose about any horizontal axis leaves the residual unchanged."""
    rng = np.random.default_rng(4)
    values = random_values(rng)
    _, ((_, H_i), _) = terms(rng, values)[0].linearise(values)
    R_i = values.atPose3(X(0)).rotation().matrix()
    np.testing.assert_allclose(H_i[:, :3] @ R_i.T @ np.eye(3, 2), 0.0, atol=1e-12)


def test_a_prior_without_yaw_information_gains_none_wherever_it_is_linearised() -> None:
    """A turn about the vertical stays in its null space as the keyframes move."""
    rng = np.random.default_rng(5)
    there = random_values(rng)
    root = rng.normal(size=(30, 30))
    root[:, 17] = -root[:, 2]  # it constrains the turn from one keyframe to the next
    prior = Prior(0, tuple(KeyframeState.of(there, k) for k in (0, 1)), root, np.zeros(30))
    values = random_values(rng)
    up = np.array([0.0, 0.0, 1.0])
    turn = {}  # gtsam's tangent of a world turned about its origin
    for k in (0, 1):
        state = KeyframeState.of(values, k)
        R_BW = state.R_WB.T
        turn[X(k)] = np.concatenate([R_BW @ up, R_BW @ np.cross(up, state.p_W)])
        turn[V(k)] = np.cross(up, state.v_W)
        turn[B(k)] = np.zeros(6)
    change = sum(H @ turn[key] for key, H in prior.linearise(values)[1])
    np.testing.assert_allclose(change, 0.0, atol=1e-12)


def test_the_error_from_itself_is_zero_and_of_a_turned_state_is_the_turn() -> None:
    values = random_values(np.random.default_rng(6))
    state = KeyframeState.of(values, 0)
    turned = KeyframeState.of(in_turned_world(values, 0.7, np.zeros(3)), 0)
    np.testing.assert_allclose(state.error_from(state), 0.0, atol=1e-12)
    expected = np.zeros(15)
    expected[2] = 0.7
    np.testing.assert_allclose(turned.error_from(state), expected, atol=1e-12)
