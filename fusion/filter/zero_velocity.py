"""Zero-velocity and zero-rate update (ZUPT, ZARU) of a device at rest.

README.md, "Zero velocity". Zero velocity is measured in the estimated axes, so that it says nothing
of yaw. The mean rate in the middle of the still second measures the gyroscope's bias; both its
halves are at rest, so that a beginning motion is not taken for bias. What turns too slowly to be
told from bias shows in how the means of the second's parts differ, and their variance is the
measurement's, for the whole second.
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
"""Ten times a phone's white noise: the slow motion of a device that only looks still [m/s^1.5]."""

_H_VELOCITY = np.eye(6, 3)
_H_BIAS = np.eye(6, 3, k=-3)


class ZeroVelocity(NamedTuple):
    """What is measured at rest: the velocity is zero, the gyroscope reads its bias."""

    b_g: FloatArray
    """(3,) mean rate [rad/s]."""
    covariance: FloatArray
    """(6, 6) of velocity [m^2/s^2] and rate [rad^2/s^2]; measured once per interval and counted
    once per second, hence so wide."""


def zero_velocity(stillness: StillnessDetector) -> ZeroVelocity:
    """The measurement of a still second.

    The velocity is as uncertain as what white noise of a phone's accelerometer hides over the
    second: nothing moves, so the filter's own density, which stands for motion, is no measure here.
    """
    rates = stillness.mean_rates()
    n = len(rates)
    hidden_variance = _HIDDEN_MOTION_NOISE**2 * WINDOW_SECONDS
    white_variance = PHONE_NOISE.gyro_noise**2 / stillness.mean_seconds()
    rate_variance = np.maximum(rates.var(axis=0), white_variance)
    return ZeroVelocity(rates[n // 2], np.diag([*[n * hidden_variance] * 3, *(n * rate_variance)]))


def update_zero_velocity(ekf: StateCloningEkf, measured: ZeroVelocity, gate: float) -> UpdateResult:
    """Update a filter; refused, not inflated, where an even glide only looks still."""
    s = ekf.state
    residual = np.concatenate([-s.v_W, measured.b_g - s.b_g])
    blocks = [(3, _H_VELOCITY), (9, _H_BIAS)]
    return ekf.update_linear(residual, blocks, measured.covariance, gate, "reject")
