"""Attitude integrated from the gyroscope alone."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import integral, interpolated
from stario.sequences.attitude.rotations import integrated_gyro
from stario.sequences.sequence import FloatArray

_MAX_GYRO_GAP_S = 0.5


class GyroIntegral:
    """Attitude integrated from the gyroscope, at any time, and the rate's running integral."""

    def __init__(self, time: FloatArray, gyro: FloatArray) -> None:
        self.time = time
        self.angle = integral(time, gyro)
        self._attitude = integrated_gyro(time, gyro)
        self._rate = gyro

    def attitude(self, time: FloatArray) -> Rotation:
        """Return attitudes of B relative to its start at times in the recording (else clamped)."""
        clipped = np.clip(time, self.time[0], self.time[-1])
        left = np.clip(np.searchsorted(self.time, clipped, side="right") - 1, 0, len(self.time) - 2)
        tau = clipped - self.time[left]
        return self._attitude[left] * Rotation.from_rotvec(self._rate[left] * tau[:, None])

    def has_long_gap(self, start: float, stop: float) -> bool:
        """Return whether the samples between two times have a gap too long to integrate across."""
        first, last = np.searchsorted(self.time, [start, stop])
        inside = self.time[max(first - 1, 0) : last + 1]
        return bool(np.diff(inside).max(initial=0.0) > _MAX_GYRO_GAP_S)

    def mean_rate(self, time: FloatArray, stride: int) -> FloatArray:
        """Return mean rates (M - stride, 3) [rad/s] from each time to the one `stride` later."""
        angle = interpolated(time, self.time, self.angle)
        lengths = time[stride:] - time[:-stride]
        return np.asarray((angle[stride:] - angle[:-stride]) / lengths[:, None], dtype=np.float64)
