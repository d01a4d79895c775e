"""Comparison of a recording with the one that was written, and of its truth with its gyroscope."""

from collections.abc import Collection
from dataclasses import fields, is_dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences import ImuSequence, Trajectory
from stario.sequences.arrays import interpolated
from stario.sequences.sequence import FloatArray


def assert_same(found: object, given: object, atol: float = 0.0, but: Collection[str] = ()) -> None:
    """Assert that two recordings, or parts of them, hold the same `but` for some attributes."""
    assert type(found) is type(given)
    for name in {field.name for field in fields(given)} - {*but}:
        one, other = (getattr(part, name) for part in (found, given))
        assert (one is None) == (other is None), name
        if is_dataclass(other):
            assert_same(one, other, atol)
        elif isinstance(other, Rotation):
            assert max_angle(one, other) < max(atol, 1e-7), name
        elif isinstance(other, np.ndarray):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=atol, err_msg=name)
        else:
            assert one == other, name


def assert_upright(recording: ImuSequence, degrees: float, tolerance: float = 0.3) -> None:
    """Assert that the mean force, rotated by the true attitude, is gravity and points up."""
    truth = recording.truth.at(np.unique(recording.time))
    accel = interpolated(truth.time, recording.time, recording.accel)
    up = truth.attitude_WB[truth.valid].apply(accel[truth.valid]).mean(axis=0)
    assert np.degrees(np.arctan2(np.hypot(*up[:2]), up[2])) < degrees
    assert abs(np.linalg.norm(up) - 9.8) < tolerance


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
    return float((a.inv() * b).magnitude().max())
