"""The network's turn: a state once fixes determine the direction, and absent before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import GRAPH as CONFIG

from stario.fusion import Navigator, NavState
from stario.fusion.backends import BackendName
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.with_fixes import track_with_fixes, true_fixes
from stario.fusion.evaluation.scores import values
from stario.fusion.filter.jacobians import turn_jacobian
from stario.fusion.filter.planar_alignment import PlanarAlignment
from stario.fusion.lie import yaw_twist
from stario.sequences.accuracy.metrics import pose_errors
from stario.sequences.attitude.so3 import exp_so3
from stario.sequences.sequence import ImuSequence

Make = Callable[..., Any]
TURN = 0.12
"""Turn of the network's displacements [rad]: seven degrees."""


class Turned:
    """A network whose displacements are all turned to the left."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def predict(self, windows: Any) -> Any:
        mean, covariance = self.inner.predict(windows)
        return mean @ exp_so3(np.array([0.0, 0.0, TURN])).T, covariance


def with_turn(sigma: float) -> NavigatorConfig:
    return replace(CONFIG, filter=replace(CONFIG.filter, network_turn_sigma=sigma))


def test_jacobian_agrees_with_finite_differences() -> None:
    """The measurement of a true displacement turns with the network."""
    d, step = np.array([1.2, -0.7, 0.1]), 1e-6
    row, H = turn_jacobian(d, 21)
    assert row == 21
    ends = [exp_so3(np.array([0.0, 0.0, s * step])) @ d for s in (1.0, -1.0)]
    np.testing.assert_allclose(H[:, 0], (ends[0] - ends[1]) / (2.0 * step), atol=1e-9)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_track_without_fixes_does_not_depend_on_the_turn(
    backend: BackendName, walk: ImuSequence, make_oracle: Make
) -> None:
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.05, sigma=0.05)
    one, other = (
        Navigator(oracle, with_turn(sigma), backend=backend).run(walk) for sigma in (0.05, 0.0)
    )
    np.testing.assert_array_equal(one.trajectory.position_W, other.trajectory.position_W)
    np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_turned_network_does_not_make_the_yaw_overconfident(
    backend: BackendName, make_walk: Make, make_oracle: Make
) -> None:
    """Fixes determine the track's direction, but cannot separate the yaw's error from the turn."""
    walk = make_walk(11, 60.0)
    model = Turned(make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03))
    estimated, ignored = (
        track_with_fixes(model, walk, with_turn(sigma), "walks", 3.0, 0.1, backend)
        for sigma in (0.1, 0.0)
    )
    assert values(estimated, "yaw_covered") > 0.95
    assert values(estimated, "yaw_nees") < 3.0
    assert values(ignored, "yaw_nees") > 2.0 * values(estimated, "yaw_nees")


def end_of_stream(
    backend: BackendName, config: NavigatorConfig, model: Any, walk: ImuSequence
) -> NavState:
    """Last state of a stream with fixes that is interrupted half way and continued elsewhere."""
    navigator = Navigator(model, config, backend=backend)
    fixes, states = true_fixes(walk.truth, 3.0, 0.1, seed=0), []
    for k, sample in enumerate(zip(walk.time, walk.gyro, walk.accel, strict=True)):
        while fixes and fixes[0].time <= sample[0]:
            fix = fixes.pop(0)
            navigator.update_position(fix.time, fix.value, fix.covariance)
        states.append(navigator.push(*sample))
        if k == len(walk.time) // 2:
            kept = navigator.snapshot()
            navigator = Navigator(model, config, backend=backend)
            navigator.restore(kept)
    return [s for s in states if s is not None][-1]


def test_a_streams_graph_is_as_certain_of_the_yaw_as_its_filter(
    make_walk: Make, make_oracle: Make
) -> None:
    """Although it marginalises all keyframes but the last seconds', and the turn with them."""
    walk = make_walk(11, 36.0, 50.0)
    model = Turned(make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03))
    ekf, graph = (end_of_stream(each, with_turn(0.1), model, walk) for each in ("ekf", "graph"))
    sigma = np.sqrt(graph.covariance[2, 2])
    assert sigma == pytest.approx(np.sqrt(ekf.covariance[2, 2]), rel=0.1)
    true = walk.truth.at(np.array([graph.time])).attitude_WB.as_matrix()[0]
    assert abs(yaw_twist(graph.R_WB @ true.T)) < 3.0 * sigma
    without_turn = end_of_stream("graph", with_turn(0.0), model, walk)
    assert np.sqrt(without_turn.covariance[2, 2]) < 0.7 * sigma


def test_positions_too_close_to_give_a_direction_alone_give_it_together(
    make_walk: Make, make_oracle: Make
) -> None:
    walk = make_walk(8, 60.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.02, sigma=0.02)
    farthest = np.linalg.norm(walk.truth.position_W[:, :2] - walk.truth.position_W[0, :2], axis=1)
    sigma = 0.4 * float(farthest.max())
    fixes = true_fixes(walk.truth, 1.0, sigma, seed=3)
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk, fixes=fixes)
    counts = track.health.fixes
    assert counts["yaw not known"] > 3
    assert counts["applied"] > 10
    yaw = pose_errors(track.trajectory, walk.truth).yaw[-1]
    assert abs(yaw) < 3.0 * np.sqrt(track.covariance[-1, 2, 2])


# --- the alignment -------------------------------------------------------------------------------


def alignment_of(
    rng: np.random.Generator, turn: float, count: int, sigma: float
) -> PlanarAlignment:
    """Alignment of a walk in a room, with independent noise in every fix."""
    z = rng.uniform(-2.0, 2.0, count) + 1j * rng.uniform(-2.0, 2.0, count)
    noise = rng.normal(0.0, sigma, count) + 1j * rng.normal(0.0, sigma, count)
    fixed = np.exp(1j * turn) * z + (3.0 - 1.0j) + noise
    positions = PlanarAlignment()
    for a, b in zip(z, fixed, strict=True):
        pair = np.array([a.real, a.imag]), np.array([b.real, b.imag])
        positions = positions.with_position(*pair, sigma**2, 0.0)
    return positions


@pytest.mark.parametrize("count", [5, 20])
def test_the_sigma_of_the_fitted_turn_is_consistent(count: int) -> None:
    rng, errors = np.random.default_rng(0), []
    for turn in rng.uniform(-np.pi, np.pi, 400):
        found, sigma = alignment_of(rng, turn, count, 0.3).turn
        errors.append(np.angle(np.exp(1j * (found - turn))) / sigma)
    assert 0.8 < np.mean(np.square(errors)) < 1.3


def test_fewer_than_two_places_give_no_direction() -> None:
    assert PlanarAlignment().turn[1] == np.inf
    here = PlanarAlignment()
    for fix in np.random.default_rng(1).normal(0.0, 1.0, (50, 2)):
        here = here.with_position(np.zeros(2), fix, 1.0, 0.0)
    assert here.turn[1] > 10.0


def test_positions_count_for_less_once_the_track_has_drifted() -> None:
    steady = alignment_of(np.random.default_rng(2), 0.5, 8, 0.3)
    last = np.array([1.0, 1.0]), np.array([2.0, 2.0])
    kept, drifted = (steady.with_position(*last, 0.09, drift) for drift in (0.0, 5.0))
    assert drifted.turn[1] > 2.0 * kept.turn[1]
    # The eight before it now have the drift's variance as well.
    assert drifted.sums[0] == pytest.approx(8.0 / (0.09 + 5.0) + 1.0 / 0.09)
