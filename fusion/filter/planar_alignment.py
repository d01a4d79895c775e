"""Direction of a track from several position fixes together, while it is still unknown.

A single position far enough from the first determines the direction. In a room none is, but several
suffice: with track t_k and fixes f_k as complex numbers, each of variance s_k^2 per axis (that of
the fix and of the track's drift since),

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
    """Weighted sums over positions, relative to a nearby point.

    Attributes:
        sums: (8,) weighted sums over the positions: 1; t (2); f (2); conj(t) f (2); |t|^2.
        count: number of positions.
        drift: variance of the track's position at the last fix [m^2].
    """

    sums: FloatArray = field(default_factory=lambda: np.zeros(8))
    count: int = 0
    drift: float = 0.0

    def with_position(
        self, track: FloatArray, fix: FloatArray, variance: float, drift: float
    ) -> PlanarAlignment:
        """Return the alignment with one more position.

        Args:
            track: (2,) position according to the track [m].
            fix: (2,) position according to the fix [m].
            variance: variance of the fix, per axis [m^2].
            drift: variance of the track's current position, without the yaw's part [m^2].
        """
        (a, b), (c, d) = track, fix
        row = np.array([1.0, a, b, c, d, a * c + b * d, a * d - b * c, a * a + b * b])
        mean_variance = self.count / self.sums[0] if self.count else 1.0
        discount = mean_variance / (mean_variance + max(0.0, drift - self.drift))
        return PlanarAlignment(discount * self.sums + row / variance, self.count + 1, drift)

    @property
    def turn(self) -> tuple[float, float]:
        """Turn from the track to the fixes and its sigma [rad]; infinite sigma: unknown."""
        weight, a, b, c, d, along, across, size = self.sums
        if weight == 0.0:
            return 0.0, math.inf
        along -= (a * c + b * d) / weight
        across -= (a * d - b * c) / weight
        # Noise inflates both the fixes' and the track's spread: use the smaller.
        modulus = min(math.hypot(along, across), size - (a * a + b * b) / weight)
        return math.atan2(across, along), 1.0 / math.sqrt(modulus) if modulus > 0.0 else math.inf
