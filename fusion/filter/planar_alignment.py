"""Direction of a track from one fix, or from several position fixes together.

A single position far enough from the first determines the direction. In a room none is, but several
suffice, by the weighted fit of a turn and a shift in the plane (README.md, "Fixes").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stario.fusion.values.fixes import Fix
from stario.fusion.values.lie import yaw_twist
from stario.fusion.values.state import NavState
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

    def moved_on(self, drift: float) -> PlanarAlignment:
        """Return the alignment for a track that an unknown shift follows, in the same direction.

        What the positions so far tell relative to their mean remains.

        Args:
            drift: variance of the track's position now [m^2].
        """
        along, across, size = self._about_mean
        return PlanarAlignment(np.array([0.0] * 5 + [along, across, size]), 0, drift)

    @property
    def _about_mean(self) -> tuple[float, float, float]:
        """The last three sums about the means of t and f instead."""
        weight, a, b, c, d, along, across, size = self.sums
        weight = max(weight, np.finfo(float).tiny)
        means = a * c + b * d, a * d - b * c, a * a + b * b
        return along - means[0] / weight, across - means[1] / weight, size - means[2] / weight

    @property
    def turn(self) -> tuple[float, float]:
        """Turn from the track to the fixes and its sigma [rad]; infinite sigma: unknown."""
        along, across, size = self._about_mean
        # Noise inflates both the fixes' and the track's spread: use the smaller.
        modulus = min(math.hypot(along, across), size)
        return math.atan2(across, along), 1.0 / math.sqrt(modulus) if modulus > 0.0 else math.inf


def turn_from_fix(state: NavState, pivot: FloatArray, fix: Fix) -> tuple[float, float]:
    """Return the frame's turn about the pivot according to a fix, and its sigma [rad]."""
    if fix.kind == "yaw":
        turn = math.remainder(float(fix.value[0]) - yaw_twist(state.R_WB), 2.0 * math.pi)
        return turn, math.sqrt(fix.covariance[0, 0])
    first, measured, estimated = 3, fix.value, state.v_W
    if fix.kind == "position":
        first, measured, estimated = 6, fix.value - pivot, state.p_W - pivot
    arm = min(math.hypot(measured[0], measured[1]), math.hypot(estimated[0], estimated[1]))
    turn = math.atan2(measured[1], measured[0]) - math.atan2(estimated[1], estimated[0])
    return turn, plane_sigma(state, first, fix) / arm if arm > 0.0 else math.inf


def plane_sigma(state: NavState, first: int, fix: Fix) -> float:
    """Return the largest horizontal sigma of a fix minus two rows of the state, without yaw."""
    P = without_yaw(state.covariance, slice(first, first + 2)) + fix.covariance[:2, :2]
    return math.sqrt(float(np.linalg.eigvalsh(P)[-1]))


def without_yaw(P: FloatArray, rows: slice) -> FloatArray:
    """Return the covariance of some rows without yaw's part, which the fixes determine."""
    by_yaw = P[rows, 2]
    return np.asarray(P[rows, rows] - np.outer(by_yaw, by_yaw) / P[2, 2])
