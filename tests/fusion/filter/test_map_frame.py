from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated import Oracle, measured
from support import GRAPH as CONFIG
from support import Altered, lying, stream

from stario.fusion import Fix, Navigator, NavState, PriorPose, Track, position_fix, yaw_fix
from stario.fusion.evaluation.checks.fusion import true_fixes
from stario.fusion.filter.planar_alignment import PlanarAlignment
from stario.fusion.report.health import health_findings
from stario.fusion.values.lie import yaw_twist
from stario.sequences import ImuSequence, about_z, yaw_of
from stario.sequences.accuracy.metrics import pose_errors

BACKENDS = ("ekf", "graph")
MAP = np.array([5.0e5, 4.5e6, 120.0])
"""Offset of a map's coordinates [m], such as UTM's."""


def true_at(walk: ImuSequence, time: float) -> np.ndarray:
    return walk.truth.at(np.array([time])).position_W[0]


def fixes_of(walk: ImuSequence, times: Any, shift: np.ndarray, sigma: float = 0.3) -> list[Fix]:
    """Positions with a sigma [m] in a map frame that is turned and shifted."""
    rng, turn, covariance = np.random.default_rng(1), about_z(2.0), sigma**2 * np.eye(3)
    fixes = []
    for t in times:
        place = turn.apply(true_at(walk, t)) + rng.normal(0.0, sigma, 3) + shift
        fixes.append(position_fix(t, place, covariance))
    return fixes


def stream_with_fixes(navigator: Navigator, walk: ImuSequence, fixes: list[Fix]) -> list[NavState]:
    for fix in fixes:
        navigator.update_position(fix.time, fix.value, fix.covariance)
    return stream(navigator, walk)


@pytest.mark.parametrize("backend", BACKENDS)
def test_fixes_far_from_the_maps_origin_are_as_accurate_as_near_ones(backend):
    walk, _, oracle = measured(3, 8.0, CONFIG)
    found = []
    for shift in (np.zeros(3), MAP):
        fixes = fixes_of(walk, (3.0, 6.0), shift)
        track = Navigator(oracle, CONFIG, backend=backend).run(walk, fixes=fixes)
        states = stream_with_fixes(Navigator(oracle, CONFIG, backend=backend), walk, fixes)
        assert track.health.fixes == {"applied": len(fixes)}
        assert np.linalg.eigvalsh(track.covariance[:, 6:9, 6:9]).min() > 0.0
        found.append((track, states[-1], shift))
    (near, last, _), (far, far_last, _) = found
    shifted = far.trajectory.position_W - MAP
    np.testing.assert_allclose(shifted, near.trajectory.position_W, atol=1e-4)
    np.testing.assert_allclose(far.covariance[-1], near.covariance[-1], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(far_last.p_W - MAP, last.p_W, atol=1e-4)
    np.testing.assert_allclose(far_last.covariance, last.covariance, rtol=1e-3, atol=1e-9)


def test_a_fix_at_the_first_sample_places_the_first_state_too(make_walk, make_oracle):
    walk = make_walk(3, 5.0)
    oracle = make_oracle(walk, walk.truth, CONFIG)
    fix = position_fix(walk.time[0], MAP, 0.01 * np.eye(3))
    graph = Navigator(oracle, CONFIG).run(walk, fixes=[fix])
    for track in (graph, graph.filtered):
        np.testing.assert_allclose(track.trajectory.position_W[0], MAP, atol=1e-3)
        np.testing.assert_allclose(np.diag(track.covariance[0, 6:9, 6:9]), 0.01, rtol=0.01)


@pytest.mark.parametrize(("backend", "gap"), [("ekf", 15.0), ("graph", 4.0)])
def test_fixes_recover_the_yaw_after_a_gap_that_lost_it(backend, gap):
    """The pedestrian turns in the gap; the track before it stays where the fixes placed it."""
    walk, holed, oracle = measured(6, 50.0, CONFIG, gap=(20.0, 20.0 + gap))
    times = [*np.arange(3.0, 19.0, 3.0), *np.arange(22.0 + gap, 49.0, 3.0)]
    fixes = fixes_of(walk, times, np.zeros(3))
    track = Navigator(oracle, CONFIG, backend=backend).run(holed, fixes=fixes)
    truth = walk.truth.at(np.clip(track.time, walk.time[0], walk.time[-1]))
    error = track.trajectory.position_W - about_z(2.0).apply(truth.position_W)
    before, late = (track.time > 6.0) & (track.time < 20.0), track.time > 42.0
    assert np.linalg.norm(error[before | late], axis=1).max() < 1.2
    turn = (about_z(2.0) * truth.attitude_WB * track.trajectory.attitude_WB.inv()).as_rotvec()[:, 2]
    assert np.abs(turn[late]).max() < 0.1
    assert np.mean(turn[late] ** 2 / track.covariance[late, 2, 2]) < 6.0


def test_the_graph_uses_no_fix_that_the_filter_refused(make_walk, make_oracle):
    """The yaw of a device that hangs upside down is undefined."""
    walk = make_walk(3, 4.0, mount_rotvec=(np.pi, 0.0, 0.0))
    oracle = make_oracle(walk, walk.truth, CONFIG)
    ends = []
    for fixes in ([], [yaw_fix(3.03, 0.5, 0.01)]):
        navigator = Navigator(oracle, CONFIG, backend="graph")
        for fix in fixes:
            navigator.update_yaw(fix.time, 0.5, 0.01)
        ends.append(stream(navigator, walk)[-1].p_W)
        track = navigator.run(walk, fixes=fixes)
        assert not any("fell back" in note for note in track.health.notes)
    np.testing.assert_allclose(*ends, atol=1e-9)


def test_a_heading_alone_does_not_make_the_position_uncertain(make_walk, make_oracle):
    walk = make_walk(4, 8.0)
    oracle = make_oracle(walk, walk.truth, CONFIG)
    fixes = [yaw_fix(5.0, 1.0, 0.05)]
    track = Navigator(oracle, CONFIG, backend="graph").run(walk, fixes=fixes)
    assert track.health.fixes == {"applied": 1}
    assert np.linalg.norm(track.trajectory.position_W[0]) < 0.01
    assert track.covariance[0, 6:9, 6:9].trace() < 0.01


@pytest.mark.slow
def test_fixes_that_agree_prevail_over_an_overconfident_track(make_walk, make_oracle):
    """Otherwise it ends twenty metres too high, as each fix alone looks like an outlier."""
    walk = make_walk(3, 60.0, 50.0)

    def climb(number, mean, covariance):
        mean[:, 2] += 0.4

    climbing = Altered(make_oracle(walk, walk.truth, CONFIG, noise=0.02, sigma=0.02), climb)
    fixes = fixes_of(walk, np.arange(3.0, 59.0, 2.0), np.zeros(3))
    track = Navigator(climbing, CONFIG, backend="ekf").run(walk, fixes=fixes)
    truth = walk.truth.at(np.clip(track.time, walk.time[0], walk.time[-1]))
    error = track.trajectory.position_W - about_z(2.0).apply(truth.position_W)
    assert np.linalg.norm(error[track.time > 20.0], axis=1).max() < 4.0
    assert track.health.fixes["gated"] > 3


@pytest.mark.slow
def test_neither_gaps_nor_fixes_make_a_streams_graph_grow(make_walk, make_oracle, without):
    walk = make_walk(5, 12.0, 50.0)
    holed = without(walk, (walk.time > 3.0) & (walk.time % 3.0 < 0.3))
    for recording, fixes in ((holed, []), (walk, fixes_of(walk, np.arange(3.0, 11.0, 0.1), MAP))):
        oracle = make_oracle(recording, walk.truth, CONFIG)
        navigator = Navigator(oracle, CONFIG, backend="graph")
        stream_with_fixes(navigator, recording, fixes)
        assert len(navigator._stream.graph.builder.graph.states) < 16


def yaw_error(walk: ImuSequence, states: list[NavState]) -> tuple[np.ndarray, np.ndarray]:
    """Yaw error in the frame of the fixes [rad], and its sigma."""
    attitude = walk.truth.at(np.array([s.time for s in states])).attitude_WB
    yaw = np.array([yaw_twist(s.R_WB) for s in states]) - yaw_of(attitude) - 2.0
    sigma = np.array([np.sqrt(s.covariance[2, 2]) for s in states])
    return np.angle(np.exp(1j * yaw)), sigma


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wrong_first_position_does_not_turn_the_track(backend):
    walk, _, oracle = measured(3, 20.0, CONFIG)
    fixes = fixes_of(walk, np.arange(2.0, 19.0, 3.0), np.zeros(3))
    off = [200.0, 0.0, 0.0]
    bad = position_fix(fixes[0].time, fixes[0].value + off, fixes[0].covariance)
    states = stream_with_fixes(Navigator(oracle, CONFIG, backend=backend), walk, [bad, *fixes[1:]])
    error, sigma = yaw_error(walk, states[-20:])
    assert (np.abs(error) < 4.0 * sigma).all()
    assert sigma[-1] < 0.2
    end = fixes[-1]
    at_end = min(states, key=lambda s: abs(s.time - end.time))
    assert np.linalg.norm(at_end.p_W - end.value) < 1.5


def carried(walk: ImuSequence, start: float, stop: float, metres: float) -> ImuSequence:
    """The walk in a vehicle that starts and stops then and goes that far along x."""

    def ride(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = np.clip((time - start) / (stop - start), 0.0, 1.0)
        speed = 2.0 * metres / (stop - start)
        distance = metres * (s - np.sin(2.0 * np.pi * s) / (2.0 * np.pi))
        acceleration = speed * np.pi / (stop - start) * np.sin(2.0 * np.pi * s)
        return np.outer(distance, [1.0, 0.0, 0.0]), np.outer(acceleration, [1.0, 0.0, 0.0])

    attitude = walk.truth.at(np.clip(walk.time, *walk.truth.time[[0, -1]])).attitude_WB
    accel = walk.accel + attitude.inv().apply(ride(walk.time)[1])
    position_W = walk.truth.position_W + ride(walk.truth.time)[0]
    return replace(walk, accel=accel, truth=replace(walk.truth, position_W=position_W))


RIDE = (20.0, 50.0, 150.0)
"""Start and stop [s] of a vehicle, and its way [m]."""


def ridden(sigma: float = 0.3) -> tuple[ImuSequence, Oracle, list[Fix]]:
    """A walk with the ride, displacements relative to the vehicle, and positions beside it."""
    walk, _, _ = measured(3, 80.0, CONFIG)
    ride = carried(walk, *RIDE)
    oracle = Oracle(ride, walk.truth, CONFIG, noise=0.03, sigma=0.03)
    times = np.concatenate([np.arange(2.0, 20.0, 3.0), np.arange(51.0, 79.0, 3.0)])
    return ride, oracle, fixes_of(ride, times, np.zeros(3), sigma)


def beside_ride(track: Track, ride: ImuSequence) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal errors [m] before the ride, and from the fixes after it on, and their sigmas."""
    time = track.time
    rows = (time < ride.truth.time[-1]) & ((time < 20.0) | (time > 51.0))
    true = about_z(2.0).apply(ride.truth.at(time[rows]).position_W)
    error = np.linalg.norm((track.trajectory.position_W[rows] - true)[:, :2], axis=1)
    return error, np.sqrt(track.covariance[rows][:, [6, 7], [6, 7]].sum(axis=1))


def test_a_ride_between_positions_bends_neither_side_of_the_smoothed_track():
    ride, oracle, fixes = ridden()
    track = Navigator(oracle, CONFIG).run(ride, fixes=fixes)
    assert beside_ride(track, ride)[0].max() < 1.5
    since, until, metres, is_carried = track.health.jumps[0]
    assert is_carried
    assert 15.0 < since < 20.0 < 50.0 < until < 52.0
    assert metres == pytest.approx(150.0, abs=20.0)
    (found,) = (f for f in health_findings(track.health) if f.code == "jumps")
    assert found.level == "warning"
    assert f"between {since:.0f} s and {until:.0f} s" in found.text


def test_a_ride_before_the_direction_is_known_leaves_the_track_before_it_in_place():
    """Positions on both sides give the direction together."""
    ride, oracle, fixes = ridden(sigma=4.0)
    track = Navigator(oracle, CONFIG).run(ride, fixes=fixes)
    assert track.health.fixes["at a distance that contradicts the track"] == 2
    assert [round(jump[1]) for jump in track.health.jumps] == [51]
    for each in (track, track.filtered):
        error, sigma = beside_ride(each, ride)
        assert (error < 3.0 * sigma).all()
        assert sigma.max() < 10.0


@pytest.mark.slow
def test_positions_undo_a_yaw_that_pointed_backwards():
    walk, _, oracle = measured(3, 40.0, CONFIG)
    wrong = yaw_of(walk.truth.at(np.array([4.0])).attitude_WB)[0] + np.pi
    right = [position_fix(t, true_at(walk, t), 0.09 * np.eye(3)) for t in np.arange(5.0, 38.0, 1.0)]
    graph = Navigator(oracle, CONFIG).run(walk, fixes=[yaw_fix(4.0, wrong, 0.1), *right])
    for track in (graph, graph.filtered):
        late = track.time > 28.0
        truth = walk.truth.at(track.time[late])
        turned = yaw_of(track.trajectory.attitude_WB[late] * truth.attitude_WB.inv())
        sigma = np.sqrt(track.covariance[late, 2, 2])
        assert (np.abs(turned) < np.maximum(3.0 * sigma, 0.1)).all()
        assert sigma.max() < 0.3
        error = np.linalg.norm(track.trajectory.position_W[late] - truth.position_W, axis=1)
        assert error.max() < 1.0


def test_more_accurate_positions_move_a_stationary_track(still_model):
    fixes = [position_fix(3.0, [40.0, -30.0, 8.0], 2500.0 * np.eye(3))]
    fixes += [position_fix(t, np.zeros(3), np.eye(3)) for t in (5.0, 8.0, 11.0)]
    track = Navigator(still_model, backend="ekf").run(lying(20.0), fixes=fixes)
    assert np.linalg.norm(track.trajectory.position_W[-1]) < 1.0
    sigma = np.sqrt(np.diag(track.covariance[-1])[6:9])
    assert ((sigma > 0.5) & (sigma < 1.5)).all()


def test_the_track_is_turned_about_its_prior_position():
    walk, _, oracle = measured(3, 28.0, CONFIG)
    far, turn = np.array([100.0, 50.0, 0.0]), about_z(2.0)
    fixes = fixes_of(walk, np.arange(3.0, 27.0, 3.0), far)
    first = walk.truth.attitude_WB[0].as_matrix()
    p_W = turn.apply(walk.truth.position_W[0]) + far
    prior = PriorPose(first, np.zeros(3), p_W, yaw_sigma=3.0, position_sigma=1.0)
    navigator = Navigator(oracle, CONFIG, prior)
    error, sigma = yaw_error(walk, stream_with_fixes(navigator, walk, fixes))
    assert (np.abs(error) < 4.0 * sigma).all()
    assert sigma[-1] < 0.1


def test_the_first_positions_drift_is_its_own_error(walk, still_model):
    """Else the track's drift to the next position would seem small next to it."""
    navigator = Navigator(still_model)
    stream_with_fixes(navigator, walk, [position_fix(3.0, MAP, 0.3**2 * np.eye(3))])
    assert navigator._stream.state.map_frame.alignment.drift < 0.2


def test_uninformative_fixes_in_a_gap_leave_its_turn_as_uncertain(make_walk, without, still_model):
    walk = make_walk(3, 20.0)
    broken = without(walk, (walk.time > 8.0) & (walk.time < 8.9))
    prior = PriorPose(walk.truth.attitude_WB[0].as_matrix(), np.zeros(3), walk.truth.position_W[0])
    useless = [position_fix(t, np.zeros(3), 1e6 * np.eye(3)) for t in np.arange(8.1, 8.9, 0.1)]
    navigator = Navigator(still_model, prior=prior, backend="ekf")
    plain, cut = (navigator.run(broken, fixes=fixes) for fixes in ([], useless))
    row = np.searchsorted(plain.time, 8.95)
    assert plain.covariance[row, 2, 2] > 0.2
    np.testing.assert_allclose(cut.covariance[row, 2, 2], plain.covariance[row, 2, 2], rtol=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_false_position_does_not_block_a_yaw(backend):
    walk, _, oracle = measured(3, 12.0, CONFIG)
    first, off = fixes_of(walk, [2.0, 4.0], np.zeros(3))
    off = position_fix(off.time, off.value + np.array([60.0, 0.0, 0.0]), off.covariance)
    yaw = float(yaw_of(walk.truth.at(np.array([5.0])).attitude_WB)[0]) + 2.0
    navigator = Navigator(oracle, CONFIG, backend=backend)
    navigator.update_yaw(5.0, yaw, 0.1)
    error, sigma = yaw_error(walk, stream_with_fixes(navigator, walk, [first, off])[-20:])
    assert (np.abs(error) < 4.0 * sigma).all()
    assert sigma[-1] < 0.2


def test_a_horizontal_position_is_kept_over_a_coarser_one_with_height():
    walk, _, oracle = measured(3, 8.0, CONFIG)
    start = true_at(walk, 1.5)
    plane = position_fix(1.5, [start[0], start[1], 0.0], np.diag([0.09, 0.09, 1e6]))
    coarse = position_fix(2.5, true_at(walk, 2.5) + np.array([6.0, 6.0, 0.0]), 64.0 * np.eye(3))
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk, fixes=[plane, coarse])
    at = np.searchsorted(track.time, 1.5)
    assert np.linalg.norm(track.trajectory.position_W[at, :2] - start[:2]) < 0.5
    assert track.health.fixes == {"applied": 1, "yaw not known": 1}


def test_positions_too_close_to_give_a_direction_alone_give_it_together():
    walk, _, oracle = measured(13, 45.0, CONFIG, noise=0.02)
    farthest = np.linalg.norm(walk.truth.position_W[:, :2] - walk.truth.position_W[0, :2], axis=1)
    sigma = 0.4 * float(farthest.max())
    fixes = true_fixes(walk.truth, 1.0, sigma, seed=13)
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk, fixes=fixes)
    counts = track.health.fixes
    assert counts["yaw not known"] > 3
    assert counts["applied"] > 5
    yaw = pose_errors(track.trajectory, walk.truth).yaw[-1]
    assert abs(yaw) < 3.0 * np.sqrt(track.covariance[-1, 2, 2])


def alignment_of(rng: np.random.Generator, turn, count, sigma) -> PlanarAlignment:
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
def test_the_sigma_of_the_fitted_turn_is_consistent(count):
    rng, errors = np.random.default_rng(0), []
    for turn in rng.uniform(-np.pi, np.pi, 400):
        found, sigma = alignment_of(rng, turn, count, 0.3).turn
        errors.append(np.angle(np.exp(1j * (found - turn))) / sigma)
    assert 0.8 < np.mean(np.square(errors)) < 1.3


def test_fewer_than_two_places_give_no_direction():
    assert PlanarAlignment().turn[1] == np.inf
    here = PlanarAlignment()
    for fix in np.random.default_rng(1).normal(0.0, 1.0, (50, 2)):
        here = here.with_position(np.zeros(2), fix, 1.0, 0.0)
    assert here.turn[1] > 10.0


def test_positions_count_for_less_once_the_track_has_drifted():
    steady = alignment_of(np.random.default_rng(2), 0.5, 8, 0.3)
    last = np.array([1.0, 1.0]), np.array([2.0, 2.0])
    kept, drifted = (steady.with_position(*last, 0.09, drift) for drift in (0.0, 5.0))
    assert drifted.turn[1] > 2.0 * kept.turn[1]
    # The eight before it now have the drift's variance as well.
    assert drifted.sums[0] == pytest.approx(8.0 / (0.09 + 5.0) + 1.0 / 0.09)
