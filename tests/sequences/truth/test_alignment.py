from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walked import walked

from stario.sequences import InputError
from stario.sequences.arrays import samples_in
from stario.sequences.attitude.alignment import align_tracked_body, clock_offset
from stario.sequences.attitude.mounts import heading_turn
from stario.sequences.attitude.rotations import cumulative_rotations
from stario.sequences.conventions import axes_matrix
from stario.sequences.readers.poses import accel_axes
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU

MOUNT_VB = Rotation.from_euler("zyx", [172.0, 3.0, -4.0], degrees=True)
LEVER_B = np.array([0.02, -0.1, 0.01])


def recorded(carry: str, seconds: float = 120.0) -> tuple[ImuSequence, Trajectory]:
    imu = walked(3, seconds, carry=carry, preferred_speed=0.8, mount_rotvec=(0.0, 0.0, 0.0))
    return imu, imu.truth


def captured(truth: Trajectory, noise_rad: float, seed: int = 0) -> tuple[np.ndarray, Rotation]:
    """Position of a point away from the IMU and noisy attitude of the tracked body."""
    rng = np.random.default_rng(seed)
    shaken = Rotation.from_rotvec(noise_rad * rng.standard_normal((len(truth), 3)))
    position = truth.position_W - truth.attitude_WB.apply(LEVER_B)
    position = position + 1e-4 * rng.standard_normal(position.shape)
    return position, truth.attitude_WB * MOUNT_VB.inv() * shaken


def test_cumulative_rotations_are_products_and_a_short_span_is_one_step():
    steps = Rotation.random(200, rng=np.random.default_rng(1))
    one_by_one = [Rotation.identity()]
    for step in steps:
        one_by_one.append(one_by_one[-1] * step)
    products = Rotation.from_quat(cumulative_rotations(steps))
    assert len(products) == 201
    assert (products.inv() * Rotation.concatenate(one_by_one)).magnitude().max() < 1e-9
    assert len(cumulative_rotations(Rotation.identity(1)[:0])) == 1
    assert samples_in(0.03, np.arange(10) / 10.0) == 1


@pytest.mark.parametrize("ahead", [0.4, -1.65, 3000.0])
def test_the_clock_offset_is_found(ahead):
    """Clocks seconds apart or of another origin; the capture starts later and ends earlier."""
    imu, truth = recorded("handheld", 60.0)
    _, attitude_WV = captured(truth, 0.003)
    part = slice(800, 5000)
    valid = np.ones(4200, dtype=np.bool_)
    valid[1000:1100] = False
    offset = clock_offset(imu.time, imu.gyro, truth.time[part] + ahead, attitude_WV[part], valid)
    assert offset == pytest.approx(-ahead, abs=0.05)


def aligned(imu, time, attitude_WV, position=None, valid=None):
    valid = np.ones(len(time), dtype=np.bool_) if valid is None else valid
    return align_tracked_body(imu.time, imu.gyro, imu.accel, time, attitude_WV, valid, position)


def mount_errors(carry: str, noise_rad: float) -> list[float]:
    """Errors [deg] of the mount estimated from the gyroscope alone and from both sensors."""
    imu, truth = recorded(carry)
    position, attitude_WV = captured(truth, noise_rad)
    found = [aligned(imu, truth.time, attitude_WV, known) for known in (None, position)]
    return [float(np.degrees((MOUNT_VB.inv() * x.mounts[0][2]).magnitude())) for x in found]


def test_on_a_trolley_the_accelerometer_determines_the_mounts_heading():
    """The gyroscope alone hardly determines a rotation about the only axis the body turns about."""
    gyro_alone, both = mount_errors("trolley", 0.008)
    assert gyro_alone > 3.0
    assert both < 1.0  # the sensors' axes are 0.6 degrees apart themselves
    assert max(mount_errors("handheld", 0.004)) < 0.7


@pytest.mark.parametrize("late", [-0.031, 0.0, 0.052])
def test_the_lag_is_found_to_about_a_millisecond_even_with_little_rotation(late):
    imu, truth = recorded("trolley")
    position, attitude_WV = captured(truth, 0.004)
    found = aligned(imu, truth.time - late, attitude_WV, position)
    assert found.lag == pytest.approx(late, abs=0.0011)
    assert found.correlation > 0.9


def test_a_capture_that_wrote_no_rows_for_a_while_keeps_its_mount():
    imu, truth = recorded("handheld", 60.0)
    _, attitude_WV = captured(truth, 0.004)
    kept = (truth.time < 25.0) | (truth.time > 27.0)
    found = aligned(imu, truth.time[kept], attitude_WV[kept])
    assert len(found.mounts) == 1
    assert np.degrees((MOUNT_VB.inv() * found.mounts[0][2]).magnitude()) < 1.0


@pytest.mark.parametrize("error_deg", [-6.0, 4.0])
def test_a_turned_mount_is_detected_despite_lever_arm_and_bias_unless_data_are_too_few(error_deg):
    imu, truth = recorded("trolley")
    position, _ = captured(truth, 0.0)
    up_B = truth.attitude_WB.apply([0.0, 0.0, 1.0], inverse=True).mean(axis=0)
    wrong = Rotation.from_rotvec(np.radians(error_deg) * up_B / np.linalg.norm(up_B))
    noise = 0.02 * np.random.default_rng(2).standard_normal((len(truth), 3))
    shaken = truth.attitude_WB * wrong * Rotation.from_rotvec(noise)
    valid = np.ones(len(truth), dtype=np.bool_)
    force = imu.accel + np.array([0.05, -0.08, 0.1])
    turn = heading_turn(truth.time, imu.gyro, force, position, shaken, valid)
    assert np.degrees((wrong * turn).magnitude()) < 1.0
    imu, truth = recorded("trolley", 10.0)
    valid = np.zeros(len(truth), dtype=np.bool_)
    valid[::2] = True  # no stretch is unbroken
    turn = heading_turn(truth.time, imu.gyro, imu.accel, truth.position_W, truth.attitude_WB, valid)
    assert turn.magnitude() == 0.0


def test_single_frames_rotated_about_any_axis_are_masked():
    imu, truth = recorded("handheld")
    _, attitude_WV = captured(truth, 0.004)
    rng = np.random.default_rng(2)
    struck = np.arange(500, len(truth) - 500, 400)
    axes = rng.standard_normal((len(struck), 3))
    turns = np.deg2rad(15.0) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    quat = attitude_WV.as_quat()
    quat[struck] = (attitude_WV[struck] * Rotation.from_rotvec(turns)).as_quat()
    found = aligned(imu, truth.time, Rotation.from_quat(quat))
    assert not found.valid[struck].any()
    assert found.valid.mean() > 0.99


@pytest.mark.parametrize(
    ("gap", "flips"), [((62.0, 65.0), False), ((50.0, 61.0), True), ((113.0, 115.0), True)]
)
def test_rotation_during_an_imu_gap_is_not_a_flip(gap, flips):
    """The gap leaves the mount unchanged; a flip that the IMU observes changes it."""
    imu, truth = recorded("handheld")
    _, attitude_WV = captured(truth, 0.004)
    late = truth.time > 30.0
    if flips:
        quat = attitude_WV.as_quat()
        quat[late] = (attitude_WV[late] * Rotation.from_rotvec([0.0, 0.0, np.pi])).as_quat()
        attitude_WV = Rotation.from_quat(quat)
    kept = (imu.time < gap[0]) | (imu.time > gap[1])
    seen = (truth.time < gap[0]) | (truth.time > gap[1])
    found = aligned(imu.select(kept), truth.time, attitude_WV, valid=seen)
    assert len(found.mounts) == 2 + flips
    error = (truth.attitude_WB.inv() * found.attitude_WB)[seen].magnitude()
    assert np.degrees(np.median(error[truth.time[seen] > gap[1]])) < 1.5
    assert np.degrees(np.median(error[truth.time[seen] < gap[0]])) < 1.5
    assert found.correlation > 0.95


def test_what_cannot_be_aligned_is_refused():
    """Hardly too short, without gravity, or with a clock whose span would not fit in memory."""
    imu, truth = recorded("handheld", 12.0)
    attitude, valid = truth.attitude_WB, np.ones(len(truth), dtype=np.bool_)
    dead = replace(imu, accel=np.zeros_like(imu.accel))
    with pytest.raises(InputError, match=r"found 9\.99 s, expected at least 10 s"):
        aligned(imu.slice(0.0, 9.995), truth.time, attitude)
    with pytest.raises(InputError, match="gravity"):
        aligned(dead, truth.time, attitude)
    with pytest.raises(InputError, match="clock"):
        clock_offset(imu.time, imu.gyro, np.append(0.0, truth.time[1:] + 1.7e9), attitude, valid)


@pytest.fixture(scope="module")
def walk():
    return walked(2, 20.0, PERFECT_IMU, mount_rotvec=(0.3, -0.2, 0.9))


@pytest.mark.parametrize("axes", ["z,x,y", "x,-z,y", "-z,-y,-x"])
def test_another_order_of_the_axes_is_undone(walk, axes, caplog):
    logged = replace(walk, accel=walk.accel @ axes_matrix(axes).T)
    np.testing.assert_allclose(accel_axes(logged, walk.truth).accel, walk.accel, atol=1e-9)
    assert "axes are not the gyroscope's" in caplog.text


def test_axes_are_kept_with_either_sign_and_where_a_device_at_rest_cannot_tell(walk):
    for sign in (1.0, -1.0):
        signed = replace(walk, accel=sign * walk.accel)
        assert accel_axes(signed, walk.truth) is signed
    time = np.arange(500) / 100.0
    truth = Trajectory(time, np.zeros((500, 3)), Rotation.identity(500))
    sideways = np.tile([STANDARD_GRAVITY, 0.0, 0.0], (500, 1))
    still = ImuSequence("still", time, np.zeros((500, 3)), sideways)
    assert accel_axes(still, truth) is still
