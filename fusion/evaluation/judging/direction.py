"""Whether a network walks where the accelerometer says that the device moves.

Truth without attitude cannot tell: a track that is fitted in yaw looks the same walked backwards.
The mean velocities of two seconds in a row differ by a_k, the integral of w(t) a(t), w rising from
0 to 1 and falling again, a the specific force without gravity; the network's displacements d must
differ alike. The angle of sum conj(d_k+2 - d_k) (a_k + a_k+1), horizontal vectors as complex
numbers, is what the network is turned by. Over two seconds, because from one to the next a walk
sways with its steps: a network that tells the sway rightly and walks backwards passes there.
Bias and tilt hardly change within 20 s and are taken out by the mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from stario.sequences.levelled_stream import TICK_SECONDS, LevelledStream
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import VELOCITY_WEIGHTS, WINDOW_SECONDS

_STRETCH = round(20.0 / TICK_SECONDS)
_SECOND = round(WINDOW_SECONDS / TICK_SECONDS)

Complex = np.ndarray[Any, np.dtype[np.complex128]]


@dataclass(frozen=True)
class Direction:
    """Sums over changes of velocity; those of several stretches add up.

    Attributes:
        product: of the network's, conjugate, and the accelerometer's [m^2/s^2].
        network: squares of the network's [m^2/s^2].
        accelerometer: squares of the accelerometer's [m^2/s^2].
        count: changes that do not overlap.
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
        """Yaw from the network to the accelerometer [rad]; nan where nothing moves."""
        return math.atan2(self.product.imag, self.product.real) if self.product else math.nan

    @property
    def sigma(self) -> float:
        """Deviation of the turn [rad], as of a slope by its coherence; at most pi."""
        both = self.network * self.accelerometer
        coherence = abs(self.product) ** 2 / both if both else 0.0
        if coherence == 0.0 or self.count < 1.0:
            return math.pi
        return min(math.pi, math.sqrt((1.0 - coherence) / (2.0 * coherence * self.count)))


def direction(stream: LevelledStream, displacement_N: FloatArray) -> Direction:
    """Of a network's answers along a stretch.

    Args:
        stream: the IMU in N.
        displacement_N: (M, 3) over the second from each tick [m].
    """
    accel_N = stream.windows()[:, 3:5].astype(np.float64)
    if len(accel_N) <= 3 * _SECOND:
        return Direction()
    told = accel_N[:-_SECOND] @ VELOCITY_WEIGHTS + accel_N[_SECOND:] @ VELOCITY_WEIGHTS[::-1]
    told = told[:-_SECOND] + told[_SECOND:]
    moved = displacement_N[2 * _SECOND :, :2] - displacement_N[: -2 * _SECOND, :2]
    a, d = (_without_slow(v[:, 0] + 1j * v[:, 1]) for v in (told, moved))
    apart = len(d) / (3.0 * _SECOND)  # a change takes three seconds
    return Direction(complex(np.vdot(d, a)), _square(d), _square(a), apart)


def _without_slow(changes: Any) -> Complex:
    """Less their mean over each 20 s."""
    parts = np.array_split(changes, max(1, len(changes) // _STRETCH))
    return np.concatenate([part - part.mean() for part in parts])


def _square(values: Complex) -> float:
    return float(np.vdot(values, values).real)
