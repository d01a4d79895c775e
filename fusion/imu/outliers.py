"""Samples that cannot be right though they are finite: single spikes, and a sensor at its limit.

A spike is one sample that stands off both its neighbours by more than a carried device can; it is
replaced by their mean. Saturation shows in values that repeat exactly at the largest size the axis
ever had, while it moves, again and again: two alike by chance, at a size that is soon surpassed,
are none. What the sensor missed nobody knows, so such samples are only flagged.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stario.sequences.sequence import BoolArray, FloatArray

SPIKE = np.array([12.0, 12.0, 12.0, 60.0, 60.0, 60.0])
"""Off both neighbours by more than this, a sample is a spike [rad/s], [m/s^2]: heel strikes stay
below half of it at 50 Hz."""

_MOVING_RANGE = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])
_LARGE_VALUE = np.array([3.0, 3.0, 3.0, 15.0, 15.0, 15.0])
"""An axis that varies, or reads, no more than this may repeat itself: coarse digits at rest."""


class Flags(NamedTuple):
    """What is wrong with a stretch of samples.

    Attributes:
        gyro: whether a sample of the gyroscope is saturated or was a spike.
        accel: likewise of the accelerometer.
        spikes: number of samples replaced.
        saturated: number of samples at the limit.
        missing: whether samples are missing, and those around were taken for them.
    """

    gyro: bool = False
    accel: bool = False
    spikes: int = 0
    saturated: int = 0
    missing: bool = False


class OutlierDetector:
    """Looks through the samples of one stream, interval by interval."""

    def __init__(self) -> None:
        self.largest = np.zeros(6)
        self._repeats = np.zeros(6)  # of each axis at the size that is its largest now

    def detect(self, table: FloatArray) -> Flags:
        """Mend spikes in place and say what is wrong.

        Args:
            table: (n, 7) samples: time, gyroscope, accelerometer; the first was looked at before.
        """
        values = table[:, 1:]
        steps = values[1:] - values[:-1]
        candidates = np.abs(steps).max(axis=0) > SPIKE
        spikes = self._replace_spikes(values) if candidates.any() else _NO_AXES
        largest = np.maximum(self.largest, np.abs(values).max(axis=0))
        self._repeats = np.where(largest > self.largest, 0.0, self._repeats)
        self.largest = largest
        saturated = _NO_AXES
        if not steps.all():
            saturated = self._count_saturated(values)
        bad = (spikes + saturated) > 0
        if not bad.any():
            return NO_FLAGS
        return Flags(
            bool(bad[:3].any()), bool(bad[3:].any()), int(spikes.max()), int(saturated.max())
        )

    @staticmethod
    def _replace_spikes(values: FloatArray) -> FloatArray:
        """Number of spikes per axis (6,), replaced by the mean of their neighbours."""
        found = np.zeros(6)
        n = len(values)
        for k in range(1, n):
            before = values[k - 1]
            # The last sample has no neighbour behind it yet: it is held against the two before.
            after = values[k + 1] if k + 1 < n else values[max(k - 2, 0)]
            off = np.minimum(np.abs(values[k] - before), np.abs(values[k] - after)) > SPIKE
            if off.any():
                mean = 0.5 * (before + after) if k + 1 < n else before
                values[k, off] = mean[off]
                found += off
        return found

    def _count_saturated(self, values: FloatArray) -> FloatArray:
        """Number of samples per axis (6,) that repeat at the axis's limit."""
        size = np.abs(values)
        moving = (np.ptp(values, axis=0) > _MOVING_RANGE) | (self.largest > _LARGE_VALUE)
        repeated: BoolArray = (values[1:] == values[:-1]) & (size[1:] >= self.largest) & moving
        count = repeated.sum(axis=0)
        self._repeats = self._repeats + count
        return np.asarray(np.where(self._repeats >= _MIN_REPEATS, count, 0.0))


_MIN_REPEATS = 2.0
"""Repetitions at one and the same limit from which on they are none by chance."""

NO_FLAGS = Flags()
"""Nothing is wrong."""

_NO_AXES = np.zeros(6)
