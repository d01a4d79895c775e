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
from typing import Any

import numpy as np

from stario.fusion.evaluation.benchmark.aligned import Complex
from stario.sequences.levelled_stream import TICK_SECONDS, LevelledStream
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import VELOCITY_WEIGHTS, WINDOW_SECONDS

_STRETCH = round(20.0 / TICK_SECONDS)
_SECOND = round(WINDOW_SECONDS / TICK_SECONDS)


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
        """Standard deviation of `turn` [rad], as of a slope given its coherence; maximum pi."""
        both = self.network * self.accelerometer
        coherence = abs(self.product) ** 2 / both if both else 0.0
        if coherence == 0.0 or self.count < 1.0:
            return math.pi
        return min(math.pi, math.sqrt((1.0 - coherence) / (2.0 * coherence * self.count)))


def direction(stream: LevelledStream, displacement_N: FloatArray) -> Direction:
    """Compare the direction of a network's displacements along a stretch with the accelerometer's.

    Args:
        stream: IMU in N.
        displacement_N: (M, 3) displacements over the second from each tick [m].
    """
    accel_N = stream.windows()[:, 3:5].astype(np.float64)
    if len(accel_N) <= 3 * _SECOND:
        return Direction()
    accel_change = (
        accel_N[:-_SECOND] @ VELOCITY_WEIGHTS + accel_N[_SECOND:] @ VELOCITY_WEIGHTS[::-1]
    )
    accel_change = accel_change[:-_SECOND] + accel_change[_SECOND:]
    network_change = displacement_N[2 * _SECOND :, :2] - displacement_N[: -2 * _SECOND, :2]
    a, d = (_without_slow(v[:, 0] + 1j * v[:, 1]) for v in (accel_change, network_change))
    count = len(d) / (3.0 * _SECOND)  # a change spans three seconds
    return Direction(complex(np.vdot(d, a)), _square(d), _square(a), count)


def _without_slow(changes: Any) -> Complex:
    """Return the changes minus their mean over each 20 s."""
    parts = np.array_split(changes, max(1, len(changes) // _STRETCH))
    return np.concatenate([part - part.mean() for part in parts])


def _square(values: Complex) -> float:
    return float(np.vdot(values, values).real)
