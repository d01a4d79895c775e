"""Frame transforms: shift and turn from a track's own frame to that of the fixes; the map's state.

In the terms of ROS REP 105, the track starts in an `odom` frame of its own and a transform takes it
to `map`. The uncertainty of a transform is added to the covariance of the states before it as if
the two were independent; this is conservative, since the transform contains the track's errors too.
A turn holds for the track's yaw at the time of the fix: for an earlier state, the variance of the
yaw drift since, including turns during gaps, is added as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.jacobians import CORE, POSITION
from stario.fusion.filter.planar_alignment import PlanarAlignment, without_yaw
from stario.fusion.values.fixes import Fix
from stario.fusion.values.lie import UNKNOWN_YAW, e3_cross
from stario.fusion.values.state import NavState, changed
from stario.sequences.sequence import FloatArray

_HORIZONTAL = np.diag([1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class FrameTransform:
    """The transform p <- R p + shift.

    Attributes:
        R: (3, 3) rotation about the vertical.
        shift: (3,) translation [m].
        pivot: (3,) point of the new frame that an error of the turn leaves in place [m].
        is_shift: whether it is a shift by a position fix rather than a turn.
        since: states before this time [s] are not transformed: they are in the map already.
        until: states from this time [s] on are not transformed either.
        yaw_sigma: standard deviation of the turn [rad].
        drift: variance of the track's own yaw at that time [rad^2].
        by_yaw: (3,) part of the position's error at the time of a shift, per yaw error [m].
        position_drift: (3, 3) covariance of the rest of that error [m^2].
        position_covariance: (3, 3) covariance of the shift [m^2].
    """

    R: FloatArray
    shift: FloatArray
    pivot: FloatArray
    is_shift: bool
    since: float
    until: float = math.inf
    yaw_sigma: float = 0.0
    drift: float = 0.0
    by_yaw: FloatArray = field(default_factory=lambda: np.zeros(3))
    position_drift: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    position_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))

    def state(self, state: NavState) -> NavState:
        """Return a state of the frame before, in the new one."""
        if not self.since <= state.time < self.until:
            return changed(state, map_frame=state.map_frame + 1)
        v_W, p_W = self.R @ state.v_W, self.R @ state.p_W + self.shift
        A = frame_rotation(self.R)
        # A shift takes the error at its own time out of the positions: that of the common yaw, too.
        A[POSITION, 2] = -self.by_yaw
        covariance = A @ state.covariance @ A.T
        yaw_since = max(0.0, self.drift - state.covariance[2, 2])
        if self.is_shift:
            drift = self.position_drift - without_yaw(state.covariance, POSITION)
            covariance[POSITION, POSITION] += self.position_covariance + _positive_part(drift)
            covariance[POSITION, POSITION] += yaw_since * np.outer(self.by_yaw, self.by_yaw)
        else:
            variance = self.yaw_sigma**2 + yaw_since
            covariance += _turn_covariance(variance, v_W, p_W - self.pivot)
        return changed(
            state,
            R_WB=self.R @ state.R_WB,
            v_W=v_W,
            p_W=p_W,
            covariance=covariance,
            map_frame=state.map_frame + 1,
        )


def turned_with(turn: FrameTransform, stretch: FrameTransform) -> FrameTransform:
    """Return the same turn of another stretch, about that one's pivot."""
    pivot, since, until = stretch.pivot, stretch.since, stretch.until
    return changed(turn, shift=pivot - turn.R @ pivot, pivot=pivot, since=since, until=until)


def _positive_part(P: FloatArray) -> FloatArray:
    """Return a symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(P)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def frame_rotation(R: FloatArray) -> FloatArray:
    """Return the matrix (15, 15) that rotates plain errors with the frame by R (3, 3)."""
    A = np.eye(CORE)
    for first in (0, 3, 6):
        A[first : first + 3, first : first + 3] = R
    return A


def unknown_yaw(pivot: FloatArray, since: float, until: float) -> FrameTransform:
    """Return a transform that keeps a stretch in place but makes its yaw about a pivot unknown."""
    zero = np.zeros(3)
    return FrameTransform(np.eye(3), zero, pivot, False, since, until, yaw_sigma=UNKNOWN_YAW)


class Jump(NamedTuple):
    """Positions in a row that proved the track wrong and moved it.

    Where the device was carried, as in a vehicle, displacements and rest are relative to something
    that moved, from the last position that agreed to the first of those: only the IMU links both.
    """

    since: float
    """Time of the last position that agreed with the track [s]; minus infinity if none has."""
    until: float
    """Time of the first position that moved it [s]."""
    metres: float
    """By how far the track was moved [m]."""
    carried: bool
    """Whether the way between both positions, whatever its direction, is not as long as the track
    and a vehicle may have taken it in that time."""


@dataclass(frozen=True, eq=False)
class MapFrameState:
    """State of the map frame.

    Attributes:
        position_known: whether the track's position in it is known.
        yaw_known: whether the track's yaw in it is known.
        transforms: frame transforms so far, which bring earlier states to the current frame.
        pivot: (3,) point about which the track may be turned [m].
        since: time before which the next transforms leave the track as it is [s].
        pivot_variance: variance of the position that placed it, summed over x and y [m^2].
        alignment: positions since it was placed, relative to the pivot, while its yaw is unknown.
        mismatches: times [s] of the latest positions in a row whose distance from the pivot differs
            from the track's.
        agreed: time [s] and place (3,) [m] of the latest position that agreed with the track.
        outliers: times [s] and residuals (3,) [m] of the latest positions if they were outliers.
        earlier_stretches: yaw uncertainty of stretches that were placed before a jump and will be
            turned with the rest, each about its own pivot.
        earlier_unknown_yaws: yaw uncertainty of stretches that were placed before a gap and never
            turned, applied once the frame's yaw is known.
        jumps: where the track, not the positions, proved to be wrong, in order.
        yaw_variance: variance of the track's own yaw when it was placed [rad^2].
        since_jump: number of positions since the last jump.
        yaw_offset_unknown: whether the track's covariance does not know that its yaw is not the
            map's: that of the start, zero without a pose, or one that has proved to be wrong.
    """

    position_known: bool
    yaw_known: bool
    transforms: tuple[FrameTransform, ...] = ()
    pivot: FloatArray = field(default_factory=lambda: np.zeros(3))
    since: float = -math.inf
    pivot_variance: float = math.inf
    alignment: PlanarAlignment = field(default_factory=PlanarAlignment)
    mismatches: tuple[float, ...] = ()
    agreed: tuple[float, FloatArray] = field(default_factory=lambda: (-math.inf, np.zeros(3)))
    outliers: tuple[tuple[float, FloatArray], ...] = ()
    earlier_stretches: tuple[FrameTransform, ...] = ()
    earlier_unknown_yaws: tuple[FrameTransform, ...] = ()
    jumps: tuple[Jump, ...] = ()
    yaw_variance: float = 0.0
    yaw_offset_unknown: bool = False
    since_jump: float = math.inf

    @property
    def unknown_yaws(self) -> tuple[FrameTransform, ...]:
        """Yaw uncertainty in the map of stretches that were placed and not yet turned."""
        if self.yaw_known:
            return ()
        # A track that fixes have never moved keeps its own frame, in which its first yaw is zero.
        if not (self.yaw_offset_unknown and (self.position_known or self.transforms)):
            return self.earlier_unknown_yaws
        return (*self.earlier_unknown_yaws, *self.stretches(math.inf))

    def stretches(self, until: float) -> tuple[FrameTransform, ...]:
        """Return the yaw uncertainty of the stretches with one unknown yaw, the last until then."""
        return (*self.earlier_stretches, unknown_yaw(self.pivot, self.since, until))

    def holds(self, fix: Fix) -> bool:
        """Return whether a fix holds for the track in its final frame.

        Of a stretch whose yaw in the map has never become known, only the position that placed it
        does: others would bend the track to lie in an arbitrary direction.
        """
        stretches = (
            each
            for each in (*self.unknown_yaws, *self.transforms)
            if each.yaw_sigma >= UNKNOWN_YAW and each.since <= fix.time < each.until
        )
        return all(np.array_equal(fix.value, each.pivot) for each in stretches)


def _turn_moments(variance: float) -> tuple[float, float, float]:
    """Return second moments of a turn by a normally distributed angle t of any variance.

    Returns:
        E sin^2 t, E (1 - cos t)^2 and E t sin t: variances across and along an arm of unit length,
        and covariance of t with the former. For a small variance: the variance, 0, the variance.
    """
    cos_1, cos_2 = math.exp(-0.5 * variance), math.exp(-2.0 * variance)
    return 0.5 * (1.0 - cos_2), 1.0 - 2.0 * cos_1 + 0.5 * (1.0 + cos_2), variance * cos_1


def _turn_covariance(variance: float, v_W: FloatArray, arm: FloatArray) -> FloatArray:
    """Return the covariance (15, 15) of a state due to a turn; the arm (3,) is from the pivot."""
    across, along, with_angle = _turn_moments(variance)
    columns = np.zeros((15, 2))  # columns: across and along
    columns[3:6, 0], columns[6:9, 0] = e3_cross(v_W), e3_cross(arm)
    columns[3:6, 1], columns[6:9, 1] = _HORIZONTAL @ v_W, _HORIZONTAL @ arm
    covariance = columns @ np.diag([across, along]) @ columns.T
    covariance[2, 2] = variance
    covariance[2] += with_angle * columns[:, 0]
    covariance[:, 2] += with_angle * columns[:, 0]
    return covariance


def to_final_frame(
    states: Iterable[NavState], transforms: Sequence[FrameTransform]
) -> list[NavState]:
    """Return the states of a track in its final frame, by the transforms after each of them."""

    def moved(state: NavState) -> NavState:
        for transform in transforms[state.map_frame :]:
            state = transform.state(state)
        return state

    return [moved(state) for state in states]


def with_unknown_yaws(states: list[NavState], yaws: Sequence[FrameTransform]) -> list[NavState]:
    """Return the states of a track with the yaw uncertainty of stretches without a direction.

    The filter keeps the arbitrary yaw of such a stretch as if it were known, so that the first fix
    that determines it turns the track exactly; those who read the states must know better.
    """
    for stretch in yaws:
        states = [changed(stretch.state(s), map_frame=s.map_frame) for s in states]
    return states
