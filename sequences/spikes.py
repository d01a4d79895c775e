"""Single samples that no motion explains: a bit lost on the way, a sensor's hiccup."""

from __future__ import annotations

import numpy as np

from stario.sequences.clean_samples import clean_samples
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence

SPIKE = np.array([12.0, 12.0, 12.0, 60.0, 60.0, 60.0])
"""A sample that differs from both neighbours by more than this is a spike [rad/s], [m/s^2]; heel
strikes stay below half of it at 50 Hz."""


def replace_spikes(values: FloatArray, first: bool = True) -> BoolArray:
    """Replace spikes in place by the mean of their neighbours; return where they were (n, 6).

    The samples at both ends, which have one neighbour, are compared with the nearest two.

    Args:
        values: (n, 6) consecutive gyroscope [rad/s] and specific force [m/s^2], at least two.
        first: whether the first sample may be one.
    """
    found = np.zeros(values.shape, dtype=np.bool_)
    n = len(values)
    steps = np.flatnonzero((np.abs(values[1:] - values[:-1]) > SPIKE).any(axis=1))
    for k in np.union1d(steps, steps + 1).tolist():
        if not (k or first):
            continue
        before = values[k - 1] if k else values[min(2, n - 1)]
        after = values[k + 1] if k + 1 < n else values[max(k - 2, 0)]
        found[k] = np.minimum(np.abs(values[k] - before), np.abs(values[k] - after)) > SPIKE
        if found[k].any():
            near = before if k else after
            # A neighbour may be a spike as well.
            agree = (np.abs(after - before) <= SPIKE) & (0 < k < n - 1)
            values[k] = np.where(found[k], np.where(agree, 0.5 * (before + after), near), values[k])
    return found


def spike_free_samples(sequence: ImuSequence) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the samples of `clean_samples` with spikes replaced.

    Raises:
        InputError: as for `clean_samples`.
    """
    time, gyro, accel = clean_samples(sequence)
    values = np.column_stack([gyro, accel])
    if replace_spikes(values).any():
        gyro, accel = values[:, :3].copy(), values[:, 3:].copy()
    return time, gyro, accel
