"""Whether the magnetic field rotates against the device as the gyroscope says.

README.md, "Magnetometer". A magnetometer with swapped or mirrored axes does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.values.state import changed
from stario.sequences.sequence import FloatArray

_MIN_ROTATION, _MAX_STEP = 0.2, 1.1
"""Two fields are compared with the gyroscope if the device has rotated by at least the first [rad]
in at most the second [s]."""

_MAX_UNEXPLAINED = 1.1
"""Change of the field in W beyond which it contradicts the gyroscope, as a fraction of the change
in B that rotation alone causes (sums of squares). Swapped or mirrored axes are at 1 to 5; without
magnets the medians of OxIOD, RIDI, KIPD and tyrex are 0.02 to 0.6, except for two phones that
hardly rotate on the body."""

_MEMORY, _MIN_COUNT = 0.9, 5
"""Weight of earlier rotations relative to the next one, and their number before a verdict."""


@dataclass(frozen=True, eq=False)
class FieldRotation:
    """Changes of the field while the device rotated.

    Attributes:
        before: (3,) last field in B [uT] and (3, 3) attitude R_WB there; None at first.
        count: number of rotations from one field to the next that were compared.
        unexplained: weighted sum of the field's squared changes in W over them [uT^2].
        explained: likewise of the changes in B that rotation alone would cause [uT^2].
    """

    before: tuple[FloatArray, FloatArray] | None = None
    count: int = 0
    unexplained: float = 0.0
    explained: float = 0.0

    @property
    def contradicts_gyro(self) -> bool:
        """Whether the field does not rotate against the device as the gyroscope does."""
        return self.count >= _MIN_COUNT and self.unexplained > _MAX_UNEXPLAINED * self.explained

    def updated(self, s: EkfState, m_B: FloatArray, seconds: float) -> FieldRotation:
        """Return the comparison with one more field.

        Args:
            s: the filter's state at the field's time, with its hard iron.
            m_B: (3,) field [uT].
            seconds: time since the last one [s].
        """
        assert s.field is not None
        newest = changed(self, before=(m_B, s.R_WB))
        if self.before is None or seconds > _MAX_STEP:
            return newest
        (earlier_B, earlier_R), iron = self.before, s.field.hard_iron_B
        rotation = s.R_WB.T @ earlier_R
        if np.trace(rotation) > 1.0 + 2.0 * math.cos(_MIN_ROTATION):
            return newest
        earlier = earlier_B - iron
        by_rotation = rotation @ earlier - earlier
        other = m_B - iron - rotation @ earlier
        return changed(
            newest,
            count=self.count + 1,
            unexplained=_MEMORY * self.unexplained + float(other @ other),
            explained=_MEMORY * self.explained + float(by_rotation @ by_rotation),
        )
