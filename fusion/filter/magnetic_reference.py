"""What is usual for the magnetic field of a place, and whether it turns as the gyroscope says.

README.md, "Magnetometer". How much size and dip vary along the path tells how much the azimuth
does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.state import changed
from stario.sequences.sequence import FloatArray

_PERIOD = 0.5
"""Time between two bearings [s]."""

WANDER_SIGMA = 0.4
"""Maximum sigma of g, the azimuth about its mean [rad]: buildings turn it by 5 to 30 degrees."""

_MIN_WANDER_SIGMA = 0.1
"""Minimum sigma of g, in a field that hardly varies [rad]."""

_WANDER_PER_SPREAD = 2.0
"""Sigma of g per unit of `MagneticReference.spread` [rad]: 1 to 2 according to the true attitude of
OxIOD, RIDI, KIPD and tyrex."""

_SIZE_TOLERANCE, _DIP_TOLERANCE = 0.05, 0.05
"""Deviations from the place's usual size (fraction) and dip [rad] that double the variance."""

_AVERAGING_COUNT = 120
"""Number of bearings that determine the place's usual size, dip and spread: those of a minute."""

_FIRST_SPREAD, _FIRST_COUNT = 0.2, 20
"""Initial spread, as in a building, and the number of bearings it counts as."""

_MIN_ROTATION, _MAX_STEP = 0.2, 1.1
"""Two bearings are compared with the gyroscope if the device has rotated by at least the first
[rad] in at most the second [s]."""

_MAX_UNEXPLAINED = 1.1
"""Change of the field in W beyond which it contradicts the gyroscope, as a fraction of the change
in B that rotation alone causes (sums of squares). Swapped or mirrored axes are at 1 to 5; without
magnets the medians of OxIOD, RIDI, KIPD and tyrex are 0.02 to 0.6, except for two phones that
hardly rotate on the body."""

_ROTATION_MEMORY, _MIN_ROTATIONS = 0.9, 5
"""Weight of earlier rotations relative to the next one, and their number before a verdict."""


@dataclass(frozen=True, eq=False)
class MagneticReference:
    """Usual properties of the field, and its last measurement.

    Attributes:
        time: time of the last bearing [s].
        count: number of bearings so far.
        size: usual size of the field [uT].
        dip: usual angle below the horizontal [rad].
        spread: mean deviation of size (fraction) and dip [rad] from their usual values in motion.
        moving_count: number of bearings averaged in `spread`.
        measured: size of the last measured field, including hard iron [uT].
        before: (3,) last field in B [uT] and (3, 3) attitude R_WB there; None at first.
        rotations: number of rotations between bearings that were compared with the gyroscope.
        unexplained: weighted sum of the field's squared changes in W over them [uT^2].
        explained: likewise of the changes in B that rotation alone would cause [uT^2].
    """

    time: float = -math.inf
    count: int = 0
    size: float = 0.0
    dip: float = 0.0
    spread: float = _FIRST_SPREAD
    moving_count: int = 0
    measured: float = 0.0
    before: tuple[FloatArray, FloatArray] | None = None
    rotations: int = 0
    unexplained: float = 0.0
    explained: float = 0.0

    @property
    def contradicts_gyro(self) -> bool:
        """Whether the field does not rotate against the device as the gyroscope does."""
        return (
            self.rotations >= _MIN_ROTATIONS
            and self.unexplained > _MAX_UNEXPLAINED * self.explained
        )

    def compared(self, s: EkfState, m_B: FloatArray) -> MagneticReference:
        """Return the reference after comparing the change of a field (3,) with the rotation.

        Call it before `updated`, which notes the time.

        Args:
            s: the filter's state at the field's time.
            m_B: (3,) field [uT].
        """
        reference = changed(self, before=(m_B, s.R_WB))
        if self.before is None or s.time - self.time > _MAX_STEP or s.field is None:
            return reference
        (earlier_B, earlier_R), iron = self.before, s.field.hard_iron_B
        rotation = s.R_WB.T @ earlier_R
        if np.trace(rotation) > 1.0 + 2.0 * math.cos(_MIN_ROTATION):
            return reference
        earlier = earlier_B - iron
        by_rotation = rotation @ earlier - earlier
        other = m_B - iron - rotation @ earlier
        return changed(
            reference,
            rotations=self.rotations + 1,
            unexplained=_ROTATION_MEMORY * self.unexplained + float(other @ other),
            explained=_ROTATION_MEMORY * self.explained + float(by_rotation @ by_rotation),
        )

    @property
    def wander_sigma(self) -> float:
        """Sigma of the azimuth about its mean [rad], from the variation of size and dip."""
        return min(max(_WANDER_PER_SPREAD * self.spread, _MIN_WANDER_SIGMA), WANDER_SIGMA)

    def unusual(self, size: float, dip: float) -> float:
        """Return how far a field's size [uT] and dip [rad] are from usual; 1 doubles a variance."""
        return math.hypot(
            (size / self.size - 1.0) / _SIZE_TOLERANCE, (dip - self.dip) / _DIP_TOLERANCE
        )

    def is_due(self, time: float) -> bool:
        """Return whether a bearing may be applied at a time [s]."""
        return time - self.time > _PERIOD - 1e-6

    def updated(self, time: float, size: float, dip: float, new_place: bool) -> MagneticReference:
        """Return the reference after one more bearing: clipped means, as robust as medians.

        Args:
            time: time of the bearing [s].
            size: size of the field [uT].
            dip: angle below the horizontal [rad].
            new_place: whether the field was newly measured while moving.
        """
        count = self.count + 1
        if count == 1:
            return changed(self, time=time, count=1, size=size, dip=dip)
        mean_gain = 1.0 / min(count, _AVERAGING_COUNT)
        size_clip = 2.0 * _SIZE_TOLERANCE * self.size
        usual_size = self.size + mean_gain * min(max(size - self.size, -size_clip), size_clip)
        dip_change = min(max(dip - self.dip, -2.0 * _DIP_TOLERANCE), 2.0 * _DIP_TOLERANCE)
        usual_dip = self.dip + mean_gain * dip_change
        means = changed(self, time=time, count=count, size=usual_size, dip=usual_dip)
        if not new_place:
            return means
        distance = min(math.hypot(size / usual_size - 1.0, dip - usual_dip), 1.0)
        moving_count = self.moving_count + 1
        gain = 1.0 / min(moving_count + _FIRST_COUNT, _AVERAGING_COUNT)
        return changed(
            means, spread=self.spread + gain * (distance - self.spread), moving_count=moving_count
        )
