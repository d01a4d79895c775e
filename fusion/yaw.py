"""Yaw of an attitude: the twist about the vertical, defined at any tilt but upside down.

The rotation R is split into a tilt and a turn about z; the turn's angle is atan2(s, c) with
s = R10 - R01 and c = R00 + R11 (README.md, "Frames"). `sequences.rotations.yaw_of` is the same for
many attitudes at once.
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.lie import FloatArray

_UPSIDE_DOWN = 0.01
"""s^2 + c^2 = (1 + cos tilt)^2 below which yaw means nothing: within 26 degrees of upside down."""


def twist(R: FloatArray) -> tuple[float, float]:
    """S and c: sine and cosine of the yaw of R (3, 3), times 1 + cos tilt."""
    return float(R[1, 0] - R[0, 1]), float(R[0, 0] + R[1, 1])


def yaw_twist(R_WB: FloatArray) -> float:
    """Yaw [rad] of an attitude (3, 3); not-a-number close to upside down."""
    s, c = twist(R_WB)
    return math.atan2(s, c) if s * s + c * c > _UPSIDE_DOWN else math.nan


def yaw_rotation(R: FloatArray) -> FloatArray:
    """The turn about the vertical (3, 3) that has the yaw of R; none where R has none."""
    s, c = twist(R)
    norm = math.hypot(s, c)
    s, c = (s / norm, c / norm) if norm > 0.0 else (0.0, 1.0)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
