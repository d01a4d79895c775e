"""How wide the gyroscope bias's prior must be, by what is known of the bias.

README.md, "Noise and the gyroscope's bias". Most devices correct their bias to a thousandth of a
radian per second, some to five, some not at all, and no single Gaussian holds for all of them. So
its width follows what is known (empirical Bayes: Carlin and Louis 2000), without a threshold to
flip at: wide while gravity has told little of the bias, narrow once it has told that it is small,
wide where it is large, or where the data say clearly that it lies outside the prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.changed import changed
from stario.fusion.config import SMALLEST_SIGMA, NavigatorConfig
from stario.fusion.filter.alternative import HypothesisPair
from stario.fusion.filter.ekf_state import GYRO_BIAS, EkfState
from stario.fusion.imu.intervals import ImuInterval
from stario.sequences.attitude.levelling import BIAS_SIGMA
from stario.sequences.sequence import FloatArray

_MAX_CORRECTED_BIAS = 0.01
"""Of a gyroscope that the device corrects, at most, by what levelling says of it [rad/s]."""

_SHARED_FRACTION = 0.4
"""What is not known yet about the level axes counts by this share: what is known of them tells of
the vertical one as well, since a device corrects all or none."""

_SIGNIFICANT = 3.0
"""Deviations of what the data say, about any axis, within which the prior is left alone."""

_PRECISE_SIGMA = 5e-3
"""Data that tell less than this [rad/s] are the network's displacements alone: too little to go
by, since their errors are alike for long. Rest, gravity, fixes and the magnetic field tell more."""

_WIDEST = 0.015
"""To which data widen it [rad/s]; what lies outside is raw, which levelling tells sooner."""

_REST_SIGMA = 2.5e-3
"""Where rest tells it, at least [rad/s]: a glide that turns is no rest."""

_LONG_REST, _RAW_SIGMA = 30.0, 0.1
"""What looks like rest for so long [s] is rest, though the gyroscope reads up to this [rad/s]: of
what is raw about the vertical gravity tells nothing, and nobody turns so long so evenly."""

_TIME_TOLERANCE = 1e-6
"""Of times [s]."""

_MIN_GAIN, _VAGUE_SIGMA = 1e-6, 1.0
"""Share of the information by which an update must add to it; sigma along axes untold [rad/s]."""


@dataclass(frozen=True)
class GyroBiasPrior:
    """Zero mean, with a variance that follows what is known.

    Attributes:
        sigma: of a device that corrects its bias well [rad/s].
        variance: per axis, now [rad^2/s^2].
        raw: of the bias beyond what such a device leaves, at most so far [rad/s].
        evident: variance that the data asked for, at most so far.
        refused: for how long it has looked like rest and was refused [s].
    """

    sigma: float
    variance: float
    uncorrected: float = 0.0
    evidence: float = 0.0
    refused_seconds: float = 0.0

    @classmethod
    def first(cls, sigma: float) -> GyroBiasPrior:
        """Before anything is known."""
        return cls(sigma, sigma**2)

    def before_levelling(self) -> GyroBiasPrior:
        """As wide as while levelling knows nothing of the bias."""
        return changed(self, variance=self.sigma**2 + (_SHARED_FRACTION * BIAS_SIGMA) ** 2)

    def updated(
        self,
        levelled: float,
        levelled_sigma: float,
        b_g: FloatArray,
        P: FloatArray,
        wander: float,
    ) -> GyroBiasPrior:
        """What the prior should be by now; to be put in place of this one in the filter.

        Args:
            levelled: size of the bias as far as gravity tells it [rad/s].
            levelled_sigma: of it, per level axis [rad/s].
            b_g: (3,) the bias as the filter estimates it [rad/s].
            P: (3, 3) its covariance.
            wander: variance by which it may have changed since the start [rad^2/s^2].
        """
        uncorrected = max(self.uncorrected, levelled - _MAX_CORRECTED_BIAS)
        evidence = max(self.evidence, min(self._variance_from_data(b_g, P, wander), _WIDEST**2))
        known = self.sigma**2 + (_SHARED_FRACTION * levelled_sigma) ** 2 + uncorrected**2
        return changed(
            self, variance=max(known, evidence), uncorrected=uncorrected, evidence=evidence
        )

    def _variance_from_data(self, b_g: FloatArray, P: FloatArray, wander: float) -> float:
        """The variance that the data ask for.

        With prior variance s^2, wander w included, and posterior b, P they alone say y with
        covariance E: E^-1 = P^-1 - s^-2 I, y = E P^-1 b; about each principal axis
        s^2 >= y^2 - (3 e)^2.
        """
        prior = self.variance + wander
        p, axes = np.linalg.eigh(P)
        p = np.maximum(p, 1e-6 * prior)
        precise = p < prior * _PRECISE_SIGMA**2 / (prior + _PRECISE_SIGMA**2)
        if not precise.any():
            return 0.0
        e = p[precise] * prior / (prior - p[precise])  # squares
        y = (axes.T @ b_g)[precise] * e / p[precise]
        return float(np.max(y**2 - _SIGNIFICANT**2 * e)) - wander


class AdaptiveBiasPrior:
    """The prior in a filter, and in the sceptic beside it, as what is known asks for it.

    Args:
        opinion: both.
        config: settings and noise.
        start: time of the first state [s].

    Attributes:
        prior: as it stands in the filter.
    """

    def __init__(self, hypotheses: HypothesisPair, config: NavigatorConfig, start: float) -> None:
        self._hypotheses, self._config, self._start = hypotheses, config, start
        self.prior = GyroBiasPrior.first(max(config.filter.gyro_bias_sigma, SMALLEST_SIGMA))

    def begin(self) -> None:
        """Before gravity has told anything."""
        if self._config.filter.adaptive:
            self._exchange(self.prior.before_levelling())

    def update(self, interval: ImuInterval) -> None:
        """Behind an interval, by what gravity and the data tell of the bias by now."""
        if not self._config.filter.adaptive:
            return
        if not interval.gap and self._half_seconds(interval.stop) == self._half_seconds(
            interval.start
        ):
            return
        levelled = interval.levelled_bias, interval.levelled_bias_sigma
        s = self._hypotheses.ekf.state
        self._exchange(
            self.prior.updated(*levelled, s.b_g, s.P[GYRO_BIAS, GYRO_BIAS], self._wander)
        )

    def widen_for_rest(self) -> None:
        """Rest tells the bias, be it what it may."""
        sigma = _REST_SIGMA if self.prior.refused_seconds < _LONG_REST else _RAW_SIGMA
        self._exchange(changed(self.prior, variance=max(self.prior.variance, sigma**2)))

    def note_refused_rest(self, seconds: float) -> None:
        """What looked like rest was refused for so long again; 0 where it was not, or moves [s]."""
        refused_seconds = self.prior.refused_seconds + seconds if seconds else 0.0
        if refused_seconds != self.prior.refused_seconds:
            self.prior = changed(self.prior, refused_seconds=refused_seconds)

    def _exchange(self, updated: GyroBiasPrior) -> None:
        """Everything as if it had been the prior from the start."""
        old, new = self.prior.variance + self._wander, updated.variance + self._wander
        ekf = self._hypotheses.ekf
        self._hypotheses.apply_to_both(lambda: ekf.exchange_gyro_bias_prior(old, new))
        self.prior = updated

    def _half_seconds(self, time: float) -> int:
        """Whole half seconds since the start: what is known of a bias changes no faster."""
        return math.floor(2.0 * (time - self._start) + _TIME_TOLERANCE)

    @property
    def _wander(self) -> float:
        """Variance by which the bias may have changed since the start."""
        seconds = max(0.0, self._hypotheses.ekf.state.time - self._start)
        return float(self._config.noise.gyro_walk**2 * seconds)


def gained_bias_information(
    before: EkfState, after: EkfState
) -> tuple[FloatArray, FloatArray] | None:
    """What an update told of the gyroscope's bias, whatever it measured.

    The information that the bias alone has gained by it: E^-1 = P+^-1 - P-^-1 with the mean
    E (P+^-1 b+ - P-^-1 b-), along the axis that has gained most of it.

    Returns:
        (3,) [rad/s] and covariance (3, 3); None where nothing was gained.
    """
    was, now = (np.linalg.inv(s.P[GYRO_BIAS, GYRO_BIAS]) for s in (before, after))
    gained, axes = np.linalg.eigh(now - was)
    gain, axis = float(gained[-1]), axes[:, -1]
    if gain < _MIN_GAIN * float(np.trace(was)):
        return None
    value = float(axis @ (now @ after.b_g - was @ before.b_g)) / gain
    covariance = np.outer(axis, axis) / gain + _VAGUE_SIGMA**2 * (np.eye(3) - np.outer(axis, axis))
    return value * axis, covariance
