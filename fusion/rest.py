"""Rest: when nothing but the sensor's own noise is in the samples, velocity and rate are zero.

Over the last second the scatter of both sensors is held against the white noise of a consumer
sensor (`ImuNoise()`); a hand's tremor or a trolley's wheels exceed it. The filter's own densities
are no measure here: they stand for errors of scale and alignment, which only motion brings. That
an even glide looks like rest as well is left to the measurement's own chi-square test against the
filter's velocity, by which it is refused and not inflated.

Zero velocity is measured in the estimated axes, so that it says nothing of yaw. Zero rate is the
mean rate of the samples, and measures the gyroscope's bias.

Source: I. Skog et al., "Zero-velocity detection: an algorithm evaluation", 2010 (the test on both
sensors); the scatter about the mean replaces their known gravity and bias.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stario.fusion.intake import Epoch
from stario.fusion.jacobians import Block
from stario.fusion.lie import FloatArray
from stario.sequences.noise import ImuNoise
from stario.sequences.windows import WINDOW_SECONDS

CONSUMER_SENSOR = ImuNoise()
"""Densities of a consumer sensor that lies still."""

_QUANTILE = 3.0902
"""Of the normal distribution at 0.999: how rarely a resting sensor looks as if it moved."""


class RestDetector:
    """Watches the last second of samples.

    Args:
        epochs: in a second.
        scale: factor on the densities of a consumer sensor; 0 never detects.
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
        head = (len(rows), epoch.stop - epoch.start)
        self._sums.append(np.concatenate([head, rows.sum(axis=0), np.square(rows).sum(axis=0)]))
        return len(self._sums) == self._sums.maxlen and self._quiet()

    def _quiet(self) -> bool:
        sums = np.sum(self._sums, axis=0)
        count, seconds = float(sums[0]), float(sums[1])
        scatter = sums[8:14] - np.square(sums[2:8]) / count
        freedom = 3.0 * (count - 1.0)
        bound = self._scale**2 * count / seconds * _chi2_quantile(freedom)
        gyro, accel = float(scatter[:3].sum()), float(scatter[3:].sum())
        return (
            gyro <= bound * CONSUMER_SENSOR.gyro_noise**2
            and accel <= bound * CONSUMER_SENSOR.accel_noise**2
        )

    def checkpoint(self) -> list[FloatArray]:
        """Everything that `rewind` needs."""
        return list(self._sums)

    def rewind(self, checkpoint: list[FloatArray]) -> None:
        """Go back to a checkpoint."""
        self._sums.clear()
        self._sums.extend(checkpoint)


def rest_measurement(
    epoch: Epoch, v_W: FloatArray, b_g: FloatArray, noise: ImuNoise
) -> tuple[FloatArray, list[Block], FloatArray]:
    """Residual (6,), Jacobian and covariance of zero velocity and zero rate over an epoch.

    The velocity is as uncertain as what white noise of the accelerometer hides over the window of
    the test, counted once however many epochs fall into it; the rate as the epoch's mean is.

    Args:
        epoch: at rest.
        v_W: (3,) estimated velocity [m/s].
        b_g: (3,) estimated bias [rad/s].
        noise: densities the filter assumes.
    """
    seconds = epoch.stop - epoch.start
    mean_rate = epoch.gyro[1:].mean(axis=0)
    hidden = max(noise.accel_noise, CONSUMER_SENSOR.accel_noise) ** 2 * WINDOW_SECONDS
    variance_v = hidden * WINDOW_SECONDS / seconds
    variance_g = CONSUMER_SENSOR.gyro_noise**2 / seconds
    covariance = np.diag([variance_v] * 3 + [variance_g] * 3)
    return np.concatenate([-v_W, mean_rate - b_g]), [(3, _BY_VELOCITY), (9, _BY_BIAS)], covariance


_BY_VELOCITY = np.eye(6, 3)
_BY_BIAS = np.eye(6, 3, k=-3)


def _chi2_quantile(freedom: float) -> float:
    """Of chi-square at 0.999, by Wilson and Hilferty's cube."""
    spread = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - spread + _QUANTILE * math.sqrt(spread)) ** 3)
