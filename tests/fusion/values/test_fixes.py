import numpy as np
import pytest
import support
from support import WHITE as CONFIG
from support import WHITE_ERRORS as ERRORS

from stario.fusion import Navigator, NavState, PriorPose, Track
from stario.fusion.imu.intervals import split_at
from stario.fusion.recording import cut_recording
from stario.fusion.values.fixes import Fix, position_fix, velocity_fix, yaw_fix
from stario.fusion.values.lie import UNKNOWN_YAW
from stario.sequences import ImuSequence, about_z, yaw_of

EYE = np.eye(3)
ROOT = np.array([[0.1, 0.1], [0.1, 0.3], [0.2, 0.7]])
"""Root of a covariance that is singular but for rounding."""


@pytest.fixture(scope="module")
def walk(make_walk):
    return make_walk(7, 30.0, 100.0, ERRORS)


@pytest.fixture(scope="module")
def model(walk, make_oracle):
    return make_oracle(walk, walk.truth, CONFIG)


@pytest.fixture(scope="module")
def fixed(walk, model):
    return Navigator(model, CONFIG, backend="ekf").run(walk, fixes=fixes_of(walk))


def truth_at(walk: ImuSequence, time: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Position, velocity and yaw."""
    known = walk.truth.at(np.array([time]))
    return known.position_W[0], known.velocity_W[0], float(yaw_of(known.attitude_WB)[0])


def fixes_of(walk: ImuSequence) -> list[Fix]:
    """Fixes of every kind, between and at the times of states and measurements."""
    p, v, yaw = zip(*(truth_at(walk, t) for t in (5.03, 12.0, 20.377)), strict=True)
    return [
        position_fix(5.03, p[0], 0.01 * EYE),
        yaw_fix(12.0, yaw[1], 0.05),
        velocity_fix(20.377, v[2], 0.01 * EYE),
        position_fix(20.377, p[2], 0.04 * EYE),
    ]


def apply_fix(navigator: Navigator, fix: Fix) -> None:
    if fix.kind == "position":
        navigator.update_position(fix.time, fix.value, fix.covariance)
    elif fix.kind == "velocity":
        navigator.update_velocity(fix.time, fix.value, fix.covariance)
    else:
        navigator.update_yaw(fix.time, fix.value[0], float(np.sqrt(fix.covariance[0, 0])))


def streamed(navigator: Navigator, walk: ImuSequence, fixes: list[Fix], late: float) -> NavState:
    """Last state of a stream that receives each fix `late` seconds after its time."""
    waiting = sorted(fixes, key=lambda fix: fix.time)
    for row in zip(walk.time, walk.gyro, walk.accel, strict=True):
        while waiting and row[0] >= waiting[0].time + late:
            apply_fix(navigator, waiting.pop(0))
        navigator.push(*row)
    return navigator.state


def assert_same(state: NavState, track: Track, atol: float = 1e-9) -> None:
    k = int(np.searchsorted(track.time, state.time - 1e-6))
    assert track.time[k] == pytest.approx(state.time)
    np.testing.assert_allclose(state.p_W, track.trajectory.position_W[k], atol=atol)
    np.testing.assert_allclose(state.v_W, track.trajectory.velocity_W[k], atol=atol)
    np.testing.assert_allclose(state.R_WB, track.trajectory.attitude_WB[k].as_matrix(), atol=atol)
    np.testing.assert_allclose(state.covariance, track.covariance[k], atol=atol)


@pytest.mark.parametrize("late", [-3.0, 0.3, 0.85])
def test_a_fix_is_applied_at_its_own_time_however_late(walk, model, fixed, late):
    navigator = Navigator(model, CONFIG)
    state = streamed(navigator, walk, fixes_of(walk), late)
    assert_same(state, fixed)
    assert state.map_frame == 2
    assert navigator.health.fixes["applied"] == fixed.health.fixes["applied"] == 4
    assert sum(navigator.health.fix_kinds.values()) == 4
    assert navigator.health.fix_kinds == fixed.health.fix_kinds
    assert navigator.health.updates == fixed.health.updates
    assert navigator.health.mean_nis == pytest.approx(fixed.health.mean_nis)
    assert navigator.health.zero_velocity == fixed.health.zero_velocity


def test_fixes_that_are_too_old_are_refused_and_counted(walk, model):
    untouched, navigator = Navigator(model, CONFIG), Navigator(model, CONFIG)
    streamed(untouched, walk, [], 0.0)
    streamed(navigator, walk, fixes_of(walk), 1.6)
    assert navigator.health.fixes == {"too late": 4}
    np.testing.assert_array_equal(navigator.state.p_W, untouched.state.p_W)
    before, after = (position_fix(t, np.zeros(3), EYE) for t in (walk.time[0] - 1.0, 1e6))
    track = Navigator(model, CONFIG, backend="ekf").run(walk, fixes=[after, before])
    assert track.health.fixes == {"before the start": 1, "after the end": 1}


def test_a_fix_one_window_late_is_not_too_late_by_rounding(walk, model):
    navigator, given = Navigator(model, CONFIG), 0
    for row in zip(walk.time[:1250], walk.gyro, walk.accel, strict=False):
        state = navigator.push(*row)
        if state is not None and state.time > walk.time[0] + 1.05:
            navigator.update_velocity(round(state.time - 1.0, 6), np.zeros(3), 1e6 * EYE)
            given += 1
    assert given > 100
    assert "too late" not in navigator.health.fixes


def test_future_fixes_wait_for_their_time(walk, model, fixed):
    navigator = Navigator(model, CONFIG)
    for fix in reversed(fixes_of(walk)):
        apply_fix(navigator, fix)
    apply_fix(navigator, position_fix(walk.time[-1] + 60.0, np.zeros(3), EYE))
    assert navigator.health.fixes == {"waiting": 5}
    state = streamed(navigator, walk, [], 0.0)
    assert navigator.health.fixes == {"applied": 4, "waiting": 1}
    assert_same(state, fixed)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_fix_tells_what_became_of_it(walk, model, backend):
    navigator = Navigator(model, CONFIG, backend=backend)
    p = [truth_at(walk, t)[0] for t in (4.0, 12.0, 16.0)]
    assert navigator.update_position(4.0, p[0], 0.01 * EYE) == "waiting"
    assert navigator.update_position(4.0, p[0], -EYE) == "refused"
    support.stream(navigator, walk.slice(0.0, 16.5))
    assert navigator.update_yaw(15.9, 0.0, 1.5) == "refused"  # too coarse
    assert navigator.update_position(16.0, p[2], 0.01 * EYE) == "applied"
    assert navigator.update_position(16.0, p[2] + [9.0, 0.0, 0.0], 0.01 * EYE) == "inflated"
    assert navigator.update_velocity(12.0, np.zeros(3), EYE) == "refused"  # too late
    assert navigator.update_position(20.0, p[2], EYE) == "waiting"
    reasons = {"too coarse": 1, "too late": 1, "covariance not positive definite": 1}
    assert {key: navigator.health.fixes[key] for key in reasons} == reasons


def test_an_interval_split_in_two_keeps_its_window_and_integrals(walk):
    interval = next(e for e in cut_recording(walk, CONFIG)[0] if e.window is not None)
    for time in (interval.start + 0.033, float(interval.time[4]), interval.stop - 1e-4):
        first, second = split_at(interval, time)
        assert first.stop == second.start == time
        assert first.window is None
        assert second.window is interval.window
        for name in ("gyro", "accel"):
            whole = np.trapezoid(getattr(interval, name), interval.time, axis=0)
            halves = [np.trapezoid(getattr(e, name), e.time, axis=0) for e in (first, second)]
            np.testing.assert_allclose(sum(halves), whole, atol=1e-10)


@pytest.mark.parametrize("turn", [0.0, -2.5])
def test_two_positions_determine_the_position_and_direction_of_a_track(walk, model, turn):
    R, shift = about_z(turn).as_matrix(), np.array([5e3, -2e4, 30.0])
    places = ((t, R @ truth_at(walk, t)[0] + shift) for t in (4.0, 6.0, 28.0, 29.6))
    fixes = [position_fix(t, place, 1e-4 * EYE) for t, place in places]
    track = Navigator(model, CONFIG, backend="ekf").run(walk, fixes=fixes)
    truth = walk.truth.at(track.time.clip(0.0, walk.time[-1]))
    error = track.trajectory.position_W - (truth.position_W @ R.T + shift)
    assert np.linalg.norm(error[-1]) < 0.05  # half a second after a fix of 1 cm
    assert np.linalg.norm(error, axis=1).max() < 0.5
    yaw = yaw_of(about_z(turn) * truth.attitude_WB) - yaw_of(track.trajectory.attitude_WB)
    assert abs(np.sin(yaw[-1])) < 0.05
    assert track.health.fixes["applied"] >= 3
    assert np.linalg.norm(np.diff(track.trajectory.position_W, axis=0), axis=1).max() < 0.4


@pytest.mark.slow
def test_the_covariance_in_the_map_frame_is_consistent(make_walk, make_oracle):
    position, yaw = [], []
    for seed in range(12):
        walk = make_walk(seed, 22.0, 50.0, ERRORS)
        rng = np.random.default_rng(seed)
        oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.05, sigma=0.05, seed=seed)
        turn = about_z(rng.uniform(-np.pi, np.pi))
        fixes = [
            position_fix(t, turn.apply(truth_at(walk, t)[0]) + rng.normal(0.0, 0.2, 3), 0.04 * EYE)
            for t in (3.0, 18.0)
        ]
        track = Navigator(oracle, CONFIG, backend="ekf").run(walk, fixes=fixes)
        if track.health.fixes != {"applied": 2}:
            continue  # too little motion to determine the yaw
        truth = walk.truth.at(track.time[-1:].clip(0.0, walk.time[-1]))
        off = turn.apply(truth.position_W[0]) - track.trajectory.position_W[-1]
        turned = turn * truth.attitude_WB * track.trajectory.attitude_WB[-1:].inv()
        P = track.covariance[-1]
        position.append(off @ np.linalg.solve(P[6:9, 6:9], off))
        yaw.append(turned.as_rotvec()[0, 2] ** 2 / P[2, 2])
    assert len(position) >= 8
    assert 1.2 < np.mean(position) < 6.0  # expected 3
    assert 0.25 < np.mean(yaw) < 2.5  # expected 1


@pytest.mark.parametrize("kind", ["yaw", "velocity"])
def test_a_heading_or_a_velocity_determines_the_yaw_too(walk, model, kind):
    turn = about_z(2.0)
    fixes = []
    for t in (8.0, 20.0):
        p, v, yaw = truth_at(walk, t)
        fixes += [position_fix(t, turn.apply(p), 0.01 * EYE)]
        if kind == "yaw":
            fixes += [yaw_fix(t, yaw + 2.0 - 2.0 * np.pi, 0.02)]
        else:
            fixes += [velocity_fix(t, turn.apply(v), 1e-4 * EYE)]
    track = Navigator(model, CONFIG, backend="ekf").run(walk, fixes=fixes)
    assert track.health.fixes["applied"] >= 3  # a slow velocity does not determine it
    truth = walk.truth.at(track.time.clip(0.0, walk.time[-1]))
    off = turn.apply(truth.position_W) - track.trajectory.position_W
    assert np.linalg.norm(off, axis=1).max() < 1.0


def test_a_track_with_a_known_start_is_corrected_without_a_frame_change(walk, model):
    first = walk.truth.at(walk.time[:1])
    prior = PriorPose(first.attitude_WB[0].as_matrix(), first.velocity_W[0], first.position_W[0])
    p = truth_at(walk, 25.0)[0]
    truth = walk.truth.position_W[-1]
    for off, sigma, more in ((0.0, 1.0, {}), (3.0, 0.01, {"gated": 1})):
        fix = position_fix(25.0, [*p[:2], p[2] + off], sigma**2 * EYE)
        track = Navigator(model, CONFIG, prior, backend="ekf").run(walk, fixes=[fix])
        assert track.health.fixes == {"applied": 1} | more
        error = track.trajectory.position_W[-1] - truth
        assert np.linalg.norm(error) < 0.5 + 0.8 * off


def test_one_position_leaves_the_direction_in_the_map_unknown(walk, model):
    """However the walk lies in the map, the error is within the sigma; the pivot is sure."""
    fix, walk = position_fix(5.0, truth_at(walk, 5.0)[0], 0.01 * EYE), walk.slice(0.0, 12.0)
    graph = Navigator(model, CONFIG).run(walk, fixes=[fix])
    for backend, track in (("ekf", graph.filtered), ("graph", graph)):
        streamed = Navigator(model, CONFIG, backend=backend)
        apply_fix(streamed, fix)
        end = support.stream(streamed, walk)[-1]
        arm = np.linalg.norm((track.trajectory.position_W - fix.value)[:, :2], axis=1)
        sigma = np.sqrt(track.covariance[:, 6, 6] + track.covariance[:, 7, 7])
        assert (sigma > 0.9 * arm).all()
        assert sigma[np.argmin(arm)] < 0.5
        assert np.sqrt(track.covariance[-1, 2, 2]) == pytest.approx(UNKNOWN_YAW, rel=0.05)
        assert end.map_frame == 1
        np.testing.assert_allclose(np.sqrt(end.covariance[2, 2]), UNKNOWN_YAW, rtol=0.05)
        assert streamed.health.final_sigma["yaw_rad"] > 1.5


@pytest.mark.parametrize(
    ("fix", "reason"),
    [
        (position_fix(5.0, [np.nan, 0, 0], EYE), "value that is not finite"),
        (position_fix(np.nan, [0, 0, 0], EYE), "value that is not finite"),
        (position_fix(5.0, [0, 0, 0], np.nan * EYE), "value that is not finite"),
        (position_fix(5.0, [0, 0, 0], -EYE), "covariance not positive definite"),
        (position_fix(5.0, [0, 0, 0], np.ones((3, 3))), "covariance not positive definite"),
        (position_fix(5.0, [0, 0, 0], np.tri(3)), "covariance not positive definite"),
        (position_fix(5.0, [0, 0, 0], ROOT @ ROOT.T), "covariance not positive definite"),
        (position_fix(5.0, [0, 0, 0], np.diag([1.0, 1.0, 1e300])), "value too large"),
        (position_fix(5.0, [1e20, 0, 0], EYE), "value too large"),
        (yaw_fix(5.0, 0.0, -0.1), "covariance not positive definite"),
        (yaw_fix(5.0, 0.0, 1e200), "value that is not finite"),
        (yaw_fix(5.0, np.inf, 0.1), "value that is not finite"),
        (yaw_fix(5.0, 90.0, 0.1), "yaw not in radians"),
        (yaw_fix(5.0, np.radians(-90.0), 0.1), ""),
    ],
)
def test_an_invalid_fix_has_a_fault(fix, reason):
    assert fix.fault() == reason


def test_the_covariance_of_an_exact_fix_has_a_floor(walk, model):
    fix = position_fix(10.0, truth_at(walk, 10.0)[0], 1e-30 * EYE)
    track = Navigator(model, CONFIG, backend="ekf").run(walk.slice(0.0, 12.0), fixes=[fix])
    assert track.health.fixes == {"applied": 1}
    assert np.isfinite(track.covariance).all()
    assert np.linalg.eigvalsh(track.covariance).min() > -1e-9


@pytest.mark.parametrize("place", [[48.1, 11.5, 12.0], [690_000.0, 5_330_000.0, 500.0]])
def test_metres_are_not_taken_for_degrees(still_model, place):
    assert Navigator(still_model).update_position(0.0, place, EYE) == "waiting"
