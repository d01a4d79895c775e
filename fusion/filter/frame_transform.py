"""Frame transforms: a track's own frame moved and turned to the one that fixes are given in.

In the words of ROS REP 105 the track starts in an `odom` frame of its own and a transform takes it
to `map`. What is not known of a transform is added to the covariance of the states before it, as if
it were independent of theirs; that is on the safe side, for the fix saw the track's errors too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.changed import changed
from stario.fusion.state import NavState, SmoothedPose
from stario.sequences.attitude.so3 import skew
from stario.sequences.sequence import FloatArray, Trajectory

_UP = np.array([0.0, 0.0, 1.0])


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

    def position(self, p_W: FloatArray) -> FloatArray:
        """A position (3,) in the new frame [m]."""
        return np.asarray(self.R @ p_W + self.shift)

    def position_covariance_of(self, p_W: FloatArray, covariance: FloatArray) -> FloatArray:
        """Covariance (3, 3) of a position that is now `p_W`, from the one it had before [m^2]."""
        across = skew(p_W - self.pivot) @ (-self.yaw_sigma * _UP)
        covariance = self.R @ covariance @ self.R.T + np.outer(across, across)
        return (
            covariance
            if self.position_covariance is None
            else (covariance + self.position_covariance)
        )

    def state(self, state: NavState) -> NavState:
        """A state of before, in the new frame."""
        if state.time >= self.time:
            return state
        if state.time < self.since:
            return changed(state, map_frame=state.map_frame + 1)
        v_W, p_W = self.R @ state.v_W, self.position(state.p_W)
        A = np.eye(15)
        for first in (0, 3, 6):
            A[first : first + 3, first : first + 3] = self.R
        covariance = A @ state.covariance @ A.T
        turn = np.zeros((15, 1))
        turn[2] = 1.0
        turn[3:6, 0] = skew(v_W) @ -_UP
        turn[6:9, 0] = skew(p_W - self.pivot) @ -_UP
        covariance += self.yaw_sigma**2 * (turn @ turn.T)
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
            if pose.time >= transform.since:
                R_WB, p_W = transform.R @ R_WB, transform.position(p_W)
                covariance = transform.position_covariance_of(p_W, covariance)
        rows.append((pose.time, p_W, R_WB, covariance))
    time, position, attitude, covariances = zip(*rows, strict=True)
    return Trajectory(
        time=np.array(time),
        position_W=np.array(position),
        attitude_WB=Rotation.from_matrix(np.array(attitude)),
        position_covariance_W=np.array(covariances),
    )
