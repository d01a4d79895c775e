"""Detection of a still second, interval by interval (`stario.sequences.inspection.stillness`).

A hand's tremor or a trolley's wheels exceed its bound. A smooth glide looks still as well and is
left to the zero-velocity update's own chi-square test (README.md, "Zero velocity").
"""

from __future__ import annotations

import numpy as np

from stario.fusion.imu.intervals import ImuInterval
from stario.sequences.inspection.stillness import looks_still, scatter_bound
from stario.sequences.sequence import FloatArray


class StillnessDetector:
    """Detects whether the device was still over the last second.

    Args:
        intervals: number of intervals per second.
        scale: factor on the noise densities of a phone's IMU; 0 never detects.

    Attributes:
        window: for each interval of the last second (14,): number of samples, seconds, sums of gyro
            and accel, sums of their squares; None if it moves more than a still second may.
    """

    def __init__(self, intervals: int, scale: float) -> None:
        self._intervals, self._scale = intervals, scale
        self.window: tuple[FloatArray | None, ...] = ()

    def is_still(self, interval: ImuInterval) -> bool:
        """Add an interval; return whether the device was still over the second ending with it."""
        if self._scale == 0.0:
            return False
        if interval.gap:
            self.window = ()
            return False
        sums = None if self._moves(interval) else _sums_of(interval)
        self.window = (*self.window, sums)[-self._intervals :]
        calm = [sums for sums in self.window if sums is not None]
        return len(calm) == self._intervals and self._is_quiet(np.sum(calm, axis=0))

    def mean_rates(self) -> FloatArray:
        """Return the mean rate (n, 3) of each interval of a still second [rad/s]."""
        table = np.array(self.window)
        return np.asarray(table[:, 2:5] / table[:, :1])

    def mean_seconds(self) -> float:
        """Return the mean length of the intervals of a still second [s]."""
        return float(np.array(self.window)[:, 1].mean())

    def _moves(self, interval: ImuInterval) -> bool:
        """Return whether an interval's specific force scatters more than a still second's may."""
        accel = interval.accel[1:]
        count = len(accel)
        total = accel.sum(axis=0)
        scatter = float(np.vdot(accel, accel) - total @ total / count)
        seconds = (interval.stop - interval.start) * self._intervals
        bound = scatter_bound(count * self._intervals, seconds, self._scale)
        return not looks_still(0.0, scatter, bound)

    def _is_quiet(self, sums: FloatArray) -> bool:
        """Return whether a second with these sums scatters no more than a still one may."""
        count = float(sums[0])
        scatter = sums[8:14] - np.square(sums[2:8]) / count
        bound = scatter_bound(count, float(sums[1]), self._scale)
        return looks_still(float(scatter[:3].sum()), float(scatter[3:].sum()), bound)


def _sums_of(interval: ImuInterval) -> FloatArray:
    rows = np.hstack([interval.gyro[1:], interval.accel[1:]])
    totals = np.ones(len(rows)) @ rows, np.einsum("ni,ni->i", rows, rows)
    return np.concatenate([(len(rows), interval.stop - interval.start), *totals])
