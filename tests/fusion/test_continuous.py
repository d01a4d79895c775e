"""The continuous position never steps, and converges to the corrected one."""

from dataclasses import replace

import numpy as np
from support import CONFIG

from stario.fusion import Navigator, NavState
from stario.fusion.values.state import MAX_STEP, advanced


def state_at(time: float, x: float, map_frame: int = 0) -> NavState:
    zero, v_W = np.zeros(3), np.array([1.0, 0.0, 0.0])
    p_W = np.array([time + x, 0.0, 0.0])
    return NavState(time, np.eye(3), v_W, p_W, zero, zero, np.eye(15), False, map_frame)


def test_a_step_is_bled_in_a_centimetre_at_a_time():
    pose = advanced(None, state_at(0.0, 0.0))
    remaining = []
    for k in range(1, 101):
        before, pose = pose, advanced(pose, state_at(0.1 * k, 0.5))
        assert abs(pose.p_W[0] - before.p_W[0] - 0.1) < MAX_STEP + 1e-12
        np.testing.assert_allclose(pose.p_W + pose.correction_W, state_at(0.1 * k, 0.5).p_W)
        remaining.append(pose.correction_W[0])
    assert (np.diff(remaining) < 0.0).all()
    assert remaining[-1] < 0.01


def test_the_continuous_position_is_reset_where_fixes_move_the_frame():
    pose = advanced(advanced(None, state_at(0.0, 0.0)), state_at(0.1, 100.0, map_frame=1))
    np.testing.assert_array_equal(pose.correction_W, np.zeros(3))


def test_corrections_cause_no_step_in_the_position(walk, make_oracle):
    """Noise of a quarter of a metre makes the corrected position step, not the continuous one."""
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG, noise=0.25, sigma=0.25), CONFIG)
    poses = []
    for row in zip(walk.time, walk.gyro, walk.accel, strict=True):
        if navigator.push(*row) is not None:
            assert navigator.continuous is not None
            poses.append(navigator.continuous)
    p, v, t = (np.array([getattr(q, name) for q in poses]) for name in ("p_W", "v_W", "time"))
    moved = np.diff(p, axis=0) - 0.5 * np.diff(t)[:, None] * (v[1:] + v[:-1])
    assert np.linalg.norm(moved, axis=1).max() < MAX_STEP + 1e-9
    corrected = p + np.array([q.correction_W for q in poses])
    stepped = np.diff(corrected, axis=0) - 0.5 * np.diff(t)[:, None] * (v[1:] + v[:-1])
    assert np.linalg.norm(stepped, axis=1).max() > 2.0 * MAX_STEP
    assert np.linalg.norm(poses[-1].correction_W) < 0.5


def test_a_late_fix_that_moves_the_map_moves_the_continuous_position_at_once(walk, make_oracle):
    walk = walk.slice(0.0, 5.99)
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG), CONFIG)
    for row in zip(walk.time, walk.gyro, walk.accel, strict=True):
        navigator.push(*row)
    navigator.update_position(walk.time[590], [1e5, 5e6, 0.0], np.eye(3))
    assert navigator.continuous.map_frame == navigator.state.map_frame == 1
    np.testing.assert_allclose(navigator.continuous.p_W, navigator.state.p_W)


def test_returned_arrays_may_be_overwritten(walk, make_oracle):
    walk, ends = walk.slice(0.0, 5.0), []
    for overwrite in (False, True):
        navigator = Navigator(make_oracle(walk, walk.truth, CONFIG), CONFIG)
        for row in zip(walk.time, walk.gyro, walk.accel, strict=True):
            state = navigator.push(*row)
            if state is not None and overwrite:
                assert navigator.continuous is not None
                for returned in (state, navigator.continuous, navigator.state):
                    for value in vars(returned).values():
                        if isinstance(value, np.ndarray):
                            value *= 57.3
        ends.append((navigator.state.p_W, navigator.state.b_g, navigator.continuous.p_W))
    for clean, written in zip(*ends, strict=True):
        np.testing.assert_array_equal(clean, written)


def test_the_continuous_position_is_reset_at_the_end_of_a_gap():
    before = advanced(None, state_at(0.0, 0.0))
    after = replace(state_at(3.0, 5.0), in_gap=True)
    np.testing.assert_array_equal(advanced(before, after).p_W, after.p_W)
