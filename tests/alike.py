"""Comparison of a recording as read with the one that was written."""

import numpy as np

from stario.sequences import ImuSequence


def assert_same_samples(read: ImuSequence, walk: ImuSequence) -> None:
    assert len(read) == len(walk)
    np.testing.assert_allclose(read.time, walk.time, atol=1e-3)
    np.testing.assert_allclose(read.gyro, walk.gyro, atol=1e-9)
    np.testing.assert_allclose(read.accel, walk.accel, atol=1e-8)
