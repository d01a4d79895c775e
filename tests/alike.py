"""Comparison of a recording with the one that was written, and of its truth with its gyroscope."""

import numpy as np

from stario.sequences import ImuSequence, Trajectory
from stario.sequences.arrays import interpolated
from stario.sequences.sequence import FloatArray


def assert_same_samples(read: ImuSequence, walk: ImuSequence) -> None:
    assert len(read) == len(walk)
    np.testing.assert_allclose(read.time, walk.time, atol=1e-3)
    np.testing.assert_allclose(read.gyro, walk.gyro, atol=1e-9)
    np.testing.assert_allclose(read.accel, walk.accel, atol=1e-8)


def turned_and_measured(
    sequence: ImuSequence, truth: Trajectory, stride: int
) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors [rad] of the attitude and of the gyroscope over `stride` poses, in B."""
    steps = 0.5 * np.diff(sequence.time)[:, None] * (sequence.gyro[1:] + sequence.gyro[:-1])
    angle = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    angle = interpolated(truth.time, sequence.time, angle)
    turned = truth.attitude_WB[:-stride].inv() * truth.attitude_WB[stride:]
    return turned.as_rotvec(), angle[stride:] - angle[:-stride]
