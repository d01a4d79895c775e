from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from support import samples, stream

from stario.fusion import (
    FilterConfig,
    Navigator,
    NavigatorConfig,
    PriorPose,
    compare,
    compare_recordings,
    inertial_track,
    network_track,
    position_fix,
    summary_table,
    yaw_fix,
)
from stario.network import load_model
from stario.sequences import InputError, StarioError, read_recording

EYE = np.eye(3)
LEVEL = EYE, np.zeros(3), np.zeros(3)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda model: Navigator(model, config={}), "config"),
        (lambda model: Navigator(model, prior=(1, 2)), "prior"),
        (lambda model: Navigator(model, backend=["ekf"]), "backend"),
        (lambda model: Navigator(model, backend="ukf"), "'ukf', expected one of ekf, graph"),
        (lambda model: Navigator("default"), "model"),
        (lambda model: Navigator(type(model)), "model"),
        (lambda model: Navigator(model, backend="ekf").run("walk.csv"), "sequence"),
        (lambda model: Navigator(model).restore("text"), "snapshot"),
        (lambda model: Navigator(model).update_yaw("x", 0.0, 0.1), "time.*a number"),
        (lambda model: Navigator(model).update_yaw(1.0, [0, 0], 0.1), "yaw.*a number"),
        (lambda model: Navigator(model).update_yaw(1.0, "north", 0.1), "yaw"),
        (lambda model: Navigator(model).update_yaw(np.datetime64("2024"), 0.0, 0.1), "time.*Y"),
        (lambda model: Navigator(model).update_position(0.0, [1.0, 2.0], EYE), "position"),
        (lambda model: Navigator(model).update_position(0.0, [48.1, 11.5, 500.0], EYE), "east"),
        (lambda model: Navigator(model).update_velocity(0.0, [0, 0, 0], [1, 1, 1]), "covariance"),
        (lambda model: position_fix(0.0, [1.0, 2.0, 3.0], [0.1, 0.1, 0.2]), r"np\.diag"),
        (lambda model: Navigator(model).restore(b"xx" + Navigator(model).snapshot()), "else"),
        (lambda model: compare("walk.csv", model, NavigatorConfig()), "sequence.*read_recording"),
        (lambda model: network_track("walk.csv"), "preprocessed.*observe"),
        (lambda model: inertial_track("walk.csv"), "preprocessed.*observe"),
        (lambda model: summary_table(["walk"]), "scores.*concat"),
        (lambda model: next(compare_recordings("walk.csv", model)), "paths.*find_recordings"),
        (lambda model: FilterConfig(gate="0.9"), "gate"),
        (lambda model: FilterConfig(magnetometer="no"), "magnetometer"),
        (lambda model: FilterConfig(update_rate=np.ones(3)), "update_rate"),
        (lambda model: NavigatorConfig(filter={"update_rate": 2}), "filter"),
        (lambda model: NavigatorConfig(noise=(1e-3, 1e-2)), "noise"),
        (lambda model: PriorPose(*LEVEL, yaw_sigma=-0.5), "yaw_sigma"),
        (lambda model: PriorPose(*LEVEL, tilt_sigma="a"), "tilt_sigma"),
        (lambda model: PriorPose(*LEVEL, position_sigma=1e9), "position_sigma"),
        (lambda model: PriorPose(2.0 * np.eye(3), *LEVEL[1:]), "R_WB"),
        (lambda model: PriorPose(LEVEL[0], [0.0, 0.0], LEVEL[2]), "v_W"),
    ],
)
def test_a_wrong_argument_is_named(still_model, make, named):
    with pytest.raises(StarioError, match=named):
        make(still_model)


@pytest.mark.parametrize("wrong", [[(1.0, "position")], ["fix"], yaw_fix(1.0, 0.0, 0.1)])
def test_fixes_of_the_wrong_type_are_refused_with_a_remedy(walk, still_model, wrong):
    for run in (Navigator(still_model).run, partial(compare, still_model)):
        with pytest.raises(InputError, match=r"position_fix|fixes.*list"):
            run(walk, fixes=wrong)


def test_numpy_numbers_are_accepted():
    config = FilterConfig(update_rate=np.float64(10.0), adaptive=np.True_)
    assert config.update_rate == 10
    assert isinstance(config.update_rate, int)
    assert PriorPose(*LEVEL, yaw_sigma=np.array(0.1)).yaw_sigma == 0.1


def test_a_recording_preprocessed_for_another_update_rate_is_refused(walk, still_model):
    fast = Navigator(still_model, NavigatorConfig(filter=FilterConfig(update_rate=10)))
    with pytest.raises(InputError, match="update_rate"):
        Navigator(still_model).track(fast.observe(walk))


def test_a_recording_may_have_more_fixes_than_may_wait_in_a_stream(walk, still_model):
    times = [*np.linspace(1.0, walk.duration - 0.01, 50), *np.linspace(1e3, 2e3, 10_001)]
    fixes = [position_fix(t, np.zeros(3), 1e4 * np.eye(3)) for t in times]
    counts = Navigator(still_model, backend="ekf").run(walk, fixes=fixes).health.fixes
    assert sum(counts.values()) == len(fixes)
    assert "too many waiting" not in counts


def test_fixes_of_a_clock_that_is_ahead_do_not_block_correct_ones(still_model):
    navigator = Navigator(still_model)
    for k in range(10_001):
        navigator.update_position(1e6 + k, np.zeros(3), np.eye(3))
    assert navigator.update_position(5.0, np.zeros(3), np.eye(3)) == "waiting"
    assert navigator.health.fixes == {"too many waiting": 2, "waiting": 10_000}


def test_a_snapshot_with_any_byte_changed_is_refused_or_restored(walk, still_model):
    navigator = Navigator(still_model)
    stream(navigator, walk.select(slice(150)))
    data = navigator.snapshot()
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(data), 60).tolist():
        corrupted = bytearray(data)
        corrupted[place] ^= 0xFF
        with suppress(InputError):  # an invalid snapshot raises nothing else
            Navigator(still_model).restore(bytes(corrupted))


@pytest.mark.parametrize("rate", [20.0, 2000.0])
def test_a_stream_that_is_too_slow_or_too_fast_is_refused(still_model, rate):
    navigator, refused_at = Navigator(still_model), None
    for k in range(round(1.2 * rate)):
        with suppress(InputError):
            navigator.push(k / rate, np.zeros(3), [0.0, 0.0, 9.81])
            continue
        refused_at = k
        break
    assert refused_at is not None
    assert navigator.state is None
    for k in range(300):
        navigator.push(100.0 + k / 100.0, np.zeros(3), [0.0, 0.0, 9.81])
    assert navigator.state is not None


def test_misplaced_arguments_are_named(still_model, make_walk):
    walk = make_walk(1, 3.0)
    with pytest.raises(InputError, match=r"progress.*fixes="):
        Navigator(still_model, backend="ekf").run(walk, [yaw_fix(1.0, 0.0, 0.1)])
    for wrong in (None, 3):
        with pytest.raises(InputError, match="path"):
            read_recording(wrong)
        with pytest.raises(InputError, match="name_or_path"):
            load_model(wrong)


def test_a_prior_attitude_that_gravity_contradicts_is_refused(walk, still_model):
    """As the transposed attitude of a phone that is held upright."""
    on_its_side = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    first = walk.truth.at(walk.time[:1]).attitude_WB[0].as_matrix()
    wrong = Navigator(still_model, prior=PriorPose(on_its_side @ first, *LEVEL[1:]))
    with pytest.raises(InputError, match="prior: R_WB"):
        wrong.run(walk)
    refused_at = []
    for row in samples(walk.select(slice(250))):
        try:
            wrong.push(*row)
        except InputError:
            refused_at.append(row[0])
    np.testing.assert_allclose(refused_at, [1.0, 2.01], atol=0.02)
    assert wrong.state is None
    unknown = PriorPose(on_its_side @ first, *LEVEL[1:], tilt_sigma=1.0)
    assert Navigator(still_model, prior=unknown, backend="ekf").run(walk).health is not None
