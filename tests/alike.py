"""Comparison of a recording with the one that was written, and of its truth with its gyroscope."""

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences import ImuSequence, Trajectory
from stario.sequences.arrays import interpolated
from stario.sequences.sequence import FloatArray


def assert_same_samples(read: ImuSequence, walk: ImuSequence) -> None:
    assert len(read) == len(walk)
    np.testing.assert_allclose(read.time, walk.time, atol=1e-3)
    np.testing.assert_allclose(read.gyro, walk.gyro, atol=1e-9)
    np.testing.assert_allclose(read.accel, walk.accel, atol=1e-8)


def assert_same_poses(
    truth: Trajectory, walk: ImuSequence, tolerance_deg: float, tolerance_m: float
) -> None:
    """Assert that the truth is the walk's, except for a turn of the world that levelling allows."""
    given, pose = walk.truth, truth.at(walk.time)
    error = (given.attitude_WB * pose.attitude_WB.inv())[pose.valid]
    world = error.mean()
    assert np.hypot(*world.as_rotvec()[:2]) < np.radians(0.5)
    assert abs(world.as_rotvec()[2]) < np.radians(0.5)
    assert np.degrees((world.inv() * error).magnitude()).max() < tolerance_deg
    distance = np.linalg.norm(world.apply(pose.position_W) - given.position_W, axis=1)
    assert distance[pose.valid].max() < tolerance_m


def turned_and_measured(
    sequence: ImuSequence, truth: Trajectory, stride: int
) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors [rad] of the attitude and of the gyroscope over `stride` poses, in B."""
    steps = 0.5 * np.diff(sequence.time)[:, None] * (sequence.gyro[1:] + sequence.gyro[:-1])
    angle = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    angle = interpolated(truth.time, sequence.time, angle)
    turned = truth.attitude_WB[:-stride].inv() * truth.attitude_WB[stride:]
    return turned.as_rotvec(), angle[stride:] - angle[:-stride]


def max_angle(a: Rotation, b: Rotation) -> float:
    """Return the largest angle [rad] between two stacks of rotations."""
    return float((a.inv() * b).magnitude().max())
