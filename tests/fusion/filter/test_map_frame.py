"""Fixes in a map's coordinates, behind gaps, refused ones: for the filter and for the graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support import GRAPH as CONFIG
from support import stream

from stario.fusion import Navigator, NavState
from stario.fusion.fixes import Fix, position_fix, yaw_fix
from stario.sequences.attitude.rotations import about_z
from stario.sequences.sequence import ImuSequence

Make = Callable[..., Any]
BACKENDS = ("ekf", "graph")
MAP = np.array([5.0e5, 4.5e6, 120.0])
"""Coordinates of a map in metres, such as UTM's."""


def true_at(walk: ImuSequence, time: float) -> np.ndarray:
    return walk.truth.at(np.array([time])).position_W[0]


def fixes_of(walk: ImuSequence, times: Any, shift: np.ndarray) -> list[Fix]:
    """Positions to 0.3 m in a world that is turned and shifted."""
    rng, turn, covariance = np.random.default_rng(1), about_z(2.0), 0.09 * np.eye(3)
    return [
        position_fix(t, turn.apply(true_at(walk, t)) + rng.normal(0.0, 0.3, 3) + shift, covariance)
        for t in times
    ]


def given(navigator: Navigator, walk: ImuSequence, fixes: list[Fix]) -> list[NavState]:
    for fix in fixes:
        navigator.update_position(fix.time, fix.value, fix.covariance)
    return stream(navigator, walk)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_map_far_from_its_origin_is_as_good_as_a_near_one(
    make_walk: Make, make_oracle: Make, backend: Any
) -> None:
    walk = make_walk(3, 40.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    found = []
    for shift in (np.zeros(3), MAP):
        fixes = fixes_of(walk, np.arange(5.0, 38.0, 3.0), shift)
        track = Navigator(oracle, CONFIG, backend=backend).run(walk, fixes=fixes)
        states = given(Navigator(oracle, CONFIG, backend=backend), walk, fixes)
        assert track.health.fixes == {"applied": len(fixes)}
        assert np.linalg.eigvalsh(track.covariance[:, 6:9, 6:9]).min() > 0.0
        found.append((track, states[-1], shift))
    (near, last, _), (far, far_last, _) = found
    np.testing.assert_allclose(
        far.trajectory.position_W - MAP, near.trajectory.position_W, atol=1e-4
    )
    np.testing.assert_allclose(far.covariance[-1], near.covariance[-1], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(far_last.p_W - MAP, last.p_W, atol=1e-4)
    np.testing.assert_allclose(far_last.covariance, last.covariance, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("gap", [4.0, 15.0])
def test_behind_a_gap_that_lost_the_yaw_fixes_find_it_again(
    make_walk: Make, make_oracle: Make, without: Make, backend: Any, gap: float
) -> None:
    """The walker turns in the gap; what was before it stays where fixes had put it."""
    walk = make_walk(6, 60.0)
    holed = without(walk, (walk.time > 20.0) & (walk.time < 20.0 + gap))
    oracle = make_oracle(holed, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    times = [*np.arange(3.0, 19.0, 3.0), *np.arange(22.0 + gap, 59.0, 3.0)]
    fixes = fixes_of(walk, times, np.zeros(3))
    track = Navigator(oracle, CONFIG, backend=backend).run(holed, fixes=fixes)
    truth = walk.truth.at(np.clip(track.time, walk.time[0], walk.time[-1]))
    error = track.trajectory.position_W - about_z(2.0).apply(truth.position_W)
    before, late = (track.time > 6.0) & (track.time < 20.0), track.time > 45.0
    assert np.linalg.norm(error[before | late], axis=1).max() < 1.2
    turn = (about_z(2.0) * truth.attitude_WB * track.trajectory.attitude_WB.inv()).as_rotvec()[:, 2]
    assert np.abs(turn[late]).max() < 0.1
    assert np.mean(turn[late] ** 2 / track.covariance[late, 2, 2]) < 6.0


def test_a_graph_takes_no_fix_that_the_filter_refused(make_walk: Make, make_oracle: Make) -> None:
    """A yaw of a device that hangs upside down says nothing."""
    walk = make_walk(3, 20.0, mount_rotvec=(np.pi, 0.0, 0.0))
    oracle = make_oracle(walk, walk.truth, CONFIG)
    ends = []
    for fixes in ([], [yaw_fix(10.03, 0.5, 0.01)]):
        navigator = Navigator(oracle, CONFIG, backend="graph")
        for fix in fixes:
            navigator.update_yaw(fix.time, 0.5, 0.01)
        ends.append(stream(navigator, walk)[-1].p_W)
        track = navigator.run(walk, fixes=fixes)
        assert track.health.notes[0].startswith("graph of")
    np.testing.assert_allclose(*ends, atol=1e-9)


def test_a_heading_alone_does_not_free_the_position(make_walk: Make, make_oracle: Make) -> None:
    walk = make_walk(4, 20.0)
    oracle = make_oracle(walk, walk.truth, CONFIG)
    fixes = [yaw_fix(10.0, 1.0, 0.05)]
    track = Navigator(oracle, CONFIG, backend="graph").run(walk, fixes=fixes)
    assert track.health.fixes == {"applied": 1}
    assert np.linalg.norm(track.trajectory.position_W[0]) < 0.01
    assert track.covariance[0, 6:9, 6:9].trace() < 0.01


class Level:
    """A network that does not know stairs."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def predict(self, windows: Any) -> Any:
        mean, covariance = self.inner.predict(windows)
        return mean + np.array([0.0, 0.0, 0.4]), covariance


def test_fixes_that_agree_win_against_a_track_that_is_sure_of_itself(
    make_walk: Make, make_oracle: Make
) -> None:
    """Else it ends twenty metres too high: each fix looks like an outlier."""
    walk = make_walk(3, 60.0)
    level = Level(make_oracle(walk, walk.truth, CONFIG, noise=0.02, sigma=0.02))
    fixes = fixes_of(walk, np.arange(3.0, 59.0, 2.0), np.zeros(3))
    track = Navigator(level, CONFIG).run(walk, fixes=fixes)
    truth = walk.truth.at(np.clip(track.time, walk.time[0], walk.time[-1]))
    error = track.trajectory.position_W - about_z(2.0).apply(truth.position_W)
    assert np.linalg.norm(error[track.time > 20.0], axis=1).max() < 4.0
    assert track.health.fixes["gated"] > 3


def test_neither_gaps_nor_fixes_let_a_streams_graph_grow(
    make_walk: Make, make_oracle: Make, without: Make
) -> None:
    walk = make_walk(5, 40.0)
    holed = without(walk, (walk.time > 5.0) & (walk.time % 3.0 < 0.3))
    for recording, fixes in ((holed, []), (walk, fixes_of(walk, np.arange(3.0, 39.0, 0.1), MAP))):
        oracle = make_oracle(recording, walk.truth, CONFIG)
        navigator = Navigator(oracle, CONFIG, backend="graph")
        given(navigator, recording, fixes)
        assert len(navigator._estimator._builder.graph.keyframes) < 16
