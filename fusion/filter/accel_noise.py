"""What the accelerometer is worth, estimated while running from the innovations.

README.md, "Noise and the gyroscope's bias". The density that the configuration gives is a prior:
errors of scale, tilt and saturation act like noise, and differ between a phone held in front of the
chest and one in a runner's pocket. What the innovations of displacements tell is a factor on it,
found by stochastic approximation (Robbins and Monro 1951): it rises with each that is larger than
typical and falls with each that is smaller, by at most as much. So it follows their median, and
some false displacements are not taken for a bad accelerometer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stario.fusion.filter.engine import UpdateResult

TARGET_NIS = 0.3
"""NIS per degree of freedom that is aimed at, its median: the network's errors are alike for
seconds, so that honest innovations are smaller than single errors."""

GAIN, FIRST_GAIN = 0.05, 0.2
"""Of the logarithm, per displacement: in the long run, and at first, when nothing is known."""

MAX_FACTOR = 30.0
"""Factor at most: the accelerometer then says no more than that nobody jumps."""

_STEPS = 4
"""Factors given out lie so many to a doubling, so that few different noise models are made."""


@dataclass(frozen=True)
class AccelNoiseScale:
    """How much noisier the accelerometer acts than the configuration says.

    Attributes:
        log_factor: natural logarithm of the factor on its noise density.
        gain: of the next displacement.
    """

    log_factor: float = 0.0
    gain: float = FIRST_GAIN

    @property
    def factor(self) -> float:
        """On the noise density, in steps."""
        return float(2.0 ** (round(_STEPS * self.log_factor / math.log(2.0)) / _STEPS))

    def updated(self, result: UpdateResult) -> AccelNoiseScale:
        """With what one displacement's innovation tells; nothing where there is none."""
        if not math.isfinite(result.nis):
            return self
        ratio = (result.nis / (TARGET_NIS * result.dof)) ** 2
        excess = 1.0 - 2.0 / (ratio + 1.0)
        moved = self.log_factor + self.gain * excess
        gain = max(1.0 / (1.0 / self.gain + 1.0), GAIN)  # 1/5, 1/6, 1/7, ...
        return AccelNoiseScale(min(max(moved, 0.0), math.log(MAX_FACTOR)), gain)
