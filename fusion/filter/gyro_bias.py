"""Width of the gyroscope bias's prior, adapted to what is known about the bias.

README.md, "Noise and the gyroscope's bias". Most devices correct their bias to 0.001 rad/s, some to
0.005 rad/s and some not at all. No Gaussian fits all of them; a Student-t distribution does, which
is a Gaussian of unknown variance (Lange et al. 1989). That variance follows the estimated bias, and
forgets one that the data no longer show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import GAIN, GYRO_BIAS, REPORTED
from stario.fusion.filter.kalman import corrected
from stario.fusion.imu.intervals import SAME_TIME, ImuInterval
from stario.fusion.values.config import MIN_PRIOR_SIGMA, FilterConfig
from stario.fusion.values.state import changed
from stario.sequences.sequence import FloatArray

_DEGREES_OF_FREEDOM = 3.0
"""Of the t distribution. Fewer let slow errors of network and field into the bias (KIPD with the
field: 1.25 of the error with 1, 1.07 with 2, 1.02 with 4), more keep a raw gyroscope's out."""

_PRIOR_TOLERANCE = 1e-6
"""Relative difference up to which two variances count as equal."""


@dataclass(frozen=True)
class GyroBiasPrior:
    """Student-t prior of the gyroscope's bias: normal with a variance that is estimated.

    Attributes:
        sigma: scale of the t distribution [rad/s].
        variance: variance per axis of the normal prior, as currently applied [rad^2/s^2].
    """

    sigma: float
    variance: float

    def updated(self, b_g: FloatArray, P: FloatArray, walked: float) -> GyroBiasPrior:
        """Return the prior with its variance's mean given the estimated bias.

        (nu sigma^2 + E|b|^2) / (nu + 1): the inverse gamma distribution that makes b a t variable
        of nu degrees of freedom, after the three axes, which share it: a device corrects all or
        none.

        Args:
            b_g: (3,) bias as estimated by the filter [rad/s].
            P: (3, 3) its covariance [rad^2/s^2].
            walked: variance by which the bias may have changed since the start [rad^2/s^2].
        """
        return changed(self, variance=self._mean(float(b_g @ b_g + np.trace(P)) - 3.0 * walked))

    def widest(self) -> GyroBiasPrior:
        """Return the prior with its mean variance, before anything is known of the bias."""
        nu = _DEGREES_OF_FREEDOM
        return changed(self, variance=nu / (nu - 2.0) * self.sigma**2)

    def _mean(self, squared: float) -> float:
        nu = _DEGREES_OF_FREEDOM
        return max((nu * self.sigma**2 + squared) / (nu + 1.0), self.sigma**2)


def first_prior(f: FilterConfig) -> GyroBiasPrior:
    """Return the prior of the bias with which the filter is initialised."""
    sigma = max(f.gyro_bias_sigma, MIN_PRIOR_SIGMA)
    return GyroBiasPrior(sigma, sigma**2)


def is_due(interval: ImuInterval, start: float) -> bool:
    """Return whether a half second since the start, or a gap, ends in an interval.

    The information changes no faster.
    """

    def half_seconds(time: float) -> int:
        return math.floor(2.0 * (time - start) + SAME_TIME)

    return interval.gap or half_seconds(interval.stop) != half_seconds(interval.start)


def with_prior_replaced(s: EkfState, old: float, new: float) -> EkfState:
    """Return the state as if the gyroscope bias's zero-mean prior had always been another one.

    The old prior's information is removed and the new one's added: an update by a measurement of
    zero, with negative variance if the prior widens; exact as far as the filter is linear and the
    bias constant. A bias that has wandered may be less certain than its prior: since no more
    information can be removed than there is, both priors are then widened by one factor.

    Args:
        s: the state.
        old: variance per axis of the previous prior [rad^2/s^2].
        new: variance per axis of the new prior [rad^2/s^2].
    """
    if new > (1.0 + _PRIOR_TOLERANCE) * old:
        widest = float(np.linalg.eigvalsh(s.P[GYRO_BIAS, GYRO_BIAS])[-1])
        old, new = max(old, widest), new * max(1.0, widest / old)
    while abs(new - old) > _PRIOR_TOLERANCE * old:
        step = min(new, 2.0 * old)  # a larger one would be badly conditioned
        before, R = s.covariances, old * step / (old - step) * np.eye(3)
        H = np.eye(3, before.shape[1], k=GYRO_BIAS.start)
        s = corrected(s, -s.b_g, H, np.array((R, R)))
        if step > old:  # the error gains what the gains forget, however large it is
            actual = before[REPORTED] + s.P - before[GAIN]
            s = changed(s, covariances=np.array((s.P, actual)))
        old = step
    return s
