"""What the innovations tell about the network's errors and the accelerometer's noise.

They adapt the level of the errors and the noise that the accelerometer must have beside them, by
stochastic approximation (Robbins and Monro 1951): README.md, "Noise and the gyroscope's bias".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.imu.preintegration import in_steps
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.state import changed

GAIN, FIRST_GAIN = 0.05, 0.2
"""Step per displacement of a logarithm that is estimated from innovations: in the long run, and for
the first one."""

_MAX_EXCESS = 4.0
"""Largest excess of NIS over its expectation that counts for the level."""

MIN_LEVEL, MAX_LEVEL = 0.1, 100.0
"""Bounds of the level."""

USUAL_LEVEL = 5.0
"""Level up to which devices and ways of carrying differ. An accelerometer in a runner's pocket
raises it as well; only what is beyond are errors of the network that its sigma does not know."""

TARGET_NIS = 0.3
"""Target for the median NIS per degree of freedom: the network's errors are correlated over
seconds, so consistent innovations are smaller than single errors."""

MAX_FACTOR = 15.0
"""Maximum noise factor: the accelerometer then rules out little more than jumps."""

_SHARE_SECONDS = 20.0
"""Time over which the share of outliers is averaged [s]."""


@dataclass(frozen=True)
class InnovationStatistics:
    """What the innovations of the displacements so far tell.

    Attributes:
        outlier_share: fraction of outliers among recent ones, which are assumed common at first.
        log_accel_factor: natural logarithm of the factor on the accelerometer's noise density.
        log_error_level: that of `error_level`.
        gain: step of both logarithms for the next displacement.
    """

    outlier_share: float = 0.5
    log_accel_factor: float = 0.0
    log_error_level: float = 0.0
    gain: float = FIRST_GAIN

    @property
    def accel_factor(self) -> float:
        """Factor by which the accelerometer is noisier than configured, in steps."""
        return in_steps(math.exp(self.log_accel_factor))

    @property
    def error_level(self) -> float:
        """Variance of the errors that change within seconds, relative to the predicted one."""
        return math.exp(self.log_error_level)

    @property
    def excess(self) -> float:
        """Factor by which the predicted covariance is too small as a whole."""
        return max(1.0, self.error_level / USUAL_LEVEL)

    def updated(self, result: UpdateResult, f: FilterConfig) -> InnovationStatistics:
        """Return the statistics after one displacement, which may have no innovation."""
        change = (result.gated - self.outlier_share) / (f.update_rate * _SHARE_SECONDS)
        counted = changed(self, outlier_share=self.outlier_share + change)
        if not (f.adaptive and math.isfinite(result.nis + result.gate_nis)):
            return counted
        ratio = (result.gate_nis / (3.0 * TARGET_NIS)) ** 2
        step = self.gain * (1.0 - 2.0 / (ratio + 1.0))
        factor = min(max(self.log_accel_factor + step, 0.0), math.log(MAX_FACTOR))
        level = self.log_error_level
        if f.correlated_errors:
            level += self.gain * min(result.nis / 3.0 - 1.0, _MAX_EXCESS)
            level = min(max(level, math.log(MIN_LEVEL)), math.log(MAX_LEVEL))
        # The gains are 1/5, 1/6, 1/7, ... down to `GAIN` (Robbins and Monro 1951).
        gain = max(1.0 / (1.0 / self.gain + 1.0), GAIN)
        return changed(counted, log_accel_factor=factor, log_error_level=level, gain=gain)
