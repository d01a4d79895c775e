"""Check of the direction of a network's displacements against the accelerometer.

Ground truth without attitude cannot reveal a wrong direction: after a fit in yaw, a track walked
backwards looks the same. The mean velocities of two consecutive seconds differ by a_k, the integral
of w(t) a(t), where w rises from 0 to 1 and falls again and a is the specific force without gravity;
the network's displacements d must differ by the same. With horizontal vectors as complex numbers,
the angle of sum conj(d_k+2 - d_k) (a_k + a_k+1) is the yaw from the network's direction to the
accelerometer's. Differences span two seconds because a walk sways with its steps from one second to
the next: a network that predicts the sway correctly but walks backwards passes a check over one
second. Bias and tilt errors hardly change within 20 s and are removed with the mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stario.sequences.sequence import FloatArray
from stario.sequences.windows import VELOCITY_WEIGHTS

_STRETCH_S = 20

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Direction:
    """Sums over changes of velocity; the sums of several stretches can be added.

    Attributes:
        product: sum of the network's conjugate changes times the accelerometer's [m^2/s^2].
        network: sum of squares of the network's changes [m^2/s^2].
        accelerometer: sum of squares of the accelerometer's changes [m^2/s^2].
        count: number of changes that do not overlap.
    """

    product: complex = 0.0
    network: float = 0.0
    accelerometer: float = 0.0
    count: float = 0.0

    def __add__(self, other: Direction) -> Direction:
        return Direction(
            self.product + other.product,
            self.network + other.network,
            self.accelerometer + other.accelerometer,
            self.count + other.count,
        )

    @property
    def turn(self) -> float:
        """Yaw from the network's direction to the accelerometer's [rad]; NaN without motion."""
        return math.atan2(self.product.imag, self.product.real) if self.product else math.nan

    @property
    def sigma(self) -> float:
        """Standard deviation of `turn` [rad], as of a slope given its coherence; maximum pi.

        The coherence of n pairs that have nothing in common is 1 / n in the mean, not 0: without
        this share, a few seconds without a turn would give a direction that nothing has measured.
        """
        both = self.network * self.accelerometer
        if self.count <= 1.0 or not both:
            return math.pi
        coherence = abs(self.product) ** 2 / both
        common = (self.count * coherence - 1.0) / (self.count - 1.0)
        if common <= 0.0:
            return math.pi
        return min(math.pi, math.sqrt(max(0.0, 1.0 - common) / (2.0 * common * self.count)))


def weighted_force(windows_N: NDArray[np.float32]) -> Complex:
    """Return (M, 2): the horizontal force of windows (M, 6, 200), rising and falling weights."""
    force = windows_N[:, 3].astype(np.float64) + 1j * windows_N[:, 4].astype(np.float64)
    return np.column_stack([force @ VELOCITY_WEIGHTS, force @ VELOCITY_WEIGHTS[::-1]])


def direction(weighted: Complex, displacement_N: FloatArray, per_second: int) -> Direction:
    """Compare the direction of displacements along an unbroken stretch with the accelerometer's.

    Args:
        weighted: (M, 2) of successive windows, as `weighted_force`.
        displacement_N: (M, 3) displacements over these windows [m].
        per_second: number of windows that begin within a second.
    """
    if len(weighted) <= 3 * per_second:
        return Direction()
    change = weighted[:-per_second, 0] + weighted[per_second:, 1]
    moved = displacement_N[:, 0] + 1j * displacement_N[:, 1]
    a = _without_slow(change[:-per_second] + change[per_second:], _STRETCH_S * per_second)
    d = _without_slow(moved[2 * per_second :] - moved[: -2 * per_second], _STRETCH_S * per_second)
    count = len(d) / (3.0 * per_second)  # a change spans three seconds
    return Direction(complex(np.vdot(d, a)), _square(d), _square(a), count)


def _without_slow(changes: Complex, count: int) -> Complex:
    """Return the changes minus the mean of each `count` of them."""
    parts = np.array_split(changes, max(1, len(changes) // count))
    return np.concatenate([part - part.mean() for part in parts])


def _square(values: Complex) -> float:
    return float(np.vdot(values, values).real)
