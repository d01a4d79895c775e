"""Frame transforms: shift and turn from a track's own frame to the frame of the fixes.

In the terms of ROS REP 105, the track starts in an `odom` frame of its own and a transform takes it
to `map`. The uncertainty of a transform is added to the covariance of the states before it as if
the two were independent; this is conservative, since the transform contains the track's errors too.
A turn holds for the track's yaw at the time of the fix: for an earlier state, the variance of the
yaw drift since, including turns during gaps, is added as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.state import NavState, SmoothedPose, changed
from stario.sequences.sequence import FloatArray, Trajectory

_E3_CROSS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
_HORIZONTAL = np.diag([1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class FrameTransform:
    """The transform p <- R p + shift.

    Attributes:
        time: time of the fix that determined it [s].
        R: (3, 3) rotation about the vertical.
        shift: (3,) translation [m].
        pivot: (3,) point of the new frame that an error of the turn leaves in place [m].
        placed: whether it is a shift by a position fix rather than a turn.
        since: states before this time [s] are not transformed: they are in the map already.
        until: states from this time [s] on are not transformed either.
        yaw_sigma: standard deviation of the turn [rad].
        drift: variance of the track's own yaw at the time of a turn [rad^2].
        position_covariance: (3, 3) covariance of the shift [m^2].
    """

    time: float
    R: FloatArray
    shift: FloatArray
    pivot: FloatArray
    placed: bool
    since: float
    until: float = math.inf
    yaw_sigma: float = 0.0
    drift: float = 0.0
    position_covariance: FloatArray | None = None

    def position(self, p_W: FloatArray) -> FloatArray:
        """Return a position (3,) in the new frame [m]."""
        return np.asarray(self.R @ p_W + self.shift)

    def applies_to(self, time: float) -> bool:
        """Return whether an earlier state at a time [s] is transformed."""
        return self.since <= time < self.until

    def turn_variance(self, yaw_variance: float) -> float:
        """Return the turn's variance [rad^2] for an earlier state with this yaw variance."""
        return self.yaw_sigma**2 + max(0.0, self.drift - yaw_variance)

    def position_covariance_of(
        self, p_W: FloatArray, covariance: FloatArray, yaw_variance: float
    ) -> FloatArray:
        """Return the covariance (3, 3) of a transformed position [m^2].

        Args:
            p_W: (3,) position after the transform [m].
            covariance: (3, 3) covariance before the transform [m^2].
            yaw_variance: variance of the yaw there, in the track's own frame [rad^2].
        """
        turned = _turn_covariance(self.turn_variance(yaw_variance), np.zeros(3), p_W - self.pivot)
        covariance = self.R @ covariance @ self.R.T + turned[6:9, 6:9]
        return (
            covariance
            if self.position_covariance is None
            else (covariance + self.position_covariance)
        )

    def state(self, state: NavState) -> NavState:
        """Return an earlier state in the new frame; a later one is unchanged."""
        if state.time >= self.time:
            return state
        if not self.applies_to(state.time):
            return changed(state, map_frame=state.map_frame + 1)
        v_W, p_W = self.R @ state.v_W, self.position(state.p_W)
        A = np.eye(15)
        for first in (0, 3, 6):
            A[first : first + 3, first : first + 3] = self.R
        covariance = A @ state.covariance @ A.T
        covariance += _turn_covariance(
            self.turn_variance(state.covariance[2, 2]), v_W, p_W - self.pivot
        )
        if self.position_covariance is not None:
            covariance[6:9, 6:9] += self.position_covariance
        return changed(
            state,
            R_WB=self.R @ state.R_WB,
            v_W=v_W,
            p_W=p_W,
            covariance=covariance,
            map_frame=state.map_frame + 1,
        )


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
    columns[3:6, 0], columns[6:9, 0] = _E3_CROSS @ v_W, _E3_CROSS @ arm
    columns[3:6, 1], columns[6:9, 1] = _HORIZONTAL @ v_W, _HORIZONTAL @ arm
    covariance = columns @ np.diag([across, along]) @ columns.T
    covariance[2, 2] = variance
    covariance[2] += with_angle * columns[:, 0]
    covariance[:, 2] += with_angle * columns[:, 0]
    return covariance


def to_final_frame(states: list[NavState], transforms: Sequence[FrameTransform]) -> list[NavState]:
    """Return the states of a track in its final frame."""
    for transform in transforms:
        states = [transform.state(state) for state in states]
    return states


def with_undirected(states: list[NavState], undirected: Sequence[FrameTransform]) -> list[NavState]:
    """Return the states of a track with the yaw uncertainty of stretches without a direction.

    The filter keeps the arbitrary yaw of such a stretch as if it were known, so that the first fix
    that determines it turns the track exactly; those who read the states must know better.
    """
    for stretch in undirected:
        states = [changed(stretch.state(s), map_frame=s.map_frame) for s in states]
    return states


def smoothed_track(
    poses: list[SmoothedPose], transforms: Sequence[FrameTransform]
) -> Trajectory | None:
    """Return smoothed poses as a track in its final frame; None if there are none."""
    if not poses:
        return None
    rows = []
    for pose in poses:
        R_WB, p_W, covariance = pose.R_WB, pose.p_W, pose.covariance[3:, 3:]
        for transform in transforms[pose.map_frame :]:
            if transform.applies_to(pose.time):
                R_WB, p_W = transform.R @ R_WB, transform.position(p_W)
                yaw_variance = pose.covariance[2, 2]
                covariance = transform.position_covariance_of(p_W, covariance, yaw_variance)
        rows.append((pose.time, p_W, R_WB, covariance))
    time, position, attitude, covariances = zip(*rows, strict=True)
    return Trajectory(
        time=np.array(time),
        position_W=np.array(position),
        attitude_WB=Rotation.from_matrix(np.array(attitude)),
        position_covariance_W=np.array(covariances),
    )
