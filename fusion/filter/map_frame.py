"""Which world a track is in: its start's own, until fixes say where it is and how it is turned.

A track that starts without a pose calls its first position zero and its first yaw zero: that is its
world. The first position fix moves this world so that the track passes through the fix; what is
known of the absolute position is then the fix's covariance. The first fix that tells the direction
turns it about that point: a second position far enough away, a velocity, or a heading. Neither is
a small correction, so neither goes through the filter's linearisation: the world is moved and
turned exactly (the right-invariant error turns with it), then the filter is told that this shift or
turn was not known at all, then the fix is an ordinary measurement.

Behind a gap in which the direction was lost the same holds of the track from there on: the next
position places it, the next direction turns it, and what was before the gap stays where it is.

The filter knows the wide one of the gyroscope's two priors, callers see both (`gyro_prior`): two
tracks that a drifting yaw may lead far apart until a fix brings them together. So a change is two,
one for the states that the filter holds and one for those given out, which also decide whether the
direction is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.filter.estimate import nav_states
from stario.fusion.filter.gyro_prior import GyroPrior
from stario.fusion.filter.jacobians import yaw_twist
from stario.fusion.fixes import Fix
from stario.fusion.lie import FloatArray, exp_so3, skew
from stario.fusion.state import NavState, SmoothedPose
from stario.sequences.sequence import Trajectory

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


@dataclass(frozen=True, eq=False)
class WorldChange:
    """A new world: p <- R p + shift.

    Attributes:
        time: of the fix that told it [s].
        R: (3, 3) rotation about the vertical.
        shift: (3,) [m].
        pivot: (3,) the point of the new world that a wrong turn would leave where it is [m].
        placed: whether it is the shift of a position fix, not a turn.
        since: states before this time [s] are none of its, for they were in the new world already.
        yaw_sigma: of the turn [rad].
        position_covariance: (3, 3) of the shift [m^2].
    """

    time: float
    R: FloatArray
    shift: FloatArray
    pivot: FloatArray
    placed: bool
    since: float
    yaw_sigma: float = 0.0
    position_covariance: FloatArray | None = None


class WorldFrame:
    """Applies fixes to a filter, and moves and turns the filter's world where it must.

    Args:
        placed: whether the first position was given.
        oriented: whether the first yaw was given.
        gate: probability of the chi-square test.
        prior: by which the filter's states are given out.

    Attributes:
        changes: of the states given out.
        filter_changes: of the states as the filter holds them; as many.
    """

    def __init__(self, placed: bool, oriented: bool, gate: float, prior: GyroPrior) -> None:
        self.placed, self.oriented = placed, oriented
        self.changes: list[WorldChange] = []
        self.filter_changes: list[WorldChange] = []
        self._prior = prior
        self._pivots, self._since = [np.zeros(3), np.zeros(3)], -math.inf
        self._gates = {n: float(chi2.ppf(gate, n)) for n in (1, 3)}

    def apply(self, ekf: StateCloningEkf, fix: Fix) -> tuple[UpdateResult, WorldChange | None]:
        """Take in a fix at the filter's time; also the change it brought to the filter's world."""
        if fix.kind == "position" and not self.placed:
            changes = self._place(ekf, fix)
        elif self.oriented:
            return self._update(ekf, fix), None
        else:
            changes = self._orient(ekf, fix)
        if not changes:
            return UpdateResult(math.nan, len(fix.value), False, reason="yaw not known"), None
        result = self._update(ekf, fix)
        own, seen = (
            self._with_what_is_left(change, state)
            for change, state in zip(changes, self._states(ekf), strict=True)
        )
        self.filter_changes.append(own)
        self.changes.append(seen)
        return result, own

    def lose_yaw(self, ekf: StateCloningEkf) -> None:
        """Behind a gap: leave it to the fixes where the track goes on, if its yaw is lost."""
        if not self.oriented:
            return
        own, seen = self._states(ekf)
        if seen.covariance[2, 2] > KNOWN_YAW**2:
            self.placed = self.oriented = False
            self._pivots, self._since = [own.p_W, seen.p_W], ekf.time

    def checkpoint(self) -> dict[str, Any]:
        """Everything that `rewind` needs."""
        return {
            "placed": self.placed,
            "oriented": self.oriented,
            "pivots": list(self._pivots),
            "since": self._since,
            "changes": [vars(change) for change in self.changes],
            "filter_changes": [vars(change) for change in self.filter_changes],
        }

    def rewind(self, checkpoint: dict[str, Any]) -> None:
        """Go back to a checkpoint."""
        self.placed, self.oriented = checkpoint["placed"], checkpoint["oriented"]
        self._pivots, self._since = list(checkpoint["pivots"]), checkpoint["since"]
        self.changes = [WorldChange(**change) for change in checkpoint["changes"]]
        self.filter_changes = [WorldChange(**change) for change in checkpoint["filter_changes"]]

    def _states(self, ekf: StateCloningEkf) -> list[NavState]:
        """The newest state as the filter holds it, and as it is given out."""
        now = ekf.estimate()
        return [*nav_states([now]), *nav_states([now], self._prior)]

    def _place(self, ekf: StateCloningEkf, fix: Fix) -> list[WorldChange]:
        changes = [
            WorldChange(fix.time, np.eye(3), fix.value - s.p_W, fix.value, True, self._since)
            for s in self._states(ekf)
        ]
        ekf.move_world(np.eye(3), changes[0].shift)
        left = np.trace(fix.covariance) + np.trace(ekf.world_covariance()[6:9, 6:9])
        ekf.loosen_position(min(_MUCH_LARGER * math.sqrt(left), _LARGEST))
        self.placed, self._pivots = True, [fix.value, fix.value]
        return changes

    def _orient(self, ekf: StateCloningEkf, fix: Fix) -> list[WorldChange]:
        """Empty where the fix does not tell the direction."""
        states = zip(self._states(ekf), self._pivots, strict=True)
        turns, sigmas = zip(*(_turn(s, pivot, fix) for s, pivot in states), strict=True)
        if not (np.isfinite(turns).all() and (sigmas[1] < FAR_ENOUGH or fix.kind == "heading")):
            return []
        changes = []
        for turn, pivot in zip(turns, self._pivots, strict=True):
            R = exp_so3(np.array([0.0, 0.0, turn]))
            changes.append(WorldChange(fix.time, R, pivot - R @ pivot, pivot, False, self._since))
        ekf.move_world(changes[0].R, changes[0].shift)
        ekf.loosen_yaw(self._pivots[0], UNKNOWN_YAW)
        self.oriented = True
        return changes

    def _with_what_is_left(self, change: WorldChange, state: NavState) -> WorldChange:
        """A change with what is not known of it, by the state behind it."""
        P = state.covariance
        return replace(
            change,
            yaw_sigma=math.sqrt(P[2, 2]) if self.oriented else 0.0,
            position_covariance=np.zeros((3, 3)) if self.oriented else P[6:9, 6:9],
        )

    def _update(self, ekf: StateCloningEkf, fix: Fix) -> UpdateResult:
        gate = self._gates[len(fix.value)]
        if fix.kind == "position":
            return ekf.update_position_W(fix.value, fix.covariance, gate)
        if fix.kind == "velocity":
            return ekf.update_velocity_W(fix.value, fix.covariance, gate)
        return ekf.update_heading(float(fix.value[0]), math.sqrt(fix.covariance[0, 0]), gate)


def _turn(state: NavState, pivot: FloatArray, fix: Fix) -> tuple[float, float]:
    """Turn of the world about a point that a fix asks for, and how well it tells it [rad]."""
    if fix.kind == "heading":
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


def in_last_world(states: list[NavState], changes: list[WorldChange]) -> list[NavState]:
    """States of a track with every one of them given in the world the track ends in.

    What is not known of a change is added to the covariance of the states before it, as if it were
    independent of theirs; that is on the safe side, for the fix saw the track's own errors too.
    """
    for change in changes:
        states = [_after(state, change) for state in states]
    return states


def smoothed_track(poses: list[SmoothedPose], changes: list[WorldChange]) -> Trajectory | None:
    """Smoothed poses as a track, in the world it ends in; None where there is none."""
    if not poses:
        return None
    rows = []
    for pose in poses:
        R_WB, p_W, covariance = pose.R_WB, pose.p_W, pose.covariance[3:, 3:]
        for change in (c for c in changes[pose.world :] if pose.time >= c.since):
            R_WB, p_W = change.R @ R_WB, change.R @ p_W + change.shift
            covariance = change.R @ covariance @ change.R.T
            across = skew(p_W - change.pivot) @ [0.0, 0.0, -change.yaw_sigma]
            covariance = covariance + np.outer(across, across)
            if change.position_covariance is not None:
                covariance = covariance + change.position_covariance
        rows.append((pose.time, p_W, R_WB, covariance))
    time, position, attitude, covariances = zip(*rows, strict=True)
    return Trajectory(
        time=np.array(time),
        position_W=np.array(position),
        attitude_WB=Rotation.from_matrix(np.array(attitude)),
        position_covariance_W=np.array(covariances),
    )


def _after(state: NavState, change: WorldChange) -> NavState:
    if state.time >= change.time:
        return state
    if state.time < change.since:
        return replace(state, world=state.world + 1)
    return _moved(state, change)


def _moved(state: NavState, change: WorldChange) -> NavState:
    R = change.R
    v_W, p_W = R @ state.v_W, R @ state.p_W + change.shift
    A = np.eye(15)
    for first in (0, 3, 6):
        A[first : first + 3, first : first + 3] = R
    covariance = A @ state.covariance @ A.T
    turn = np.zeros((15, 1))
    turn[2] = 1.0
    turn[3:6, 0] = skew(v_W) @ [0.0, 0.0, -1.0]
    turn[6:9, 0] = skew(p_W - change.pivot) @ [0.0, 0.0, -1.0]
    covariance += change.yaw_sigma**2 * (turn @ turn.T)
    if change.position_covariance is not None:
        covariance[6:9, 6:9] += change.position_covariance
    return replace(
        state, R_WB=R @ state.R_WB, v_W=v_W, p_W=p_W, covariance=covariance, world=state.world + 1
    )
