"""Online estimate of the accelerometer's effective noise from the innovations.

README.md, "Noise and the gyroscope's bias". The configured density is a prior: errors of scale,
tilt and saturation act like noise, and differ between a phone held in front of the chest and one in
a runner's pocket. The innovations of displacements determine a factor on it, by stochastic
approximation (Robbins and Monro 1951): the factor rises with each innovation that is larger than
typical and falls with each smaller one, in steps of at most the gain. It therefore follows their
median, and a few false displacements are not mistaken for a bad accelerometer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stario.fusion.filter.engine import UpdateResult

TARGET_NIS = 0.3
"""Target for the median NIS per degree of freedom: the network's errors are correlated over
seconds, so consistent innovations are smaller than single errors."""

GAIN, FIRST_GAIN = 0.05, 0.2
"""Step of the logarithm per displacement: in the long run, and for the first displacement."""

MAX_FACTOR = 30.0
"""Maximum factor: the accelerometer then rules out little more than jumps."""

_STEPS = 4
"""Number of factors per doubling, so that few different noise models are created."""


@dataclass(frozen=True)
class AccelNoiseScale:
    """Factor by which the accelerometer is noisier than configured.

    Attributes:
        log_factor: natural logarithm of the factor on its noise density.
        gain: step size for the next displacement.
    """

    log_factor: float = 0.0
    gain: float = FIRST_GAIN

    @property
    def factor(self) -> float:
        """Factor on the noise density, in steps."""
        return float(2.0 ** (round(_STEPS * self.log_factor / math.log(2.0)) / _STEPS))

    def updated(self, result: UpdateResult) -> AccelNoiseScale:
        """Return the scale after one displacement; unchanged if it has no innovation."""
        if not math.isfinite(result.nis):
            return self
        ratio = (result.nis / (TARGET_NIS * result.dof)) ** 2
        excess = 1.0 - 2.0 / (ratio + 1.0)
        log_factor = self.log_factor + self.gain * excess
        gain = max(1.0 / (1.0 / self.gain + 1.0), GAIN)  # 1/5, 1/6, 1/7, ...
        return AccelNoiseScale(min(max(log_factor, 0.0), math.log(MAX_FACTOR)), gain)
