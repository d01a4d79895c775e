"""Frame transforms: a track's own frame moved and turned to the one that fixes are given in.

In the words of ROS REP 105 the track starts in an `odom` frame of its own and a transform takes it
to `map`. What is not known of a transform is added to the covariance of the states before it, as if
it were independent of theirs; that is on the safe side, for the fix saw the track's errors too. A
turn says how the track lay at the fix: by how far its yaw may have drifted, or turned in a gap,
since a state is added as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.changed import changed
from stario.fusion.state import NavState, SmoothedPose
from stario.sequences.sequence import FloatArray, Trajectory

_E3_CROSS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
_HORIZONTAL = np.diag([1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class FrameTransform:
    """p <- R p + shift.

    Attributes:
        time: of the fix that told it [s].
        R: (3, 3) rotation about the vertical.
        shift: (3,) [m].
        pivot: (3,) the point of the new frame that a wrong turn would leave where it is [m].
        placed: whether it is the shift of a position fix, not a turn.
        since: states before this time [s] are not transformed: they are in the map already.
        until: nor are states from this time on [s].
        yaw_sigma: of the turn [rad].
        drift: variance of the track's own yaw at the time of a turn [rad^2].
        position_covariance: (3, 3) of the shift [m^2].
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
        """A position (3,) in the new frame [m]."""
        return np.asarray(self.R @ p_W + self.shift)

    def applies_to(self, time: float) -> bool:
        """Whether a state of before, at a time [s], is transformed."""
        return self.since <= time < self.until

    def turn_variance(self, own: float) -> float:
        """Of the yaw of a state that had this variance in the track's own frame [rad^2]."""
        return self.yaw_sigma**2 + max(0.0, self.drift - own)

    def position_covariance_of(
        self, p_W: FloatArray, covariance: FloatArray, own: float
    ) -> FloatArray:
        """Covariance (3, 3) of a position that is now `p_W`, from the one it had before [m^2].

        Args:
            p_W: (3,) [m].
            covariance: (3, 3) before.
            own: variance of the yaw there, in the track's own frame [rad^2].
        """
        turned = _turn_covariance(self.turn_variance(own), np.zeros(3), p_W - self.pivot)
        covariance = self.R @ covariance @ self.R.T + turned[6:9, 6:9]
        return (
            covariance
            if self.position_covariance is None
            else (covariance + self.position_covariance)
        )

    def state(self, state: NavState) -> NavState:
        """A state of before, in the new frame."""
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
    """Second moments of a turn t by a normal angle of this variance, also where it is large.

    Returns:
        E sin^2 t, E (1 - cos t)^2 and E t sin t: across an arm of length one, along it, and of
        across with the angle; the variance, 0 and the variance where it is small.
    """
    cos_1, cos_2 = math.exp(-0.5 * variance), math.exp(-2.0 * variance)
    return 0.5 * (1.0 - cos_2), 1.0 - 2.0 * cos_1 + 0.5 * (1.0 + cos_2), variance * cos_1


def _turn_covariance(variance: float, v_W: FloatArray, arm: FloatArray) -> FloatArray:
    """Covariance (15, 15) of a state by its turn: yaw, velocity (3,) and arm (3,) to the pivot."""
    across, along, with_angle = _turn_moments(variance)
    columns = np.zeros((15, 2))  # columns: across and along
    columns[3:6, 0], columns[6:9, 0] = _E3_CROSS @ v_W, _E3_CROSS @ arm
    columns[3:6, 1], columns[6:9, 1] = _HORIZONTAL @ v_W, _HORIZONTAL @ arm
    covariance = columns @ np.diag([across, along]) @ columns.T
    covariance[2, 2] = variance
    covariance[2] += with_angle * columns[:, 0]
    covariance[:, 2] += with_angle * columns[:, 0]
    return covariance


def in_last_frame(states: list[NavState], transforms: Sequence[FrameTransform]) -> list[NavState]:
    """States of a track, every one of them in the frame the track ends in."""
    for transform in transforms:
        states = [transform.state(state) for state in states]
    return states


def smoothed_track(
    poses: list[SmoothedPose], transforms: Sequence[FrameTransform]
) -> Trajectory | None:
    """Smoothed poses as a track, in the frame it ends in; None where there is none."""
    if not poses:
        return None
    rows = []
    for pose in poses:
        R_WB, p_W, covariance = pose.R_WB, pose.p_W, pose.covariance[3:, 3:]
        for transform in transforms[pose.map_frame :]:
            if transform.applies_to(pose.time):
                R_WB, p_W = transform.R @ R_WB, transform.position(p_W)
                own = pose.covariance[2, 2]
                covariance = transform.position_covariance_of(p_W, covariance, own)
        rows.append((pose.time, p_W, R_WB, covariance))
    time, position, attitude, covariances = zip(*rows, strict=True)
    return Trajectory(
        time=np.array(time),
        position_W=np.array(position),
        attitude_WB=Rotation.from_matrix(np.array(attitude)),
        position_covariance_W=np.array(covariances),
    )
