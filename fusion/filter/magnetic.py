"""The magnetic field's bearing as a measurement of what yaw does, never of what it is.

README.md, "Magnetometer". Where the field points in the world is unknown, and indoors it wanders:

    azimuth = c + g,   c constant and unknown at first, g Gauss-Markov over metres and seconds

The bearing of R_WB (m_B - h), with the sensor's hard iron h, measures it. Yaw and azimuth turn
together unseen, so that yaw stays as unobservable as it was; its rate, the gyroscope's vertical
bias, does not. Steel that turns the field changes its size and dip as well: how much these vary
along the way says how far the azimuth wanders there. A field whose size or dip is not the place's
usual counts for less, so does one that the device has carried on by its own gyroscope instead of
measuring it, and one that contradicts the rest is an outlier as any other. Only where a declination
is given it says once where north is, as a fix of yaw.

The field is slow and its errors alike for metres: two bearings a second are all there is to learn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.changed import changed
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState, FieldState, gauss_markov
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.fixes import Fix, yaw_fix
from stario.fusion.lie import yaw_twist
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.inspection.magnetic import HELD_CHANGE
from stario.sequences.sequence import FloatArray

PERIOD = 0.5
"""Between two bearings [s]."""

WANDER_SIGMA = 0.4
"""Of g, the field's azimuth about its mean, at most [rad]: buildings turn it by 5 to 30 degrees."""

_MIN_WANDER_SIGMA = 0.1
"""The same in a field that hardly varies [rad]."""

_WANDER_PER_SPREAD = 2.0
"""Radians of g per unit of `MagneticReference.spread`: 1 to 2 by the true attitude of OxIOD, RIDI,
KIPD and tyrex."""

WANDER_METRES, WANDER_SECONDS = 5.0, 60.0
"""Over which g is forgotten: the reach of a beam or a radiator, and of what else changes."""

HARD_IRON_SIGMA = 10.0
"""Of a phone's own field as its calibration leaves it, per axis [uT]."""

BEARING_SIGMA = 0.3
"""White noise of one bearing [rad] where g wanders by `WANDER_SIGMA`, else in proportion: steel
within a step, late samples while the device turns."""

_FIRST_AZIMUTH_SIGMA = math.pi
"""Standard deviation of c at first [rad]."""

_GATE = 0.95
"""Probability of the bearing's chi-square test: outliers are common, so they weigh down early."""

_MIN_HORIZONTAL = 4.0
"""Horizontal field [uT] below which its bearing means nothing."""

_SIZE_TOLERANCE, _DIP_TOLERANCE = 0.05, 0.05
"""Deviations from the place's usual size (share) and dip [rad] that double the variance."""

NORTH_SIGMA = 0.1
"""Of the direction that magnetic north has on the average where somebody walks [rad]."""

_MIN_NORTH_COUNT = 20
"""Bearings from which on north is told: those of ten seconds."""

_AVERAGING_COUNT = 120
"""Bearings that make the place's usual size, dip and spread: a minute of them."""

_FIRST_SPREAD, _FIRST_COUNT = 0.2, 20
"""Spread before anything is known, and as how many bearings it counts: as in a building."""

_HELD_FACTOR = 10.0
"""On the variance of a field that the device has carried on by its own gyroscope."""

_MIN_SPEED = 0.3
"""Speed below which the spread is not looked at [m/s]: in one spot the field is always quiet."""


@dataclass(frozen=True)
class MagneticReference:
    """What the field usually is, and when it was last looked at.

    Attributes:
        time: of the last bearing [s].
        count: of bearings so far.
        size: usual size of the field [uT].
        dip: usual angle below the horizontal [rad].
        spread: mean distance of size (as a share) and dip [rad] from the usual, where one walked.
        walked: bearings that it is the mean of.
        measured: size of the last field, hard iron and all [uT].
    """

    time: float = -math.inf
    count: int = 0
    size: float = 0.0
    dip: float = 0.0
    spread: float = _FIRST_SPREAD
    moving_count: int = 0
    measured: float = 0.0

    @property
    def wander_sigma(self) -> float:
        """Of the azimuth about its mean, by how much size and dip vary [rad]."""
        return min(max(_WANDER_PER_SPREAD * self.spread, _MIN_WANDER_SIGMA), WANDER_SIGMA)

    @property
    def bearing_sigma(self) -> float:
        """White noise of a bearing in a field of usual size and dip [rad]."""
        return BEARING_SIGMA * self.wander_sigma / WANDER_SIGMA

    def is_held(self, measured: float) -> bool:
        """Whether a field of this size [uT] is the last one, carried on by the device itself."""
        return abs(measured - self.measured) < HELD_CHANGE * measured

    def is_due(self, time: float) -> bool:
        """Whether a bearing may be taken in."""
        return time - self.time > PERIOD - 1e-6

    def updated(self, time: float, size: float, dip: float, new_place: bool) -> MagneticReference:
        """With one more bearing: means of what is clipped to near them, as robust as medians.

        Args:
            time: of the bearing [s].
            size: of the field [uT].
            dip: angle below the horizontal [rad].
            new_place: whether the field was newly measured, and while moving.
        """
        count = self.count + 1
        if count == 1:
            return changed(self, time=time, count=1, size=size, dip=dip)
        share = 1.0 / min(count, _AVERAGING_COUNT)
        size_clip = 2.0 * _SIZE_TOLERANCE * self.size
        usual_size = self.size + share * min(max(size - self.size, -size_clip), size_clip)
        dip_change = min(max(dip - self.dip, -2.0 * _DIP_TOLERANCE), 2.0 * _DIP_TOLERANCE)
        usual_dip = self.dip + share * dip_change
        means = changed(self, time=time, count=count, size=usual_size, dip=usual_dip)
        if not new_place:
            return means
        distance = min(math.hypot(size / usual_size - 1.0, dip - usual_dip), 1.0)
        moving_count = self.moving_count + 1
        gain = 1.0 / min(moving_count + _FIRST_COUNT, _AVERAGING_COUNT)
        return changed(
            means, spread=self.spread + gain * (distance - self.spread), moving_count=moving_count
        )


def north_fix(s: EkfState, reference: MagneticReference, declination: float) -> Fix | None:
    """The yaw of now in a frame with x east and y north; None where it is not known yet.

    Magnetic north lies at pi/2 - declination there, and at c in the filter's world.

    Args:
        s: the filter's state.
        reference: of the field so far.
        declination: of magnetic from true north, positive east [rad].
    """
    yaw = yaw_twist(s.R_WB)
    if s.field is None or reference.count < _MIN_NORTH_COUNT or not math.isfinite(yaw):
        return None
    c, P = s.first_field, s.P
    variance = P[2, 2] + P[c, c] - 2.0 * P[2, c]
    turn = math.pi / 2.0 - declination - s.field.azimuth
    sigma = math.sqrt(max(variance, 0.0) + NORTH_SIGMA**2)
    return yaw_fix(s.time, math.remainder(yaw + turn, 2.0 * math.pi), sigma)


def first_field(s: EkfState, m_B: FloatArray) -> EkfState:
    """The state with an azimuth that is as the first field (3,) [uT] points, and unknown."""
    x, y, _ = s.R_WB @ m_B
    variances = [_FIRST_AZIMUTH_SIGMA**2, WANDER_SIGMA**2, *[HARD_IRON_SIGMA**2] * 3]
    n = len(s.P)
    P = np.zeros((n + len(variances),) * 2)
    P[:n, :n], P[n:, n:] = s.P, np.diag(variances)
    return changed(s, P=P, field=FieldState(math.atan2(y, x), 0.0, np.zeros(3)))


def propagated_field(s: EkfState, seconds: float, sigma: float) -> EkfState:
    """The state after the azimuth has wandered for a time [s] at the speed of now.

    Args:
        s: before.
        seconds: [s].
        sigma: of the azimuth about its mean [rad].
    """
    assert s.field is not None  # there is one since `first_field`
    metres = seconds * math.hypot(s.v_W[0], s.v_W[1])
    kept = math.exp(-metres / WANDER_METRES - seconds / WANDER_SECONDS)
    P = gauss_markov(s.P, s.first_field + 1, kept, sigma)
    return changed(s, P=P, field=changed(s.field, wander=kept * s.field.wander))


def update_bearing(
    ekf: StateCloningEkf, reference: MagneticReference, m_B: FloatArray
) -> tuple[UpdateResult, MagneticReference]:
    """Take in the field (3,) [uT] in B at the filter's time.

    Returns:
        what became of it, and what the field usually is with it.
    """
    now, measured = ekf.state.time, float(np.linalg.norm(m_B))
    if ekf.state.field is None:
        ekf.state = first_field(ekf.state, m_B)
    elif math.isfinite(reference.time):
        ekf.state = propagated_field(ekf.state, now - reference.time, reference.wander_sigma)
    s = ekf.state
    assert s.field is not None
    m_W = s.R_WB @ (m_B - s.field.hard_iron_B)
    horizontal = math.hypot(m_W[0], m_W[1])
    size, dip = math.hypot(horizontal, m_W[2]), math.atan2(-m_W[2], horizontal)
    if horizontal < _MIN_HORIZONTAL:
        return UpdateResult(math.nan, 1, False, reason="no horizontal field"), changed(
            reference, time=now
        )
    held = reference.is_held(measured)
    new_place = not held and math.hypot(s.v_W[0], s.v_W[1]) > _MIN_SPEED
    reference = changed(reference.updated(now, size, dip, new_place), measured=measured)
    unusual = math.hypot(
        (size / reference.size - 1.0) / _SIZE_TOLERANCE, (dip - reference.dip) / _DIP_TOLERANCE
    )
    variance = reference.bearing_sigma**2 * (1.0 + unusual**2) * (_HELD_FACTOR if held else 1.0)
    return ekf.update_bearing(m_B, variance, chi2_quantile(_GATE, 1)), reference
