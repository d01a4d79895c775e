"""Width of the gyroscope bias's prior, adapted to what is known about the bias.

README.md, "Noise and the gyroscope's bias". Most devices correct their bias to 0.001 rad/s, some to
0.005 rad/s and some not at all, and no single Gaussian fits all of them. The prior's width
therefore adapts (empirical Bayes: Carlin and Louis 2000), without a threshold at which it could
flip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.config import MIN_PRIOR_SIGMA, NavigatorConfig
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import with_gain
from stario.fusion.filter.hypotheses import HypothesisPair
from stario.fusion.filter.jacobians import ACTUAL, ASSUMED, GYRO_BIAS
from stario.fusion.imu.intervals import SAME_TIME, ImuInterval
from stario.fusion.state import changed
from stario.sequences.attitude.levelling import BIAS_SIGMA
from stario.sequences.sequence import FloatArray

_MAX_CORRECTED_BIAS = 0.01
"""Maximum bias, as estimated by levelling, of a gyroscope that the device corrects [rad/s]."""

_SHARED_FRACTION = 0.4
"""Fraction of the level axes' remaining sigma that widens the prior: what is known about them also
applies to the vertical axis, since a device corrects all or none."""

_SIGNIFICANT = 3.0
"""Standard deviations of the data's estimate, about any axis, within which the prior is kept."""

_PRECISE_SIGMA = 5e-3
"""Sigma of the data's estimate above which it is ignored [rad/s]: it then comes from the network's
displacements alone, whose errors stay correlated for long. Stillness, gravity, fixes and the
magnetic field are more precise."""

_MAX_DATA_SIGMA = 0.015
"""Maximum sigma to which the data widen the prior [rad/s]; a larger bias is uncorrected, which
levelling detects sooner."""

_STILLNESS_SIGMA = 2.5e-3
"""Minimum sigma of the prior when a zero-velocity update measures the bias [rad/s]; small enough to
reject a glide that turns."""

_LONG_STILLNESS, _RAW_SIGMA = 30.0, 0.1
"""After apparent stillness has been rejected for this long [s], the minimum sigma is this [rad/s]:
gravity cannot reveal an uncorrected vertical bias, and nobody turns so evenly for so long."""

_PRIOR_TOLERANCE = 1e-6
"""Relative difference up to which two variances count as equal."""


@dataclass(frozen=True)
class GyroBiasPrior:
    """Zero-mean prior of the gyroscope's bias, with an adaptive variance.

    Attributes:
        sigma: standard deviation for a device that corrects its bias well [rad/s].
        variance: current variance per axis [rad^2/s^2].
        uncorrected: largest bias so far in excess of what a correcting device leaves [rad/s].
        evidence: largest variance that the data have required so far [rad^2/s^2].
        refused_seconds: duration for which apparent stillness has been rejected [s].
    """

    sigma: float
    variance: float
    uncorrected: float = 0.0
    evidence: float = 0.0
    refused_seconds: float = 0.0

    def updated(
        self,
        levelled: float,
        levelled_sigma: float,
        b_g: FloatArray,
        P: FloatArray,
        wander: float,
    ) -> GyroBiasPrior:
        """Return the prior that should replace this one in the filter.

        Args:
            levelled: magnitude of the bias as far as gravity determines it [rad/s].
            levelled_sigma: its standard deviation per level axis [rad/s].
            b_g: (3,) bias as estimated by the filter [rad/s].
            P: (3, 3) covariance of `b_g` [rad^2/s^2].
            wander: variance by which the bias may have changed since the start [rad^2/s^2].
        """
        uncorrected = max(self.uncorrected, levelled - _MAX_CORRECTED_BIAS)
        evidence = max(
            self.evidence, min(self._variance_from_data(b_g, P, wander), _MAX_DATA_SIGMA**2)
        )
        floor = self.sigma**2 + (_SHARED_FRACTION * levelled_sigma) ** 2 + uncorrected**2
        return changed(
            self, variance=max(floor, evidence), uncorrected=uncorrected, evidence=evidence
        )

    def _variance_from_data(self, b_g: FloatArray, P: FloatArray, wander: float) -> float:
        """Return the variance that the data require.

        With prior variance s^2 (including the wander) and posterior b, P, the data alone estimate
        y with covariance E: E^-1 = P^-1 - s^-2 I, y = E P^-1 b. They require
        s^2 >= y^2 - (3 e)^2 about each principal axis.
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
    """Adaptive prior of the bias in a filter and its alternative.

    Args:
        hypotheses: the filter and its alternative.
        config: settings and noise.
        start: time of the first state [s].

    Attributes:
        prior: prior as currently applied in the filter.
    """

    def __init__(self, hypotheses: HypothesisPair, config: NavigatorConfig, start: float) -> None:
        self._hypotheses, self._config, self._start = hypotheses, config, start
        sigma = max(config.filter.gyro_bias_sigma, MIN_PRIOR_SIGMA)
        self.prior = GyroBiasPrior(sigma, sigma**2)

    def begin(self) -> None:
        """Widen the prior for the time before gravity provides information."""
        if self._config.filter.adaptive:
            variance = self.prior.sigma**2 + (_SHARED_FRACTION * BIAS_SIGMA) ** 2
            self._replace_prior(changed(self.prior, variance=variance))

    def update(self, interval: ImuInterval) -> None:
        """Adapt the prior after an interval to what gravity and the data show about the bias."""
        if not self._config.filter.adaptive:
            return
        if not interval.gap and self._half_seconds(interval.stop) == self._half_seconds(
            interval.start
        ):
            return
        levelled = interval.levelled_bias, interval.levelled_bias_sigma
        s = self._hypotheses.ekf.state
        self._replace_prior(
            self.prior.updated(*levelled, s.b_g, s.P[GYRO_BIAS, GYRO_BIAS], self._wander)
        )

    def widen_for_rest(self) -> None:
        """Widen the prior before a zero-velocity update measures the bias."""
        if not self._config.filter.adaptive:
            return
        sigma = _STILLNESS_SIGMA if self.prior.refused_seconds < _LONG_STILLNESS else _RAW_SIGMA
        self._replace_prior(changed(self.prior, variance=max(self.prior.variance, sigma**2)))

    def note_refused_rest(self, seconds: float) -> None:
        """Add to the time of rejected apparent stillness [s]; 0 resets it (accepted, or moving)."""
        refused_seconds = self.prior.refused_seconds + seconds if seconds else 0.0
        if refused_seconds != self.prior.refused_seconds:
            self.prior = changed(self.prior, refused_seconds=refused_seconds)

    def _replace_prior(self, updated: GyroBiasPrior) -> None:
        """Replace the prior in both filters as if the new one had been used from the start."""
        old, new = self.prior.variance + self._wander, updated.variance + self._wander
        ekf = self._hypotheses.ekf
        self._hypotheses.apply_to_both(lambda: replace_prior(ekf, old, new))
        self.prior = updated

    def _half_seconds(self, time: float) -> int:
        """Return the whole half seconds since the start; the information changes no faster."""
        return math.floor(2.0 * (time - self._start) + SAME_TIME)

    @property
    def _wander(self) -> float:
        """Variance by which the bias may have changed since the start."""
        seconds = max(0.0, self._hypotheses.ekf.state.time - self._start)
        return float(self._config.noise.gyro_walk**2 * seconds)


def replace_prior(ekf: StateCloningEkf, old: float, new: float) -> None:
    """Replace the gyroscope bias's zero-mean prior as if the new one had been used throughout.

    The old prior's information is removed and the new one's added: an update by a measurement of
    zero, with negative variance if the prior widens; exact as far as the filter is linear and the
    bias constant. A bias that has wandered may be less certain than its prior: since no more
    information can be removed than there is, both priors are then widened by one factor.

    Args:
        ekf: the filter.
        old: variance per axis of the previous prior [rad^2/s^2].
        new: variance per axis of the new prior [rad^2/s^2].
    """
    if new > (1.0 + _PRIOR_TOLERANCE) * old:
        widest = float(np.linalg.eigvalsh(ekf.state.P[GYRO_BIAS, GYRO_BIAS])[-1])
        old, new = max(old, widest), new * max(1.0, widest / old)
    while abs(new - old) > _PRIOR_TOLERANCE * old:
        step = min(new, 2.0 * old)  # a larger one would be badly conditioned
        P, HP = ekf.covariances, ekf.covariances[:, GYRO_BIAS]
        S = HP[:, :, GYRO_BIAS] + old * step / (old - step) * np.eye(3)
        K = np.asarray(np.linalg.solve(S[ASSUMED], HP[ASSUMED]).T, dtype=np.float64)
        updated = with_gain(P, K, HP, S)
        if step > old:  # the error gains what the gains forget, however large it is
            updated[ACTUAL] = P[ACTUAL] + updated[ASSUMED] - P[ASSUMED]
        ekf.x = (K @ -ekf.state.b_g)[:, None]
        ekf.inject(updated)
        old = step
