"""The map frame: shift and turn of the track's own frame to the frame of the fixes.

README.md, "Fixes". A track that starts without a pose sets its first position and first yaw to
zero. The fixes that place and orient it are no small corrections and do not go through the filter's
linearisation: the frame is transformed exactly (and the right-invariant error with it), then the
covariance is inflated as if this shift or turn were unknown, then the fix is an ordinary update.
After a gap in which the direction was lost, and after a ride before it was known, the same applies
to the track from there on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.linalg import norm

from stario.fusion.filter import ekf
from stario.fusion.filter.ekf import Updated
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.frame_transform import (
    FrameTransform,
    Jump,
    MapFrameState,
    turned_with,
)
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import POSITION
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.filter.planar_alignment import (
    PlanarAlignment,
    plane_sigma,
    turn_from_fix,
    without_yaw,
)
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.fixes import Fix
from stario.fusion.values.lie import UNKNOWN_YAW, about_vertical
from stario.fusion.values.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray

MAX_PRIOR_YAW_SIGMA = 0.5
"""A first yaw with a sigma up to this [rad] is kept; a coarser one is replaced by the fixes'."""

MAX_YAW_SIGMA = 1.0
"""A yaw coarser than this [rad] does not determine the direction: it would make the filter
overconfident in a wrong one."""

MAX_POSITION_YAW_SIGMA = 0.3
"""Maximum sigma [rad] of a yaw that two positions determine; half its square, which the
linearisation neglects, is still far smaller (NEES of yaw 1.0 to 1.2 over 40 walks)."""

_OUTLIERS_IN_A_ROW, _SAME_DIRECTION = 3, 0.8
"""Outlier positions in a row whose residuals point the same way (cosine above this) are correct,
and the track is wrong. If the distances of as many positions in a row from the pivot differ from
the track's, the pivot was wrong."""

_POSITIONS_APART = 5
"""If the track jumps again within this many positions, its direction is wrong too."""

_SIGMA_RATIO = 2.0
"""A position whose sigma is smaller by this factor than that of the one that placed the track
places it again."""

_LENGTH_TOLERANCE = 0.5
"""Fraction of the shorter distance by which the network's and the true distance may differ."""

_INFLATION_RATIO, _MAX_SIGMA = 1e3, 1e5
"""Sigma of an unknown shift: this many times the sigma that remains after the measurement, but no
more than this [m], beyond which the covariance keeps no digits for the fix."""

_VEHICLE_ACCEL = 3.0
"""Largest acceleration of a vehicle in which one stands or sits [m/s^2]."""

YAW_UNKNOWN = "yaw not known"
"""Why a position or velocity is refused before the track's direction in the map is known."""

_TOO_FAR = "at a distance that contradicts the track"
"""Why a position is refused then that is nearer to the first one, or further, than the track."""


class Mapped(NamedTuple):
    """A filter's state and that of its map frame."""

    ekf: EkfState
    frame: MapFrameState

    def with_frame(self, **attributes: Any) -> Mapped:
        """Return it with some attributes of the frame replaced."""
        return Mapped(self.ekf, changed(self.frame, **attributes))


def first_frame(prior: PriorPose | None) -> MapFrameState:
    """Return the frame of a track that starts with a prior on its first pose, or without."""
    if prior is None:
        return MapFrameState(position_known=False, yaw_known=False, yaw_offset_unknown=True)
    yaw_known = prior.yaw_sigma <= MAX_PRIOR_YAW_SIGMA
    variance = 2.0 * prior.position_sigma**2
    return MapFrameState(True, yaw_known, pivot=prior.p_W, pivot_variance=variance)


def update_with(fix: Fix, m: Mapped, f: FilterConfig) -> tuple[Mapped, UpdateResult]:
    """Apply a fix at the filter's time."""
    places, transform = False, None
    if fix.kind == "position":
        places, m = _needs_placing(fix, m)
    if not places and m.frame.yaw_known:
        return _updated(fix, m, f)
    alignment = PlanarAlignment()
    if places:
        jump = _jump_after(m.frame.mismatches, fix, m)
        if jump.carried and m.frame.alignment.count > _OUTLIERS_IN_A_ROW:
            m, alignment = _moved_on(jump, m)
        m, transform = _placed(fix, m)
    elif fix.kind == "position" and m.frame.mismatches:
        return m, UpdateResult(_TOO_FAR)
    else:
        m, transform = _oriented(fix, m)
    if transform is None:
        return m, UpdateResult("too coarse" if fix.kind == "yaw" else YAW_UNKNOWN)
    m, result = _updated(fix, m, f)
    if places:
        m = _with_alignment_begun(fix, m, alignment)
    now = m.ekf.nav_state()
    if places:
        known = np.arange(3) < (3 if fix.has_height else 2)
        covariance = now.position_covariance * np.outer(known, known)
        completed = [changed(transform, position_covariance=covariance)]
    else:
        turn = changed(transform, yaw_sigma=math.sqrt(now.covariance[2, 2]))
        completed = [*(turned_with(turn, each) for each in m.frame.earlier_stretches), turn]
        m = m.with_frame(earlier_stretches=())
    return m.with_frame(transforms=(*m.frame.transforms, *completed)), result


def after_gap(m: Mapped) -> MapFrameState:
    """If a gap has lost the yaw, let later fixes place and turn the track from here on."""
    now, s = m.ekf.nav_state(), m.frame
    variance = now.covariance[2, 2] - (0.0 if s.yaw_known else s.yaw_variance)
    if not (s.position_known or s.yaw_known) or variance <= MAX_PRIOR_YAW_SIGMA**2:
        return s
    since = now.time if s.position_known else s.since  # an unplaced track stays in one piece
    earlier_unknown_yaws = s.earlier_unknown_yaws
    if not s.yaw_known:
        earlier_unknown_yaws = (*earlier_unknown_yaws, *s.stretches(now.time))
    return MapFrameState(
        position_known=False,
        yaw_known=False,
        transforms=s.transforms,
        pivot=now.p_W,
        since=since,
        earlier_unknown_yaws=earlier_unknown_yaws,
        jumps=s.jumps,
        # The magnetic field may tell the turn in the gap, but not a yaw never known before.
        yaw_offset_unknown=s.yaw_offset_unknown and not s.yaw_known,
    )


def _needs_placing(fix: Fix, m: Mapped) -> tuple[bool, Mapped]:
    """Return whether a position should place the track: the first, or a much better one later.

    While the yaw is unknown, a position further on hardly determines where the track is; but the
    first may have been bad, which later ones reveal.
    """
    frame = m.frame
    if not frame.position_known or frame.yaw_known:
        return not frame.position_known, m
    if _SIGMA_RATIO**2 * float(np.trace(fix.covariance[:2, :2])) < frame.pivot_variance:
        return True, m
    if not _distance_off(fix, m, frame.pivot):
        return False, m.with_frame(mismatches=(), agreed=(fix.time, frame.pivot))
    mismatches = (*frame.mismatches, fix.time)
    return len(mismatches) >= _OUTLIERS_IN_A_ROW, m.with_frame(mismatches=mismatches)


def _distance_off(fix: Fix, m: Mapped, place: FloatArray) -> float:
    """Return by how much a position is nearer to a place on the track than the track, or further.

    Returns:
        The difference [m], whatever the track's direction; zero within what it may be by itself.
    """
    now = m.ekf.nav_state()
    fix_distance, track_distance = norm((fix.value - place)[:2]), norm((now.p_W - place)[:2])
    tolerance = _LENGTH_TOLERANCE * min(fix_distance, track_distance)
    off = float(abs(fix_distance - track_distance))
    return off if off > 3.0 * plane_sigma(now, 6, fix) + tolerance else 0.0


def _jump_after(times: Sequence[float], fix: Fix, m: Mapped) -> Jump:
    """Return the jump to a position, the last of those at times [s] that contradict the track."""
    since, place = m.frame.agreed
    until, metres = next(iter(times), fix.time), _distance_off(fix, m, place)
    carried = 0.0 < metres <= 0.5 * _VEHICLE_ACCEL * (until - since) ** 2 < math.inf
    return Jump(since, until, metres, carried)


def _moved_on(jump: Jump, m: Mapped) -> tuple[Mapped, PlanarAlignment]:
    """Leave the track where several positions had confirmed it, to be placed after a ride.

    Its direction is the same on both sides: return what the positions so far tell about it, too.
    """
    s, until = m.frame, jump.until
    stretches, jumps = s.stretches(until), (*s.jumps, jump)
    moved = m.with_frame(since=until, earlier_stretches=stretches, jumps=jumps)
    return moved, s.alignment.moved_on(_drift(m))


def _placed(fix: Fix, m: Mapped) -> tuple[Mapped, FrameTransform]:
    now = m.ekf.nav_state()
    P = now.covariance
    # A position without a height leaves the track's own, above the start.
    axes = 3 if fix.has_height else 2
    known = np.arange(3) < axes
    shift = np.where(known, fix.value - now.p_W, 0.0)
    transform = FrameTransform(
        np.eye(3),
        shift,
        now.p_W + shift,
        is_shift=True,
        since=m.frame.since,
        drift=float(P[2, 2]),
        by_yaw=P[POSITION, 2] / P[2, 2],
        position_drift=without_yaw(P, POSITION) * np.outer(known, known),
    )
    variance = np.trace((fix.covariance + now.position_covariance)[:axes, :axes])
    sigma = min(_INFLATION_RATIO * math.sqrt(variance), _MAX_SIGMA)
    shifted = m.ekf.transformed(np.eye(3), transform.shift).with_position_inflated(sigma, axes)
    return Mapped(shifted, changed(m.frame, position_known=True)), transform


def _with_alignment_begun(fix: Fix, m: Mapped, alignment: PlanarAlignment) -> Mapped:
    """Take the position just applied as the pivot about which later fixes turn the track."""
    begun = m.with_frame(
        pivot=fix.value,
        pivot_variance=float(np.trace(fix.covariance[:2, :2])),
        alignment=alignment,
        mismatches=(),
        yaw_variance=float(m.ekf.nav_state().covariance[2, 2]),
    )
    return _with_position_aligned(fix, begun)


def _oriented(fix: Fix, m: Mapped) -> tuple[Mapped, FrameTransform | None]:
    """Turn the frame to a fix; no transform if the fix does not determine the direction."""
    pivot, now = m.frame.pivot, m.ekf.nav_state()
    turn, sigma = turn_from_fix(now, pivot, fix)
    inflation = UNKNOWN_YAW  # the fix itself then measures the turn
    max_sigma = MAX_YAW_SIGMA if fix.kind == "yaw" else MAX_POSITION_YAW_SIGMA
    if not (math.isfinite(turn) and sigma <= max_sigma):
        if fix.kind != "position":
            return m, None
        turn, inflation = m.frame.alignment.turn
        if inflation > MAX_POSITION_YAW_SIGMA:
            return _with_position_aligned(fix, m), None
    R = about_vertical(turn)
    drift = float(now.covariance[2, 2])
    transform = FrameTransform(R, pivot - R @ pivot, pivot, False, m.frame.since, drift=drift)
    turned = m.ekf.transformed(R, transform.shift).with_yaw_inflated(pivot, inflation)
    frame = changed(
        m.frame,
        yaw_known=True,
        transforms=(*m.frame.transforms, *m.frame.earlier_unknown_yaws),
        alignment=PlanarAlignment(),
        earlier_unknown_yaws=(),
    )
    return Mapped(turned, frame), transform


def _with_position_aligned(fix: Fix, m: Mapped) -> Mapped:
    """Add a position to those that determine the direction together."""
    pivot = m.frame.pivot
    track, measured = (m.ekf.p_W - pivot)[:2], (fix.value - pivot)[:2]
    variance = 0.5 * float(np.trace(fix.covariance[:2, :2]))
    aligned = m.frame.alignment.with_position(track, measured, variance, _drift(m))
    return m.with_frame(alignment=aligned)


def _drift(m: Mapped) -> float:
    """Return the variance of the track's position per axis, without the yaw's part [m^2]."""
    P = without_yaw(m.ekf.nav_state().covariance, POSITION)
    return 0.5 * float(np.trace(P[:2, :2]))


def _updated(fix: Fix, m: Mapped, f: FilterConfig) -> tuple[Mapped, UpdateResult]:
    gate = chi2_quantile(f.gate, len(fix.value))
    if fix.kind == "position":
        return _with_position(fix, m, gate)
    after, result = _measured(m.ekf, fix, gate)
    return m._replace(ekf=after), result


def _measured(s: EkfState, fix: Fix, gate: float) -> Updated:
    if fix.kind == "position":
        return ekf.update_position_W(s, fix.value, fix.covariance, gate)
    if fix.kind == "velocity":
        return ekf.update_velocity_W(s, fix.value, fix.covariance, gate)
    return ekf.update_yaw(s, float(fix.value[0]), math.sqrt(fix.covariance[0, 0]), gate)


def _with_position(fix: Fix, before: Mapped, gate: float) -> tuple[Mapped, UpdateResult]:
    """Update with a position; inflate an outlier, but move the track after similar ones."""
    since_jump = before.frame.since_jump + 1
    after, result = _measured(before.ekf, fix, gate)
    residual, agreed = result.residual, before.frame.agreed
    aligned: tuple[tuple[float, FloatArray], ...] = ()
    if residual is not None and result.gated:
        aligned = tuple(
            (time, r)
            for time, r in before.frame.outliers
            if r @ residual > _SAME_DIRECTION * norm(r) * norm(residual)
        )
        aligned = (*aligned, (fix.time, residual))
    elif residual is not None:
        agreed = fix.time, after.p_W
    frame = changed(before.frame, since_jump=since_jump, outliers=aligned, agreed=agreed)
    if residual is None or len(aligned) < _OUTLIERS_IN_A_ROW:
        return Mapped(after, frame), result
    metres = float(norm(residual))
    jump = _jump_after([time for time, _ in aligned], fix, before)._replace(metres=metres)
    after, result = _measured(before.ekf.with_position_inflated(metres), fix, gate)
    agreed, jumps = (fix.time, after.p_W), (*frame.jumps, jump)
    frame = changed(frame, outliers=(), agreed=agreed, jumps=jumps, since_jump=0)
    m = Mapped(after, frame)
    if since_jump <= _POSITIONS_APART and m.frame.yaw_known:
        # Its direction has proved to be wrong: let later fixes turn the track from here on.
        m = m.with_frame(
            yaw_known=False, since=fix.time, yaw_offset_unknown=True, since_jump=math.inf
        )
        m = _with_alignment_begun(fix, m, PlanarAlignment())
    return m, result
