from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from told import told
from walked import walked

from stario.sequences import PHONE_IMU, InputError, inspect_recording, simulate_imu
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.carrying import CARRYING_MODES
from stario.sequences.truth.positions import fit_positions
from stario.sequences.truth.problems import (
    check_truth,
    examine_truth,
    tracked_truth,
    truth_findings,
)

LATE_S = 20.0


@pytest.fixture(scope="module")
def walk():
    """A walk whose truth is noisy and slow, as a phone's visual odometry."""
    walk = walked(8, 40.0, imu_seed=2, name="w", mount_rotvec=(0.0, 0.0, 0.0))
    truth = walk.truth.at(np.arange(0.0, 40.0, 0.05))
    noise = 0.005 * np.random.default_rng(0).normal(size=(len(truth), 3))
    return replace(walk, truth=replace(truth, position_W=truth.position_W + noise))


def moved(walk: ImuSequence, change: Callable[[Trajectory], FloatArray]) -> ImuSequence:
    truth = walk.truth
    return replace(walk, truth=replace(truth, position_W=change(truth)))


def jumping(truth: Trajectory) -> FloatArray:
    return truth.position_W + np.outer(truth.time > LATE_S, [5.0, 0.0, 0.0])


POSITIONS = {
    "in mm": (lambda t: 1000.0 * t.position_W, "divide them by 1000"),
    "in cm": (lambda t: 100.0 * t.position_W, "divide them by 100 "),
    "in km": (lambda t: 0.001 * t.position_W, "divide them by 0.001"),
    "in feet": (lambda t: t.position_W / 0.3048, "divide them by 3.281"),
    "positions mirrored": (lambda t: t.position_W * [-1, 1, 1], "write -px,py,pz as"),
    "mirrored relative": (lambda t: t.position_W[:, [1, 0, 2]], "write py,px,pz as"),
    "turned by 9": (lambda t: t.position_W[:, [0, 2, 1]] * [1, 1, -1], "write px,-pz,py as"),
    "turned by 6": (
        lambda t: Rotation.from_euler("z", np.pi / 3).apply(t.position_W),
        "give both in the same world",
    ),
    "jumps by 5 m at 20.05 s": (jumping, "split the recording"),
    "repeats exactly for": (lambda t: 0.0 * t.position_W, "leave the truth's cells blank"),
    "do not move as the accelerometer": (lambda t: t.position_W[::-1], "of another recording"),
}


@pytest.mark.parametrize("found", POSITIONS)
def test_wrong_positions_are_named_with_the_remedy(walk, found):
    change, fix = POSITIONS[found]
    wrong = moved(walk, change)
    (problem,) = told(wrong)
    assert problem.startswith("truth: ")
    assert found in problem
    assert fix in problem
    with pytest.raises(
        InputError, match=r"w: truth: found a? ?position.*expected poses that agree"
    ):
        check_truth(wrong)


@pytest.mark.parametrize("carry", CARRYING_MODES)
def test_right_positions_raise_nothing_however_the_device_is_carried(carry):
    walk = walked(3, 40.0, imu_seed=3, carry=carry)
    kept = (walk.time % 12.0) > 0.5  # the mount needs 10 s without a gap
    gappy = walk.select(kept)
    slow = replace(walk, truth=walk.truth.at(np.arange(0.0, 40.0, 0.1)))
    for recording in (walk, gappy, slow) if carry == "pocket" else (walk,):
        assert truth_findings(recording) == []
        found = examine_truth(recording)
        assert found.positions.scale == pytest.approx(1.0, abs=0.2)
        assert not found.positions.mirrored


def test_positions_of_a_device_that_hardly_accelerates_are_not_compared():
    time = np.arange(0.0, 40.0, 0.01)
    attitude_WB = Rotation.from_euler("xyz", np.column_stack([np.sin(time), np.cos(time), time]))
    steady = Trajectory(time, np.outer(time, [0.3, 0.0, 0.0]), attitude_WB)
    rolling = simulate_imu(steady, 100.0, PHONE_IMU, 1)
    mirrored = moved(rolling, lambda truth: -truth.position_W)
    assert examine_truth(mirrored).positions is None
    assert any("positions not compared" in line for line in inspect_recording(mirrored).lines())
    assert truth_findings(mirrored) == []


def test_zeros_of_lost_tracking_are_no_wrong_clock_and_a_jump_is_no_error_of_the_gyroscope(walk):
    truth = walk.truth
    lost = (truth.time > 15.0) & (truth.time < 23.0)
    quat_xyzw = np.where(lost[:, None], [0.0, 0.0, 0.0, 1.0], truth.quat_xyzw)
    position_W = np.where(lost[:, None], 0.0, truth.position_W)
    zeros = replace(truth, position_W=position_W, attitude_WB=Rotation.from_quat(quat_xyzw))
    (problem,) = told(replace(walk, truth=zeros))
    assert "repeats exactly for 7.9 s" in problem
    truth = walk.truth
    turn = Rotation.from_euler("z", np.where(truth.time > LATE_S, 3.0, 0.0)[:, None])
    flipped = replace(walk, truth=replace(truth, attitude_WB=turn * truth.attitude_WB))
    (problem,) = told(flipped)
    assert "an attitude that jumps once" in problem
    with pytest.raises(InputError, match="jumps once"):
        check_truth(flipped)


@pytest.mark.parametrize(
    ("late", "named"),
    [(-0.25, "add +0.249 s"), (5.08, "add -5.08 s"), (1e6, "none of them at a sample's time")],
)
def test_a_truth_on_a_distant_clock_is_named(walk, late, named):
    shifted = replace(walk, truth=replace(walk.truth, time=walk.truth.time + late))
    (problem,) = told(shifted)
    assert named in problem
    with pytest.raises(InputError, match="expected poses that agree with the IMU"):
        check_truth(shifted)


def test_the_comparison_is_part_of_the_findings(walk):
    found = inspect_recording(walk)
    values = found.as_dict()["positions_against_accelerometer"]
    assert values["axes"] == ["x", "y", "z"]
    assert values["correlation"] > 0.8
    assert any("positions scaled by 1" in line for line in found.lines())


@pytest.mark.parametrize("of", ["imu", "truth"])
def test_positions_are_not_compared_across_gaps(of):
    # Level: the bias of an upright phone's accelerometer turns with the walk.
    walk = walked(3, 60.0, imu_seed=1, mount_rotvec=(0.0, 0.0, 0.0))
    known = walk.time % 3.0 > 0.5
    position = walk.truth.position_W + np.cumsum(~known)[:, None] * [0.01, 0.0, 0.0]  # relocalised
    lost = replace(walk.truth, position_W=position, valid=known)
    gappy = walk.select(known) if of == "imu" else replace(walk, truth=lost)
    fit = fit_positions(gappy, 0.0)
    assert fit.correlation > 0.99


def test_neither_a_shift_while_tracking_is_lost_nor_a_short_truth_is_a_problem(walk):
    lost = replace(walk.truth, position_W=jumping(walk.truth))
    assert [found.code for found in truth_findings(replace(walk, truth=lost))] == ["truth_jumps"]
    blank = replace(lost, valid=np.abs(lost.time - LATE_S - 0.05) > 0.08)
    assert tracked_truth(replace(walk, truth=blank))[1] == []
    assert examine_truth(replace(walk, truth=walk.truth.slice(10.0, 18.0))).findings == ()


def test_only_poses_whose_attitude_repeats_as_well_are_lost(walk):
    still = moved(walk, lambda truth: 0.0 * truth.position_W)
    kept, _ = tracked_truth(still)
    assert kept.valid.sum() == len(kept) - 1  # but the first, which the others repeat
    frozen = replace(still.truth, attitude_WB=Rotation.identity(len(still.truth)))
    assert not tracked_truth(replace(still, truth=frozen))[0].valid.any()


def test_a_wrong_unit_of_the_accelerometer_is_not_blamed_on_the_positions(walk):
    in_mg = replace(walk, accel=1e3 * walk.accel / STANDARD_GRAVITY)
    (problem,) = examine_truth(in_mg).findings
    assert problem.text.startswith("truth: positions that")
    assert examine_truth(in_mg, "if it is in mg, ...").findings == ()


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_the_truth_of_a_device_at_rest_is_not_called_wrong(noise):
    """No rotation is there to be compared: neither of them turns."""
    rng, time = np.random.default_rng(0), np.arange(0.0, 40.0, 0.01)
    gyro = [0.0, 0.0, 0.005] + 2e-3 * rng.normal(size=(len(time), 3))
    accel = [0.0, 0.0, STANDARD_GRAVITY] + 0.02 * rng.normal(size=(len(time), 3))
    attitude_WB = Rotation.from_rotvec(noise * rng.normal(size=(len(time), 3)))
    truth = Trajectory(time, 1e-4 * rng.normal(size=(len(time), 3)), attitude_WB)
    resting = ImuSequence("rest", time, gyro, accel, truth=truth)
    assert truth_findings(resting) == []
    check_truth(resting)
    shaken = replace(resting, gyro=gyro + np.outer(np.sin(7.0 * time), [0.5, 0.0, 0.0]))
    assert any(problem.code == "truth_disagrees" for problem in truth_findings(shaken))
