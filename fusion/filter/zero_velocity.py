"""Zero-velocity and zero-rate update (ZUPT, ZARU) of a device at rest; detection of rest.

README.md, "Zero velocity". A hand's tremor or a trolley's wheels exceed the bound of a still second
(`stario.sequences.inspection.stillness`). A smooth glide looks still as well and is left to the
update's own chi-square test.

Zero velocity is measured in the estimated axes, so it contains no information about yaw. The mean
rate in the middle of the still second measures the gyroscope's bias; both halves of the second are
at rest, so the onset of motion is not mistaken for bias. A turn too slow to be distinguished from
bias makes the means of the second's parts differ; their variance is taken as that of the
measurement, for the whole second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stario.fusion.config import FilterConfig
from stario.fusion.filter.ekf import Updated
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.kalman import Linear, update
from stario.fusion.imu.intervals import ImuInterval
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.inspection.stillness import looks_still, scatter_bound
from stario.sequences.noise import PHONE_NOISE
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

_HIDDEN_MOTION_NOISE = 10.0 * PHONE_NOISE.accel_noise
"""Ten times a phone's white noise: slow motion of a device that only looks still [m/s^1.5]."""

_SWAY = 10.0
"""Variance of a person's sway about its mean over a second, relative to the variance within it: who
stands turns the device at 1 to 2 deg/s, of which a second shows a third."""

_SWAY_RATE = 0.02
"""Standard deviation of a person's sway in a second that looks still [rad/s]. It falls with the
square of the rest's duration: between two sways a second may look still, several do not."""

_H_VELOCITY = np.eye(6, 3)
_H_BIAS = np.eye(6, 3, k=-3)


class ZeroVelocity(NamedTuple):
    """Measurement at rest: the velocity is zero, the gyroscope reads its bias."""

    b_g: FloatArray
    """(3,) mean rate [rad/s]."""
    covariance: FloatArray
    """(6, 6) of velocity [m^2/s^2] and rate [rad^2/s^2]; widened, since every interval applies a
    measurement of the whole last second."""


@dataclass(frozen=True, eq=False)
class Stillness:
    """Whether the device was still over the last second.

    Attributes:
        window: for each interval of the last second (14,): number of samples, seconds, sums of gyro
            and accel, sums of their squares; None if it moves more than a still second may.
        rested: number of intervals for which it has been still without interruption.
    """

    window: tuple[FloatArray | None, ...] = ()
    rested: int = 0

    def after(self, interval: ImuInterval, f: FilterConfig) -> Stillness:
        """Return it after one more interval."""
        if interval.gap or f.stillness_noise == 0.0:
            return Stillness()
        intervals = round(f.output_rate * WINDOW_SECONDS)
        sums = None if _moves(interval, intervals, f.stillness_noise) else _sums_of(interval)
        window = (*self.window, sums)[-intervals:]
        calm = [sums for sums in window if sums is not None]
        still = len(calm) == intervals and _is_quiet(np.sum(calm, axis=0), f.stillness_noise)
        return Stillness(window, self.rested + 1 if still else 0)

    def measurement(self) -> ZeroVelocity:
        """Return the measurement of a still second.

        The velocity's uncertainty is what white noise of a phone's accelerometer can hide over the
        second: nothing moves, so the filter's own density, which covers motion, does not apply.
        """
        table = np.array(self.window)
        rates = table[:, 2:5] / table[:, :1]
        n = len(rates)
        hidden_variance = _HIDDEN_MOTION_NOISE**2 * WINDOW_SECONDS
        white_variance = PHONE_NOISE.gyro_noise**2 / float(table[:, 1].mean())
        excess = max(float(rates.var(axis=0).sum()) - 3.0 * white_variance, 0.0)
        seconds = 1.0 + (self.rested - 1) / n
        swaying = (_SWAY_RATE / seconds) ** 2
        rate_variance = np.full(3, white_variance + _SWAY * excess + swaying)
        variances = [*[n * hidden_variance] * 3, *(n * rate_variance)]
        return ZeroVelocity(rates[n // 2], np.diag(variances))


def _moves(interval: ImuInterval, intervals: int, scale: float) -> bool:
    """Return whether an interval's specific force scatters more than a still second's may."""
    accel = interval.accel[1:]
    count = len(accel)
    total = accel.sum(axis=0)
    scatter = float(np.vdot(accel, accel) - total @ total / count)
    seconds = (interval.stop - interval.start) * intervals
    return not looks_still(0.0, scatter, scatter_bound(count * intervals, seconds, scale))


def _is_quiet(sums: FloatArray, scale: float) -> bool:
    """Return whether a second with these sums scatters no more than a still one may."""
    count = float(sums[0])
    scatter = sums[8:14] - np.square(sums[2:8]) / count
    bound = scatter_bound(count, float(sums[1]), scale)
    return looks_still(float(scatter[:3].sum()), float(scatter[3:].sum()), bound)


def _sums_of(interval: ImuInterval) -> FloatArray:
    rows = np.hstack([interval.gyro[1:], interval.accel[1:]])
    totals = np.ones(len(rows)) @ rows, np.einsum("ni,ni->i", rows, rows)
    return np.concatenate([(len(rows), interval.stop - interval.start), *totals])


def update_zero_velocity(s: EkfState, measured: ZeroVelocity, f: FilterConfig) -> Updated:
    """Update a filter; an outlier is rejected, not inflated: an even glide also looks still."""
    residual = np.concatenate([-s.v_W, measured.b_g - s.b_g])
    blocks = [(3, _H_VELOCITY), (9, _H_BIAS)]
    limit = chi2_quantile(f.gate, 6)
    return update(s, Linear(residual, blocks, measured.covariance), limit, None)
