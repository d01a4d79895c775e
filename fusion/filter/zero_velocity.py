"""Zero-velocity and zero-rate update (ZUPT, ZARU) of a device at rest.

README.md, "Zero velocity". Zero velocity is measured in the estimated axes, so it contains no
information about yaw. The mean rate in the middle of the still second measures the gyroscope's
bias; both halves of the second are at rest, so the onset of motion is not mistaken for bias. A turn
too slow to be distinguished from bias makes the means of the second's parts differ; their variance
is taken as that of the measurement, for the whole second.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.imu.stillness import StillnessDetector
from stario.sequences.noise import PHONE_NOISE
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

_HIDDEN_MOTION_NOISE = 10.0 * PHONE_NOISE.accel_noise
"""Ten times a phone's white noise: slow motion of a device that only looks still [m/s^1.5]."""

_H_VELOCITY = np.eye(6, 3)
_H_BIAS = np.eye(6, 3, k=-3)


class ZeroVelocity(NamedTuple):
    """Measurement at rest: the velocity is zero, the gyroscope reads its bias."""

    b_g: FloatArray
    """(3,) mean rate [rad/s]."""
    covariance: FloatArray
    """(6, 6) of velocity [m^2/s^2] and rate [rad^2/s^2]; widened, since every interval applies a
    measurement of the whole last second."""


def zero_velocity(stillness: StillnessDetector) -> ZeroVelocity:
    """Return the measurement of a still second.

    The velocity's uncertainty is what white noise of a phone's accelerometer can hide over the
    second: nothing moves, so the filter's own density, which covers motion, does not apply here.
    """
    rates = stillness.mean_rates()
    n = len(rates)
    hidden_variance = _HIDDEN_MOTION_NOISE**2 * WINDOW_SECONDS
    white_variance = PHONE_NOISE.gyro_noise**2 / stillness.mean_seconds()
    rate_variance = np.maximum(rates.var(axis=0), white_variance)
    return ZeroVelocity(rates[n // 2], np.diag([*[n * hidden_variance] * 3, *(n * rate_variance)]))


def update_zero_velocity(ekf: StateCloningEkf, measured: ZeroVelocity, gate: float) -> UpdateResult:
    """Update a filter; an outlier is rejected, not inflated: an even glide also looks still."""
    s = ekf.state
    residual = np.concatenate([-s.v_W, measured.b_g - s.b_g])
    blocks = [(3, _H_VELOCITY), (9, _H_BIAS)]
    return ekf.update_linear(residual, blocks, measured.covariance, gate, "reject")
