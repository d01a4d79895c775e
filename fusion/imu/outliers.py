"""Finite samples that cannot be right: single spikes, and a sensor at its limit.

A spike is one sample that differs from both its neighbours by more than a carried device can cause;
it is replaced by their mean. Saturation shows as values of a moving axis that repeat exactly and
more than once at the largest magnitude measured so far; two that are equal by chance, at a
magnitude soon exceeded, do not count. What the sensor missed is unknown, so these are only flagged.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stario.sequences.sequence import BoolArray, FloatArray

SPIKE = np.array([12.0, 12.0, 12.0, 60.0, 60.0, 60.0])
"""A sample that differs from both neighbours by more than this is a spike [rad/s], [m/s^2]; heel
strikes stay below half of it at 50 Hz."""

_MOVING_RANGE = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])
_LARGE_VALUE = np.array([3.0, 3.0, 3.0, 15.0, 15.0, 15.0])
"""An axis within this range and size [rad/s], [m/s^2] may repeat itself: coarse digits at rest."""


class Flags(NamedTuple):
    """Faults in a stretch of samples.

    Attributes:
        gyro: whether a sample of the gyroscope is saturated or was a spike.
        accel: the same for the accelerometer.
        spikes: number of samples replaced.
        saturated: number of samples at the limit.
        missing: whether samples are missing and were interpolated from those around them.
    """

    gyro: bool = False
    accel: bool = False
    spikes: int = 0
    saturated: int = 0
    missing: bool = False


class OutlierDetector:
    """Detects outliers in the samples of one stream, interval by interval."""

    def __init__(self) -> None:
        self.largest = np.zeros(6)
        self._repeats = np.zeros(6)  # of each axis at its current largest magnitude

    def detect(self, table: FloatArray) -> Flags:
        """Replace spikes in place and return the faults.

        Args:
            table: (n, 7) samples: time, gyroscope, accelerometer; the first was checked before.
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
        """Replace spikes by the mean of their neighbours; return their number per axis (6,)."""
        found = np.zeros(6)
        n = len(values)
        for k in range(1, n):
            before = values[k - 1]
            # The last sample has no successor yet: it is compared with the two before it.
            after = values[k + 1] if k + 1 < n else values[max(k - 2, 0)]
            off = np.minimum(np.abs(values[k] - before), np.abs(values[k] - after)) > SPIKE
            if off.any():
                mean = 0.5 * (before + after) if k + 1 < n else before
                values[k, off] = mean[off]
                found += off
        return found

    def _count_saturated(self, values: FloatArray) -> FloatArray:
        """Return the number of samples per axis (6,) that repeat at the axis's limit."""
        size = np.abs(values)
        moving = (np.ptp(values, axis=0) > _MOVING_RANGE) | (self.largest > _LARGE_VALUE)
        repeated: BoolArray = (values[1:] == values[:-1]) & (size[1:] >= self.largest) & moving
        count = repeated.sum(axis=0)
        self._repeats = self._repeats + count
        return np.asarray(np.where(self._repeats >= _MIN_REPEATS, count, 0.0))


_MIN_REPEATS = 2.0
"""Minimum number of repetitions at the same limit that cannot be chance."""

NO_FLAGS = Flags()
"""No faults."""

_NO_AXES = np.zeros(6)
