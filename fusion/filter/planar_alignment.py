"""Positions that came before the direction was known: what they tell of it together.

One of them tells it where the track has led far enough from the first. In a room it never does, but
several do: track t_k and fixes f_k, each with variance s_k^2 per axis (of the fix, and by what the
track has drifted since), as complex numbers,

    C = sum conj(t_k - t_mean) (f_k - f_mean) / s_k^2      turn = arg C      sigma^2 = 1 / |C|

the weighted fit of a turn and a shift in the plane (README.md, "Fixes").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stario.sequences.sequence import FloatArray


@dataclass(frozen=True, eq=False)
class PlanarAlignment:
    """Sums over positions, counted from a point nearby.

    Attributes:
        sums: (8,) over positions, weighted: 1; t (2); f (2); conj(t) f (2); |t|^2.
        count: of them.
        drift: variance of the track's position at the last of them [m^2].
    """

    sums: FloatArray = field(default_factory=lambda: np.zeros(8))
    count: int = 0
    drift: float = 0.0

    def with_position(
        self, track: FloatArray, fix: FloatArray, variance: float, drift: float
    ) -> PlanarAlignment:
        """With one more.

        Args:
            track: (2,) where the track says it is [m].
            fix: (2,) where the fix says so [m].
            variance: of the fix, per axis [m^2].
            drift: variance of the track's position now, its yaw's part left out [m^2].
        """
        (a, b), (c, d) = track, fix
        row = np.array([1.0, a, b, c, d, a * c + b * d, a * d - b * c, a * a + b * b])
        mean_variance = self.count / self.sums[0] if self.count else 1.0
        discount = mean_variance / (mean_variance + max(0.0, drift - self.drift))
        return PlanarAlignment(discount * self.sums + row / variance, self.count + 1, drift)

    @property
    def turn(self) -> tuple[float, float]:
        """From the track to the fixes, and its standard deviation [rad]; infinite: not known."""
        weight, a, b, c, d, along, across, size = self.sums
        if weight == 0.0:
            return 0.0, math.inf
        along -= (a * c + b * d) / weight
        across -= (a * d - b * c) / weight
        # Noise makes either side look longer than it is.
        modulus = min(math.hypot(along, across), size - (a * a + b * b) / weight)
        return math.atan2(across, along), 1.0 / math.sqrt(modulus) if modulus > 0.0 else math.inf
