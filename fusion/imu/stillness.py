"""Rest: when little but a sensor's own noise is in the samples, velocity and rate are zero.

Over the last second the scatter of both sensors is held against the white noise of a phone's IMU
(`PHONE_IMU`), which a hand's tremor or a trolley's wheels exceed. The filter's own densities are no
measure here: they stand for errors of scale and alignment, which only motion brings. That an even
glide looks like rest as well is left to the measurement's own chi-square test against the filter's
velocity and bias, by which it is refused and not inflated.

Zero velocity is measured in the estimated axes, so that it says nothing of yaw. The mean rate in
the middle of the second measures the gyroscope's bias; both its halves are at rest, so that a
beginning motion is not taken for bias. What turns too slowly to be told from bias shows in how the
means of the second's parts differ, and their variance is the measurement's, for the whole second.

Source: I. Skog et al., "Zero-velocity detection: an algorithm evaluation", 2010 (the test on both
sensors); the scatter about the mean replaces their known gravity and bias.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stario.fusion.filter.jacobians import Block
from stario.fusion.imu.intervals import Epoch
from stario.fusion.lie import FloatArray
from stario.sequences.noise import ImuNoise
from stario.sequences.simulation.imu import PHONE_IMU
from stario.sequences.windows import WINDOW_SECONDS

_QUANTILE = 3.0902
"""Of the normal distribution at 0.999: how rarely a resting sensor looks as if it moved."""


class RestDetector:
    """Watches the last second of samples.

    Args:
        epochs: in a second.
        scale: factor on the densities of a phone's IMU; 0 never detects.
    """

    def __init__(self, epochs: int, scale: float) -> None:
        self._scale = scale
        # Of each epoch: samples, seconds, sums of gyro and accel, sums of their squares; None where
        # it alone moves more than a second at rest may.
        self._sums: deque[FloatArray | None] = deque(maxlen=epochs)

    def at_rest(self, epoch: Epoch) -> bool:
        """Take an epoch in; whether nothing moved over the second that ends with it."""
        if self._scale == 0.0:
            return False
        if epoch.gap:
            self._sums.clear()
            return False
        self._sums.append(None if self._moves(epoch) else _sums_of(epoch))
        known = [sums for sums in self._sums if sums is not None]
        if len(known) < (self._sums.maxlen or 0):
            return False
        return self._quiet(np.sum(known, axis=0))

    def _moves(self, epoch: Epoch) -> bool:
        """Whether the epoch's force alone scatters more than a second may: scatter adds up."""
        accel = epoch.accel[1:]
        count = len(accel)
        total = accel.sum(axis=0)
        scatter = float(np.vdot(accel, accel) - total @ total / count)
        bound = self._bound(count * (self._sums.maxlen or 1), count / (epoch.stop - epoch.start))
        return scatter > bound * PHONE_IMU.noise.accel_noise**2

    def _quiet(self, sums: FloatArray) -> bool:
        """Whether a second may scatter like this."""
        count = float(sums[0])
        scatter = sums[8:14] - np.square(sums[2:8]) / count
        bound = self._bound(count, count / float(sums[1]))
        gyro, accel = float(scatter[:3].sum()), float(scatter[3:].sum())
        return (
            gyro <= bound * PHONE_IMU.noise.gyro_noise**2
            and accel <= bound * PHONE_IMU.noise.accel_noise**2
        )

    def _bound(self, count: float, rate: float) -> float:
        """Of the scatter of so many samples in three axes, over the density's square."""
        return self._scale**2 * rate * _chi2_quantile(3.0 * (count - 1.0))

    def measurement(
        self, v_W: FloatArray, b_g: FloatArray, noise: ImuNoise
    ) -> tuple[FloatArray, list[Block], FloatArray]:
        """Residual (6,), Jacobian and covariance of zero velocity and zero rate.

        The velocity is as uncertain as what white noise of the accelerometer hides over the second.
        Both are measured once per epoch and count once per second.

        Args:
            v_W: (3,) estimated velocity [m/s].
            b_g: (3,) estimated bias [rad/s].
            noise: densities the filter assumes.
        """
        epochs = len(self._sums)
        table = np.array(list(self._sums))
        rates = table[:, 2:5] / table[:, :1]
        seconds = float(table[:, 1].mean())
        hidden = max(noise.accel_noise, PHONE_IMU.noise.accel_noise) ** 2 * WINDOW_SECONDS
        white = PHONE_IMU.noise.gyro_noise**2 / seconds
        spread = np.maximum(rates.var(axis=0), white)
        covariance = np.diag([*[epochs * hidden] * 3, *(epochs * spread)])
        residual = np.concatenate([-v_W, rates[epochs // 2] - b_g])
        return residual, [(3, _BY_VELOCITY), (9, _BY_BIAS)], covariance

    def checkpoint(self) -> list[FloatArray | None]:
        """Everything that `rewind` needs."""
        return list(self._sums)

    def rewind(self, checkpoint: list[FloatArray | None]) -> None:
        """Go back to a checkpoint."""
        self._sums.clear()
        self._sums.extend(checkpoint)


def _sums_of(epoch: Epoch) -> FloatArray:
    rows = np.hstack([epoch.gyro[1:], epoch.accel[1:]])
    totals = np.ones(len(rows)) @ rows, np.einsum("ni,ni->i", rows, rows)
    return np.concatenate([(len(rows), epoch.stop - epoch.start), *totals])


_BY_VELOCITY = np.eye(6, 3)
_BY_BIAS = np.eye(6, 3, k=-3)


def _chi2_quantile(freedom: float) -> float:
    """Of chi-square at 0.999, by Wilson and Hilferty's cube."""
    spread = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - spread + _QUANTILE * math.sqrt(spread)) ** 3)
