"""What is known of the gyroscope's bias beforehand: the device corrects it, or it does not.

Many devices estimate their gyroscope's bias and hand out corrected rates, others hand out what the
sensor says: biases are of two sizes. One Gaussian for both lets a corrected device be turned by
whatever the network's errors look like, or holds an uncorrected one too tightly. So the prior is
the mixture p N(0, s_c^2) + (1 - p) N(0, s^2).

A filter carries one Gaussian, the wide one. The narrow one is the wide one times a measurement of
zero with variance r = 1 / (1/s_c^2 - 1/s^2), and the filter knows how every error goes together
with the bias, so what a filter with the narrow prior would say follows from what this one says:
condition it on that measurement. The odds of the two are the ratio of the bias's densities after
and before all measurements (Savage and Dickey: Dickey, "The weighted likelihood ratio", 1971),

    p / (1 - p) (s / s_c)^3 r^(3/2) |S|^(-1/2) exp(-b^T S^-1 b / 2),    S = P_b + (r + q^2 t) I

with the bias's estimate b and covariance P_b and its walk q since the start, t ago, which is taken
for independent of what is known of b: right while q^2 t is small against s_c^2 (over six hours for
the default configuration). What is given out is the mixture's mean and covariance; the filter
itself goes on with the wide prior, so that nothing is decided that later measurements could not
turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.config import SMALLEST_SIGMA, NavigatorConfig
from stario.fusion.lie import FloatArray

_EYE = np.eye(3)

_NARROWEST = 1e-3
"""Of the wide deviation: a narrow one below is rounding."""

_LEAST_WEIGHT = 1e-3
"""Of the narrow prior that a graph heeds."""


@dataclass(frozen=True, eq=False)
class GyroPosterior:
    """What the mixture says of a filter's errors beyond the filter itself.

    Attributes:
        weight: (...) probability that the device corrects its gyroscope.
        to_zero: (..., 3) S^-1 b, so that an error with covariance P_g with the bias moves by
            -P_g S^-1 b where the device does.
        information: (..., 3, 3) S^-1.
    """

    weight: FloatArray
    to_zero: FloatArray
    information: FloatArray

    def moments(self, P: FloatArray, P_g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (..., n) of an error whose mean is zero to the filter, and its covariance.

        Args:
            P: (..., n, n) covariance to the filter.
            P_g: (..., n, 3) with the gyroscope's bias.
        """
        move = P_g @ self.to_zero[..., None]
        w = self.weight[..., None, None]
        moments = P - (w * (P_g @ self.information)) @ P_g.swapaxes(-1, -2)
        return -(w * move)[..., 0], moments + (w * (1.0 - w) * move) * move.swapaxes(-1, -2)


class GyroPrior:
    """The mixture as a configuration gives it.

    Args:
        config: probability and both deviations, where there are two.
        start: time of the bias that is meant [s].
    """

    def __init__(self, config: NavigatorConfig, start: float) -> None:
        f = config.filter
        self._mixed = f.two_gyro_priors
        if not self._mixed:
            return
        wide = max(f.gyro_bias_sigma, SMALLEST_SIGMA)  # as the filter begins
        narrow = max(f.gyro_corrected_sigma, _NARROWEST * wide)
        self._start, self._walk = start, config.noise.gyro_walk**2
        self._most_walk = wide * wide
        self._r = narrow * narrow / (1.0 - (narrow / wide) ** 2)
        odds = f.gyro_corrected / (1.0 - f.gyro_corrected)
        self._log_odds = math.log(odds) + 3.0 * math.log(wide / narrow) + 1.5 * math.log(self._r)

    def posterior(
        self, time: FloatArray, b_g: FloatArray, P_gg: FloatArray
    ) -> GyroPosterior | None:
        """The belief where a filter has these biases; None: as the filter.

        Args:
            time: (...) [s].
            b_g: (..., 3) bias [rad/s].
            P_gg: (..., 3, 3) its covariance.
        """
        if not self._mixed:
            return None
        walk = np.minimum(self._walk * (time - self._start), self._most_walk)
        S = P_gg + (self._r + walk)[..., None, None] * _EYE
        information = np.asarray(np.linalg.inv(S), dtype=np.float64)
        to_zero = (information @ b_g[..., None])[..., 0]
        log_odds = self._log_odds + 0.5 * np.log(np.linalg.det(information))
        log_odds = log_odds - 0.5 * (b_g * to_zero).sum(axis=-1)
        return GyroPosterior(0.5 * (1.0 + np.tanh(0.5 * log_odds)), to_zero, information)

    def covariance(self, weight: float) -> FloatArray | None:
        """Of a measurement of zero (3, 3) that counts as likely as it is; None for hardly at all.

        A graph, which starts from the filter's track, takes it for the whole mixture: a step of
        expectation and maximisation, without the spread between the two.
        """
        return self._r / weight * _EYE if weight > _LEAST_WEIGHT else None
