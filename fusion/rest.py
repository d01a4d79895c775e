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

from stario.fusion.epochs import Epoch
from stario.fusion.jacobians import Block
from stario.fusion.lie import FloatArray
from stario.sequences.noise import ImuNoise
from stario.sequences.simulate import PHONE_IMU
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
        # Of each epoch: samples, seconds, sums of gyro and accel, sums of their squares.
        self._sums: deque[FloatArray] = deque(maxlen=epochs)

    def at_rest(self, epoch: Epoch) -> bool:
        """Take an epoch in; whether nothing moved over the second that ends with it."""
        if self._scale == 0.0:
            return False
        if epoch.gap:
            self._sums.clear()
            return False
        rows = np.hstack([epoch.gyro[1:], epoch.accel[1:]])
        totals = np.ones(len(rows)) @ rows, np.einsum("ni,ni->i", rows, rows)
        sums = np.concatenate([(len(rows), epoch.stop - epoch.start), *totals])
        self._sums.append(sums)
        if len(self._sums) < (self._sums.maxlen or 0):
            return False
        # Scatter adds up: an epoch with more than a second may have settles it.
        return self._quiet(sums, len(self._sums)) and self._quiet(np.sum(self._sums, axis=0))

    def _quiet(self, sums: FloatArray, share: int = 1) -> bool:
        """Whether a second may scatter like this; `sums` are of one of so many equal shares."""
        count, seconds = float(sums[0]), float(sums[1])
        scatter = sums[8:14] - np.square(sums[2:8]) / count
        freedom = 3.0 * (share * count - 1.0)
        bound = self._scale**2 * count / seconds * _chi2_quantile(freedom)
        gyro, accel = float(scatter[:3].sum()), float(scatter[3:].sum())
        return (
            gyro <= bound * PHONE_IMU.noise.gyro_noise**2
            and accel <= bound * PHONE_IMU.noise.accel_noise**2
        )

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
        table = np.array(self._sums)
        rates = table[:, 2:5] / table[:, :1]
        seconds = float(table[:, 1].mean())
        hidden = max(noise.accel_noise, PHONE_IMU.noise.accel_noise) ** 2 * WINDOW_SECONDS
        white = PHONE_IMU.noise.gyro_noise**2 / seconds
        spread = np.maximum(rates.var(axis=0), white)
        covariance = np.diag([*[epochs * hidden] * 3, *(epochs * spread)])
        residual = np.concatenate([-v_W, rates[epochs // 2] - b_g])
        return residual, [(3, _BY_VELOCITY), (9, _BY_BIAS)], covariance

    def checkpoint(self) -> list[FloatArray]:
        """Everything that `rewind` needs."""
        return list(self._sums)

    def rewind(self, checkpoint: list[FloatArray]) -> None:
        """Go back to a checkpoint."""
        self._sums.clear()
        self._sums.extend(checkpoint)


_BY_VELOCITY = np.eye(6, 3)
_BY_BIAS = np.eye(6, 3, k=-3)


def _chi2_quantile(freedom: float) -> float:
    """Of chi-square at 0.999, by Wilson and Hilferty's cube."""
    spread = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - spread + _QUANTILE * math.sqrt(spread)) ** 3)
