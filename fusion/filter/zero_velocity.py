"""Zero-velocity and zero-rate update (ZUPT, ZARU) of a device at rest; detection of rest.

README.md, "Zero velocity". A hand's tremor or a trolley's wheels exceed the bound of a still second
(`stario.sequences.inspection.stillness`). A smooth glide looks still as well and is left to the
update's own chi-square test.

Zero velocity is measured in the estimated axes, so it contains no information about yaw. The mean
rate in the middle of the still second measures the gyroscope's bias; both halves of the second are
at rest, so the onset of motion is not mistaken for bias. A person who stands sways slowly, which a
second hardly shows: what a whole rest tells about the bias is bounded by the angle of that sway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.ekf import Updated
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.kalman import Linear, update
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.values.config import FilterConfig
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.inspection.stillness import looks_still, scatter_bound
from stario.sequences.noise import PHONE_NOISE
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

_HIDDEN_MOTION_NOISE = 10.0 * PHONE_NOISE.accel_noise
"""Ten times a phone's white noise: slow motion of a device that only looks still [m/s^1.5]."""

_SWAY_SECONDS = 10.0
"""Time for which a person's sway may go on in one direction [s]."""

_EVEN_RATE = 0.02
"""Standard deviation of an even turn that shows no unrest in its first second [rad/s]. It falls
with the square of the rest's duration: nobody turns evenly for long."""

_H_VELOCITY = np.eye(6, 3)
_H_BIAS = np.eye(6, 3, k=-3)


class ZeroVelocity(NamedTuple):
    """Measurement at rest: the velocity is zero, the gyroscope reads its bias."""

    b_g: FloatArray
    """(3,) mean rate [rad/s]."""
    covariance: FloatArray
    """(6, 6) of velocity [m^2/s^2] and rate [rad^2/s^2]. The velocity's is widened, since every
    interval applies a measurement of the whole last second."""


@dataclass(frozen=True, eq=False)
class Stillness:
    """Whether the device was still over the last second.

    Attributes:
        window: for each interval of the last second (14,): number of samples, seconds, sums of gyro
            and accel, sums of their squares; None if it moves more than a still second may.
        rested: number of intervals for which it has been still without interruption.
        rates: (2, 3) sums over them of the last second's mean rate, and of its square.
    """

    window: tuple[FloatArray | None, ...] = ()
    rested: int = 0
    rates: FloatArray = field(default_factory=lambda: np.zeros((2, 3)))

    def after(self, interval: ImuInterval, f: FilterConfig) -> Stillness:
        """Return it after one more interval."""
        if interval.gap or f.stillness_noise == 0.0:
            return Stillness()
        intervals = round(f.output_rate * WINDOW_SECONDS)
        sums = None if _moves(interval, intervals, f.stillness_noise) else _sums_of(interval)
        window = (*self.window, sums)[-intervals:]
        calm = [sums for sums in window if sums is not None]
        if len(calm) < intervals or not _is_quiet(np.sum(calm, axis=0), f.stillness_noise):
            return Stillness(window)
        mean = _mean_rates(calm).mean(axis=0)
        return Stillness(window, self.rested + 1, self.rates + np.array((mean, mean**2)))

    def measurement(self) -> ZeroVelocity:
        """Return the measurement of a still second.

        The velocity's uncertainty is what white noise of a phone's accelerometer can hide over the
        second: nothing moves, so the filter's own density, which covers motion, does not apply.

        Who stands sways slowly, at rates r that go on in one direction for s seconds. T seconds of
        rest show the part 1 / (1 + 12 s^2 / T^2) of their variance, and their mean is off by up to
        2 r s / T. Rates weighted in proportion to the time since the rest began, as by variances
        2 r^2 s^2 / (T dt), are that precise and claim no more.
        """
        rates = _mean_rates(self.window)
        hidden_variance = len(rates) * _HIDDEN_MOTION_NOISE**2 * WINDOW_SECONDS
        dt = WINDOW_SECONDS / len(rates)
        rested = WINDOW_SECONDS + (self.rested - 1) * dt
        mean, mean_square = self.rates / self.rested
        white_variance = PHONE_NOISE.gyro_noise**2 / WINDOW_SECONDS
        varied = max(float((mean_square - mean**2).sum()) - 3.0 * white_variance, 0.0)
        ratio = (_SWAY_SECONDS / rested) ** 2
        sway = 2.0 * rested * ratio * varied * (1.0 + 12.0 * ratio)
        per_second = sway + (_EVEN_RATE / rested) ** 2
        rate_variance = (white_variance + per_second) / dt
        variances = [*[hidden_variance] * 3, *[rate_variance] * 3]
        return ZeroVelocity(rates[len(rates) // 2], np.diag(variances))


def _mean_rates(window: Sequence[FloatArray | None]) -> FloatArray:
    """Return the mean rates (n, 3) of a still second's intervals [rad/s]."""
    table = np.array(window)
    return np.asarray(table[:, 2:5] / table[:, :1])


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
    return update(s, Linear(residual, blocks, measured.covariance), limit, power=None)
