"""The map frame: shift and turn of the track's own frame to the frame of the fixes.

README.md, "Fixes". A track that starts without a pose sets its first position and first yaw to
zero. The fixes that place and orient it are no small corrections and do not go through the filter's
linearisation: the frame is transformed exactly (and the right-invariant error with it), then the
covariance is inflated as if this shift or turn were unknown, then the fix is an ordinary update.
After a gap in which the direction was lost, the same applies to the track from there on.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.linalg import norm

from stario.fusion.config import FilterConfig
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.filter.frame_transform import FrameTransform, MapFrameState, unoriented_stretch
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import POSITION
from stario.fusion.filter.network_errors import with_turn
from stario.fusion.filter.planar_alignment import (
    PlanarAlignment,
    plane_sigma,
    turn_from_fix,
    without_yaw,
)
from stario.fusion.fixes import Fix
from stario.fusion.lie import UNKNOWN_YAW, about_vertical
from stario.fusion.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile

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


class MapFrame:
    """Fix updates of a filter, with the transforms of its frame that they require.

    Args:
        ekf: the filter.
        prior: prior on the first pose; None if the track starts without one.
        config: settings of the filter.

    Attributes:
        state: state of the map frame.
    """

    def __init__(self, ekf: StateCloningEkf, prior: PriorPose | None, config: FilterConfig) -> None:
        self.state = MapFrameState(placed=False, oriented=False, arbitrary_yaw=True)
        if prior is not None:
            oriented = prior.yaw_sigma <= MAX_PRIOR_YAW_SIGMA
            variance = 2.0 * prior.position_sigma**2
            self.state = MapFrameState(True, oriented, pivot=prior.p_W, pivot_variance=variance)
        self._ekf, self._config = ekf, config

    def update(self, fix: Fix) -> UpdateResult:
        """Apply a fix at the filter's time."""
        places = fix.kind == "position" and self._needs_placing(fix)
        if places:
            transform: FrameTransform | None = self._place(fix)
        elif self.state.oriented:
            return self._update(fix)
        else:
            doubtful = fix.kind == "position" and self.state.distance_mismatches > 0
            transform = None if doubtful else self._orient(fix)
        if transform is None:
            return UpdateResult("too coarse" if fix.kind == "yaw" else "yaw not known")
        result = self._update(fix)
        if places:
            self._begin_alignment(fix)
        now = self._ekf.state.nav_state()
        if places:
            completed = changed(transform, position_covariance=now.position_covariance)
        else:
            completed = changed(transform, yaw_sigma=math.sqrt(now.covariance[2, 2]))
        self.state = changed(self.state, transforms=(*self.state.transforms, completed))
        return result

    def lose_yaw(self) -> None:
        """If a gap has lost the yaw, let later fixes place and turn the track from here on."""
        now, s = self._ekf.state.nav_state(), self.state
        variance = now.covariance[2, 2] - (0.0 if s.oriented else s.yaw_variance)
        if not (s.placed or s.oriented) or variance <= MAX_PRIOR_YAW_SIGMA**2:
            return
        since = now.time if s.placed else s.since  # an unplaced track stays in one piece
        unoriented = s.unoriented
        if not s.oriented:
            unoriented = (*unoriented, unoriented_stretch(s.pivot, s.since, now.time))
        self.state = MapFrameState(
            placed=False,
            oriented=False,
            transforms=s.transforms,
            pivot=now.p_W,
            since=since,
            unoriented=unoriented,
            jumps=s.jumps,
            # The magnetic field may tell the turn in the gap, but not a yaw never known before.
            arbitrary_yaw=s.arbitrary_yaw and not s.oriented,
        )

    def _needs_placing(self, fix: Fix) -> bool:
        """Return whether a position should place the track: the first, or a much better one later.

        While the yaw is unknown, a position further on hardly determines where the track is; but
        the first may have been bad, which later ones reveal.
        """
        if not self.state.placed or self.state.oriented:
            return not self.state.placed
        if _SIGMA_RATIO**2 * float(np.trace(fix.covariance[:2, :2])) < self.state.pivot_variance:
            return True
        now, pivot = self._ekf.state.nav_state(), self.state.pivot
        fix_distance, track_distance = norm((fix.value - pivot)[:2]), norm((now.p_W - pivot)[:2])
        differs = abs(fix_distance - track_distance) > 3.0 * plane_sigma(
            now, 6, fix
        ) + _LENGTH_TOLERANCE * min(fix_distance, track_distance)
        self.state = changed(
            self.state, distance_mismatches=self.state.distance_mismatches + 1 if differs else 0
        )
        return self.state.distance_mismatches >= _OUTLIERS_IN_A_ROW

    def _place(self, fix: Fix) -> FrameTransform:
        now, since = self._ekf.state.nav_state(), self.state.since
        P = now.covariance
        transform = FrameTransform(
            np.eye(3),
            fix.value - now.p_W,
            fix.value,
            placed=True,
            since=since,
            drift=float(P[2, 2]),
            by_yaw=P[POSITION, 2] / P[2, 2],
            position_drift=without_yaw(P, POSITION),
        )
        self._ekf.state = self._ekf.state.transformed(np.eye(3), transform.shift)
        variance = np.trace(fix.covariance) + np.trace(now.position_covariance)
        sigma = min(_INFLATION_RATIO * math.sqrt(variance), _MAX_SIGMA)
        self._ekf.state = self._ekf.state.with_position_inflated(sigma)
        self.state = changed(self.state, placed=True)
        return transform

    def _begin_alignment(self, fix: Fix) -> None:
        """Take the position just applied as the pivot about which later fixes turn the track."""
        self.state = changed(
            self.state,
            pivot=fix.value,
            pivot_variance=float(np.trace(fix.covariance[:2, :2])),
            alignment=PlanarAlignment(),
            distance_mismatches=0,
            yaw_variance=float(self._ekf.state.nav_state().covariance[2, 2]),
        )
        self._add_to_alignment(fix)

    def _orient(self, fix: Fix) -> FrameTransform | None:
        """Turn the frame to a fix; return None if the fix does not determine the direction."""
        pivot, since = self.state.pivot, self.state.since
        now = self._ekf.state.nav_state()
        turn, sigma = turn_from_fix(now, pivot, fix)
        inflation = UNKNOWN_YAW  # the fix itself then measures the turn
        max_sigma = MAX_YAW_SIGMA if fix.kind == "yaw" else MAX_POSITION_YAW_SIGMA
        if not (math.isfinite(turn) and sigma <= max_sigma):
            if fix.kind != "position":
                return None
            turn, inflation = self.state.alignment.turn
            if inflation > MAX_POSITION_YAW_SIGMA:
                self._add_to_alignment(fix)
                return None
        R = about_vertical(turn)
        drift = float(now.covariance[2, 2])
        transform = FrameTransform(R, pivot - R @ pivot, pivot, False, since, drift=drift)
        turned = self._ekf.state.transformed(transform.R, transform.shift)
        self._ekf.state = turned.with_yaw_inflated(pivot, inflation)
        self.state = changed(
            self.state,
            oriented=True,
            transforms=(*self.state.transforms, *self.state.unoriented),
            alignment=PlanarAlignment(),
            unoriented=(),
        )
        return transform

    def _add_to_alignment(self, fix: Fix) -> None:
        """Add a position to those that determine the direction together."""
        now, pivot = self._ekf.state.nav_state(), self.state.pivot
        track, measured = (now.p_W - pivot)[:2], (fix.value - pivot)[:2]
        variance = 0.5 * float(np.trace(fix.covariance[:2, :2]))
        drift = 0.5 * float(np.trace(without_yaw(now.covariance, POSITION)[:2, :2]))
        alignment = self.state.alignment.with_position(track, measured, variance, drift)
        self.state = changed(self.state, alignment=alignment)

    def _update(self, fix: Fix) -> UpdateResult:
        if self.state.oriented:
            self._ekf.state = with_turn(self._ekf.state, self._config.network_turn_sigma)
        gate = chi2_quantile(self._config.gate, len(fix.value))
        if fix.kind == "position":
            return self._update_position(fix, gate)
        if fix.kind == "velocity":
            return self._ekf.update_velocity_W(fix.value, fix.covariance, gate)
        return self._ekf.update_yaw(float(fix.value[0]), math.sqrt(fix.covariance[0, 0]), gate)

    def _update_position(self, fix: Fix, gate: float) -> UpdateResult:
        """Update with a position; inflate an outlier, but move the track after similar ones."""
        before = self._ekf.state
        self.state = changed(self.state, since_jump=self.state.since_jump + 1)
        result = self._ekf.update_position_W(fix.value, fix.covariance, gate)
        residual = result.residual
        if residual is None or not result.gated:
            self.state = changed(self.state, outlier_residuals=())
            return result
        aligned = tuple(
            r
            for r in self.state.outlier_residuals
            if r @ residual > _SAME_DIRECTION * norm(r) * norm(residual)
        )
        self.state = changed(self.state, outlier_residuals=(*aligned, residual))
        if len(self.state.outlier_residuals) < _OUTLIERS_IN_A_ROW:
            return result
        repeated = self.state.since_jump <= _POSITIONS_APART
        self.state = changed(
            self.state, outlier_residuals=(), jumps=self.state.jumps + 1, since_jump=0
        )
        self._ekf.state = before.with_position_inflated(float(norm(residual)))
        result = self._ekf.update_position_W(fix.value, fix.covariance, gate)
        if repeated and self.state.oriented:
            self._reopen_direction(fix)
        return result

    def _reopen_direction(self, fix: Fix) -> None:
        """Let later fixes turn the track from here on: its direction has proved to be wrong."""
        self.state = changed(
            self.state, oriented=False, since=fix.time, arbitrary_yaw=True, since_jump=math.inf
        )
        self._begin_alignment(fix)
