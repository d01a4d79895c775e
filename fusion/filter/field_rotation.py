"""How the magnetic field rotates against the device: its hard iron, and whether its axes are right.

README.md, "Magnetometer". The field in the world is m_W, the hard iron h turns with the device:

    m_B = R_WB' m_W + h,    m' - R m = (I - R) h    for a rotation R from the earlier B to the later

A magnetometer with swapped or mirrored axes does not rotate as the gyroscope says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.values.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray

_MIN_ROTATION, _MAX_STEP = 0.2, 1.1
"""Two fields are compared with the gyroscope if the device has rotated by at least the first [rad]
in at most the second [s]."""

_MAX_UNEXPLAINED = 1.1
"""Change of the field in W beyond which it contradicts the gyroscope, as a fraction of the change
in B that rotation alone causes (sums of squares). Swapped or mirrored axes are at 1 to 5; without
magnets the medians of OxIOD, RIDI, KIPD and tyrex are 0.02 to 0.6, except for two phones that
hardly rotate on the body."""

_CHANGE_SIGMA, _LAG = 5.0, 0.1
"""Sigma per axis of a field's change in the world between two bearings [uT], 1 to 5 in buildings;
and, as a share of its change by rotation, that of fields measured late."""

_ANY_IRON, _IRON_WALK = 300.0, 2.0
"""Sigma per axis of a hard iron that no calibration has removed [uT], and how it walks
[uT/sqrt(s)]: phones calibrate anew as they are carried."""

HARD_IRON_SIGMA, _PROBABILITY = 10.0, 0.999
"""Sigma of the hard iron that a phone's calibration leaves, per axis [uT], and the probability of
the chi-square test by which more than that is left."""

_FREEDOM = 3.0
"""Degrees of freedom of the Student-t distribution of fields' changes: steel is common."""

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
        iron_B: (3,) hard iron that these fields have by their rotation [uT].
        iron_P: (3, 3) its covariance [uT^2].
    """

    before: tuple[FloatArray, FloatArray] | None = None
    count: int = 0
    unexplained: float = 0.0
    explained: float = 0.0
    iron_B: FloatArray = field(default_factory=lambda: np.zeros(3))
    iron_P: FloatArray = field(default_factory=lambda: _ANY_IRON**2 * np.eye(3))

    @property
    def is_uncalibrated(self) -> bool:
        """Whether the hard iron is clearly more than a calibration leaves."""
        S = self.iron_P + HARD_IRON_SIGMA**2 * np.eye(3)
        return float(self.iron_B @ np.linalg.solve(S, self.iron_B)) > chi2_quantile(_PROBABILITY, 3)

    def calibrated(self) -> FieldRotation:
        """Return what is known of fields from which this hard iron is removed."""
        return changed(self, before=None, iron_B=np.zeros(3))

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
        newest = newest._with_iron(earlier_B, rotation, m_B, seconds)
        by_rotation = rotation @ earlier - earlier
        other = m_B - iron - rotation @ earlier
        return changed(
            newest,
            count=self.count + 1,
            unexplained=_MEMORY * self.unexplained + float(other @ other),
            explained=_MEMORY * self.explained + float(by_rotation @ by_rotation),
        )

    def _with_iron(
        self, earlier_B: FloatArray, rotation: FloatArray, m_B: FloatArray, seconds: float
    ) -> FieldRotation:
        """Return the comparison after m' - R m = (I - R) h, weighted by its probability."""
        rotated, H = rotation @ earlier_B, np.eye(3) - rotation
        lag = _LAG * float(np.linalg.norm(rotated - earlier_B))
        P = self.iron_P + _IRON_WALK**2 * seconds * np.eye(3)
        residual = m_B - rotated - H @ self.iron_B
        R = (_CHANGE_SIGMA**2 + lag**2) * np.eye(3)
        nis = float(residual @ np.linalg.solve(H @ P @ H.T + R, residual))
        S = H @ P @ H.T + R * (_FREEDOM + nis) / (_FREEDOM + 3.0)
        K = np.linalg.solve(S, H @ P).T
        return changed(self, iron_B=self.iron_B + K @ residual, iron_P=P - K @ H @ P)
