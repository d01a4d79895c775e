"""The map frame: where the fixes' frame lies against the track's own, told by the fixes.

A track that starts without a pose calls its first position zero and its first yaw zero. The first
position fix moves this frame so that the track passes through the fix; what is known of the
absolute position is then the fix's covariance. The first fix that tells the direction turns it
about that point: a second position far enough away, a velocity, or a yaw. Neither is a small
correction, so neither goes through the filter's linearisation: the frame is transformed exactly
(the right-invariant error turns with it), then the covariance is inflated as if nothing were known
of this shift or turn, then the fix is an ordinary measurement (README.md, "Fixes").

Behind a gap in which the direction was lost the same holds of the track from there on: the next
position places it, the next direction turns it, and what was before the gap stays where it is.

The filter knows the wide one of the gyroscope's two priors, callers see both (`gyro_prior`): two
tracks that a drifting yaw may lead far apart until a fix brings them together. So a transform is
two, one for the states that the filter holds and one for those given out, which also decide whether
the direction is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from stario.fusion.chi_square import chi2_quantile
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.filter.estimate import nav_states
from stario.fusion.filter.frame_transform import FrameTransform
from stario.fusion.filter.gyro_prior import GyroPrior
from stario.fusion.fixes import Fix
from stario.fusion.lie import FloatArray, exp_so3
from stario.fusion.state import NavState
from stario.fusion.yaw import yaw_twist

UNKNOWN_YAW = math.pi / math.sqrt(3.0)
"""Standard deviation of a yaw of which nothing is known, uniform over the circle [rad]."""

KNOWN_YAW = 0.5
"""A first yaw given to better than this [rad] is kept; a coarser one is left to the fixes."""

FAR_ENOUGH = 0.3
"""Two positions tell the yaw when it is then known to this [rad]; half its square, what the
linearisation leaves out, is still far below it (NEES of yaw 1.0 to 1.2 over 40 walks)."""

_MUCH_LARGER, _LARGEST = 1e3, 1e5
"""An unknown shift is this many times what the measurement leaves of it, but at most so large [m]:
beyond, the covariance keeps no digits for the fix."""

_ORIGINS = (np.zeros(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class MapFrameState:
    """What is known of the map frame.

    Attributes:
        placed: whether the track's position in it is known.
        oriented: whether its yaw is.
        transforms: of the states given out.
        filter_transforms: of the states as the filter holds them; as many.
        pivots: (3,) each, about which the filter's track and the one given out may be turned [m].
        since: time from which on the track is placed and turned anew [s].
    """

    placed: bool
    oriented: bool
    transforms: tuple[FrameTransform, ...] = ()
    filter_transforms: tuple[FrameTransform, ...] = ()
    pivots: tuple[FloatArray, FloatArray] = _ORIGINS
    since: float = -math.inf


class MapFrame:
    """Applies fixes to a filter, and transforms the filter's frame where it must.

    Args:
        placed: whether the first position was given.
        oriented: whether the first yaw was given.
        gate: probability of the chi-square test.
        prior: by which the filter's states are given out.

    Attributes:
        state: what is known of the frame.
    """

    def __init__(self, placed: bool, oriented: bool, gate: float, prior: GyroPrior) -> None:
        self.state = MapFrameState(placed, oriented)
        self._gate, self._prior = gate, prior

    def update(self, ekf: StateCloningEkf, fix: Fix) -> UpdateResult:
        """Take in a fix at the filter's time."""
        if fix.kind == "position" and not self.state.placed:
            transforms = self._place(ekf, fix)
        elif self.state.oriented:
            return self._update(ekf, fix)
        else:
            transforms = self._orient(ekf, fix)
        if not transforms:
            return UpdateResult(math.nan, len(fix.value), False, reason="yaw not known")
        result = self._update(ekf, fix)
        own, seen = (
            self._with_uncertainty(transform, state)
            for transform, state in zip(transforms, self._nav_states(ekf), strict=True)
        )
        s = self.state
        self.state = replace(
            s,
            filter_transforms=(*s.filter_transforms, own),
            transforms=(*s.transforms, seen),
        )
        return result

    def lose_yaw(self, ekf: StateCloningEkf) -> None:
        """Behind a gap: leave it to the fixes where the track goes on, if its yaw is lost."""
        if not self.state.oriented:
            return
        own, seen = self._nav_states(ekf)
        if seen.covariance[2, 2] > KNOWN_YAW**2:
            self.state = replace(
                self.state,
                placed=False,
                oriented=False,
                pivots=(own.p_W, seen.p_W),
                since=ekf.state.time,
            )

    def _nav_states(self, ekf: StateCloningEkf) -> list[NavState]:
        """The newest state as the filter holds it, and as it is given out."""
        now = ekf.state.estimate()
        return [*nav_states([now]), *nav_states([now], self._prior)]

    def _place(self, ekf: StateCloningEkf, fix: Fix) -> list[FrameTransform]:
        since = self.state.since
        transforms = [
            FrameTransform(fix.time, np.eye(3), fix.value - s.p_W, fix.value, True, since)
            for s in self._nav_states(ekf)
        ]
        ekf.state = ekf.state.transformed(np.eye(3), transforms[0].shift)
        left = np.trace(fix.covariance) + np.trace(ekf.state.plain_covariance[6:9, 6:9])
        sigma = min(_MUCH_LARGER * math.sqrt(left), _LARGEST)
        ekf.state = ekf.state.with_position_inflated(sigma)
        self.state = replace(self.state, placed=True, pivots=(fix.value, fix.value))
        return transforms

    def _orient(self, ekf: StateCloningEkf, fix: Fix) -> list[FrameTransform]:
        """Empty where the fix does not tell the direction."""
        pivots, since = self.state.pivots, self.state.since
        states = zip(self._nav_states(ekf), pivots, strict=True)
        turns, sigmas = zip(*(_turn(s, pivot, fix) for s, pivot in states), strict=True)
        if not (np.isfinite(turns).all() and (sigmas[1] < FAR_ENOUGH or fix.kind == "yaw")):
            return []
        transforms = []
        for turn, pivot in zip(turns, pivots, strict=True):
            R = exp_so3(np.array([0.0, 0.0, turn]))
            transforms.append(FrameTransform(fix.time, R, pivot - R @ pivot, pivot, False, since))
        moved = ekf.state.transformed(transforms[0].R, transforms[0].shift)
        ekf.state = moved.with_yaw_inflated(pivots[0], UNKNOWN_YAW)
        self.state = replace(self.state, oriented=True)
        return transforms

    def _with_uncertainty(self, transform: FrameTransform, state: NavState) -> FrameTransform:
        """A transform with what is not known of it, by the state behind it."""
        P, oriented = state.covariance, self.state.oriented
        return replace(
            transform,
            yaw_sigma=math.sqrt(P[2, 2]) if oriented else 0.0,
            position_covariance=np.zeros((3, 3)) if oriented else P[6:9, 6:9],
        )

    def _update(self, ekf: StateCloningEkf, fix: Fix) -> UpdateResult:
        gate = chi2_quantile(self._gate, len(fix.value))
        if fix.kind == "position":
            return ekf.update_position_W(fix.value, fix.covariance, gate)
        if fix.kind == "velocity":
            return ekf.update_velocity_W(fix.value, fix.covariance, gate)
        return ekf.update_yaw(float(fix.value[0]), math.sqrt(fix.covariance[0, 0]), gate)


def _turn(state: NavState, pivot: FloatArray, fix: Fix) -> tuple[float, float]:
    """Turn of the frame about a point that a fix asks for, and how well it tells it [rad]."""
    if fix.kind == "yaw":
        return float(fix.value[0]) - yaw_twist(state.R_WB), math.sqrt(fix.covariance[0, 0])
    first, seen, ours = 3, fix.value, state.v_W
    if fix.kind == "position":
        first, seen, ours = 6, fix.value - pivot, state.p_W - pivot
    P = state.covariance
    by_yaw = P[first : first + 2, 2]
    # What of it comes from the yaw is what the fix is to tell.
    P = P[first : first + 2, first : first + 2] - np.outer(by_yaw, by_yaw) / P[2, 2]
    arm = min(math.hypot(seen[0], seen[1]), math.hypot(ours[0], ours[1]))
    across = math.sqrt(float(np.linalg.eigvalsh(P + fix.covariance[:2, :2])[-1]))
    turn = math.atan2(seen[1], seen[0]) - math.atan2(ours[1], ours[0])
    return turn, across / arm if arm > 0.0 else math.inf
