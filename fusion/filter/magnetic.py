"""Bearing of the magnetic field as a measurement of changes in yaw, never of yaw itself.

README.md, "Magnetometer". The field's direction in the world is unknown, and indoors it wanders:

    azimuth = c + disturbance,   c constant and unknown at first
                            disturbance Gauss-Markov over metres

The bearing of R_WB (m_B - h), with the sensor's hard iron h, measures it; h is Gauss-Markov, too. A
field of unusual size or dip for the place has less weight, as does one that the device has
extrapolated by its own gyroscope; one that contradicts the rest is an outlier like any other. If a
declination is given, and only then, the field determines north once, as a fix of yaw. The field
varies slowly and its errors are correlated over metres: two bearings a second suffice. How much
size and dip vary along the path tells how much the azimuth does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stario.fusion.filter import ekf
from stario.fusion.filter.ekf_state import EkfState, FieldState
from stario.fusion.filter.field_rotation import HARD_IRON_SIGMA, FieldRotation
from stario.fusion.filter.kalman import UpdateResult, gauss_markov
from stario.fusion.imu.intervals import SAME_TIME
from stario.fusion.values.fixes import Fix, yaw_fix
from stario.fusion.values.lie import yaw_twist
from stario.fusion.values.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.inspection.magnetic import HELD_CHANGE
from stario.sequences.sequence import FloatArray

_DISTURBANCE_METRES = 5.0
"""Distance over which the disturbance decorrelates [m]: the reach of a beam or a radiator."""

_ARMS_REACH = 1.0
"""Distance up to which a device is at the same place [m], however it is moved to and fro."""

HARD_IRON_SECONDS = 60.0
"""Time over which a calibration's hard iron decorrelates [s]: phones calibrate their magnetometer
anew as they are carried, so that what it was a minute ago tells little."""

BEARING_SIGMA = 0.3
"""White noise of one bearing [rad] where the disturbance's sigma is at its largest, elsewhere in
proportion: steel within a step's length, late samples while it turns."""

_FIRST_AZIMUTH_SIGMA = math.pi
"""Initial standard deviation of c [rad]."""

_GATE = 0.95
"""Probability of the bearing's chi-square test: outliers are common, so the gate is narrow."""

_MIN_HORIZONTAL = 4.0
"""Horizontal field [uT] below which its bearing is meaningless."""

_WEAKEST, _STRONGEST = 2.0, 1e4
"""Fields [uT] that only one in another unit falls below or exceeds: the Earth's has 22 to 67, and
each axis of a phone's sensor at most 4900."""

NORTH_SIGMA = 0.1
"""Sigma of magnetic north's mean direction along a pedestrian's path [rad]."""

_MIN_NORTH_COUNT = 20
"""Number of bearings before north is determined: those of ten seconds."""

_PERIOD = 0.5
"""Time between two bearings [s]."""

_NEW_PLACE, _NEW_TURN = 0.3, 0.2
"""Distance [m] or rotation [rad] since the last bearing from which on the next one is used."""

DISTURBANCE_SIGMA, _MIN_DISTURBANCE_SIGMA = 0.4, 0.1
"""Sigma of the disturbance, the azimuth about its mean, at most and at least [rad]: buildings turn
it by 5 to 30 degrees."""

_DISTURBANCE_PER_SPREAD = 2.0
"""Sigma of the disturbance per unit of `MagneticReference.spread` [rad]: 1 to 2 by the true
attitude of OxIOD, RIDI, KIPD and tyrex."""

_FIRST_SPREAD, _FIRST_COUNT = 0.2, 20
"""Spread as in a building, and the number of bearings that it counts as."""

_HELD_FACTOR = 10.0
"""Factor on the variance of a field that the device has carried on by its own gyroscope, as in
seven tenths of tyrex' half seconds: its bearing tells little that ours does not."""

_SIZE_TOLERANCE, _DIP_TOLERANCE = 0.05, 0.05
"""Deviations from the place's usual size (fraction) and dip [rad] that double the variance."""

_AVERAGING_COUNT = 120
"""Number of bearings that determine the place's usual size, dip and spread: those of a minute."""


@dataclass(frozen=True, eq=False)
class MagneticReference:
    """Usual properties of the field, and its last measurement.

    Attributes:
        time: time of the last bearing [s].
        count: number of bearings so far.
        size: usual size of the field [uT].
        dip: usual angle below the horizontal [rad].
        spread: mean deviation of size (fraction) and dip [rad] from these along the path.
        places: number of bearings averaged in it.
        measured: size of the last field, with the device's hard iron [uT].
        held: whether the device had carried that field on by its gyroscope: a step after it is the
            field's, which the device had not followed.
        rotation: how the field has changed while the device rotated.
        pose: attitude R_WB (3, 3) and position p_W (3,) [m] at the last bearing.
        place_W: (3,) the place whose disturbance is measured [m].
        offset_B: (3,) hard iron that no calibration has removed; bearings are without it [uT].
    """

    time: float = -math.inf
    count: int = 0
    size: float = 0.0
    dip: float = 0.0
    spread: float = _FIRST_SPREAD
    places: int = _FIRST_COUNT
    measured: float = 0.0
    held: bool = False
    rotation: FieldRotation = field(default_factory=FieldRotation)
    pose: tuple[FloatArray, FloatArray] | None = None
    place_W: FloatArray | None = None
    offset_B: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def disturbance_sigma(self) -> float:
        """Sigma of the azimuth about its mean [rad]: it varies as size and dip do."""
        return min(
            max(_DISTURBANCE_PER_SPREAD * self.spread, _MIN_DISTURBANCE_SIGMA), DISTURBANCE_SIGMA
        )

    def unusual(self, size: float, dip: float) -> float:
        """Return how far a field's size [uT] and dip [rad] are from usual; 1 doubles a variance."""
        return math.hypot(
            (size / self.size - 1.0) / _SIZE_TOLERANCE, (dip - self.dip) / _DIP_TOLERANCE
        )

    def calibrated(self) -> MagneticReference:
        """Return the reference at the start of fields without the hard iron found so far."""
        offset_B = self.offset_B + self.rotation.iron_B
        return MagneticReference(rotation=self.rotation.calibrated(), offset_B=offset_B)

    def is_due(self, time: float, s: EkfState) -> bool:
        """Return whether a bearing may be applied at a time [s] to a state.

        Where the device neither travels nor turns, a bearing tells nothing new about the way: what
        changes there is the field, as in a lift of steel.
        """
        if time - self.time < _PERIOD - SAME_TIME:
            return False
        if self.pose is None:
            return True
        turned = s.R_WB @ self.pose[0].T
        return self.travelled(s) or np.trace(turned) < 1.0 + 2.0 * math.cos(_NEW_TURN)

    def travelled(self, s: EkfState) -> bool:
        """Return whether a state is at another place than the last bearing."""
        return self.pose is not None and math.dist(s.p_W[:2], self.pose[1][:2]) > _NEW_PLACE

    def placed(self, s: EkfState) -> tuple[MagneticReference, float]:
        """Return the reference at a state's place, and its distance from the one before [m].

        The distance is zero until it is out of the reach of an arm: while people shake a phone
        where they stand, its disturbance stays what it is.
        """
        metres = math.inf if self.place_W is None else math.dist(s.p_W[:2], self.place_W[:2])
        if metres <= _ARMS_REACH:
            return self, 0.0
        return changed(self, place_W=s.p_W), metres

    def is_held(self, measured: float) -> bool:
        """Return whether a field (size [uT]) is the last one, carried on by the gyroscope."""
        return abs(measured - self.measured) < HELD_CHANGE * self.measured

    def updated(self, time: float, size: float, dip: float, travelled: bool) -> MagneticReference:
        """Return the reference after one more bearing: clipped means, as robust as medians.

        Args:
            time: time of the bearing [s].
            size: size of the field [uT].
            dip: angle below the horizontal [rad].
            travelled: whether measured at another place than the one before: one alone shows no
                spread, nor does a field that is held.
        """
        count = self.count + 1
        if count == 1:
            return changed(self, time=time, count=1, size=size, dip=dip)
        gain = 1.0 / min(count, _AVERAGING_COUNT)
        clip = 2.0 * _SIZE_TOLERANCE * self.size
        size_change = min(max(size - self.size, -clip), clip)
        dip_change = min(max(dip - self.dip, -2.0 * _DIP_TOLERANCE), 2.0 * _DIP_TOLERANCE)
        usual = self.size + gain * size_change, self.dip + gain * dip_change
        means = changed(self, time=time, count=count, size=usual[0], dip=usual[1])
        if not travelled:
            return means
        deviation = min(math.hypot(size / usual[0] - 1.0, dip - usual[1]), 1.0)
        places = self.places + 1
        spread = self.spread + (deviation - self.spread) / min(places, _AVERAGING_COUNT)
        return changed(means, spread=spread, places=places)


def north_fix(s: EkfState, reference: MagneticReference, declination: float) -> Fix | None:
    """Return the current yaw in a frame with x east and y north; None if it is not known yet.

    Magnetic north lies at pi/2 - declination there, and at c in the filter's world.

    Args:
        s: the filter's state.
        reference: usual properties of the field.
        declination: angle from true to magnetic north, positive east [rad].
    """
    yaw = yaw_twist(s.R_WB)
    if s.field is None or reference.count < _MIN_NORTH_COUNT or not math.isfinite(yaw):
        return None
    c, P = s.field_row, s.P_reported
    variance = P[2, 2] + P[c, c] - 2.0 * P[2, c]
    turn = _turn_to_north(s.field, declination)
    sigma = math.sqrt(max(variance, 0.0) + NORTH_SIGMA**2)
    return yaw_fix(s.time, math.remainder(yaw + turn, 2.0 * math.pi), sigma)


def _turn_to_north(field: FieldState, declination: float) -> float:
    return math.pi / 2.0 - declination - field.azimuth


def north_contradiction(s: EkfState, reference: MagneticReference, declination: float) -> float:
    """Return the angle from magnetic north to the north of a track that is oriented [rad].

    Args:
        s: the filter's state.
        reference: usual properties of the field.
        declination: angle from true to magnetic north, positive east [rad].

    Returns:
        0 if both agree within three sigma, or if magnetic north is not known.
    """
    if s.field is None or reference.count < _MIN_NORTH_COUNT:
        return 0.0
    apart = math.remainder(-_turn_to_north(s.field, declination), 2.0 * math.pi)
    variance = s.P_reported[s.field_row, s.field_row] + NORTH_SIGMA**2
    return apart if apart**2 > 9.0 * variance else 0.0


def with_field(s: EkfState, m_B: FloatArray) -> EkfState:
    """Return the state with an unknown azimuth, initialised by the first field (3,) [uT]."""
    x, y, _ = s.R_WB @ m_B
    variances = [_FIRST_AZIMUTH_SIGMA**2, DISTURBANCE_SIGMA**2, *[HARD_IRON_SIGMA**2] * 3]
    n = s.field_row
    P = np.zeros((2, n + len(variances), n + len(variances)))
    P[:, :n, :n], P[:, n:, n:] = s.covariances, np.diag(variances)
    return changed(s, covariances=P, field=FieldState(math.atan2(y, x), 0.0, np.zeros(3)))


def without_field(s: EkfState) -> EkfState:
    """Return the state without its field, for one that is measured with another hard iron."""
    if s.field is None:
        return s
    n = s.field_row
    return changed(s, covariances=s.covariances[:, :n, :n], field=None)


def propagated_field(s: EkfState, metres: float, seconds: float, sigma: float) -> EkfState:
    """Return the state with its azimuth after a distance [m] and its hard iron after a time [s].

    `sigma` is the standard deviation of the azimuth about its mean [rad].
    """
    assert s.field is not None  # set by `with_field`
    row = s.field_row + 1
    moved = math.exp(-metres / _DISTURBANCE_METRES)
    iron = math.exp(-seconds / HARD_IRON_SECONDS)
    kept = np.array([moved, iron, iron, iron])
    sigmas = np.array([sigma, *[HARD_IRON_SIGMA] * 3])
    P = gauss_markov(s.covariances, slice(row, row + 4), kept, sigmas)
    disturbance, hard_iron_B = moved * s.field.disturbance, iron * s.field.hard_iron_B
    field = changed(s.field, disturbance=disturbance, hard_iron_B=hard_iron_B)
    return changed(s, covariances=P, field=field)


def update_bearing(
    s: EkfState, reference: MagneticReference, m_B: FloatArray
) -> tuple[EkfState, UpdateResult, MagneticReference]:
    """Update with the field (3,) [uT] in B at the state's time; return the reference after it."""
    now, measured = s.time, float(np.linalg.norm(m_B))
    if measured > _STRONGEST:
        return s, UpdateResult("too strong to be in uT"), changed(reference, time=now)
    reference, metres = reference.placed(s)
    if s.field is None:
        s = with_field(s, m_B)
    elif math.isfinite(reference.time):
        s = propagated_field(s, metres, now - reference.time, reference.disturbance_sigma)
    assert s.field is not None
    m_W = s.R_WB @ (m_B - s.field.hard_iron_B)
    horizontal = math.hypot(m_W[0], m_W[1])
    size, dip = math.hypot(horizontal, m_W[2]), math.atan2(-m_W[2], horizontal)
    if horizontal < _MIN_HORIZONTAL:
        reason = "too weak to be in uT" if measured < _WEAKEST else "no horizontal field"
        return s, UpdateResult(reason), changed(reference, time=now)
    rotation = reference.rotation.updated(s, m_B, now - reference.time)
    reference = changed(reference, rotation=rotation)
    if rotation.contradicts_gyro:
        return s, UpdateResult("contradicts the gyroscope"), changed(reference, time=now)
    held = reference.is_held(measured)
    reference = reference.updated(now, size, dip, reference.travelled(s) and not held)
    reference = changed(reference, measured=measured, held=held)
    sigma = BEARING_SIGMA * reference.disturbance_sigma / DISTURBANCE_SIGMA
    variance = sigma**2 * (1.0 + reference.unusual(size, dip) ** 2)
    variance *= _HELD_FACTOR if held else 1.0
    return *ekf.update_bearing(s, m_B, variance, chi2_quantile(_GATE, 1)), reference
