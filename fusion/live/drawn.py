"""Displayed points of a device's track, transformed when fixes move the map frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.filter.map_frame import MAX_PRIOR_YAW_SIGMA
from stario.fusion.values.floors import FloorChange, floor_changes
from stario.fusion.values.state import NavState
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.sequence import FloatArray

Point = list[float]
"""t [s], x, y, z [m], speed [m/s], yaw [deg], the horizontal covariance's xx, xy, yy [m^2], the
standard deviation of yaw [deg], and x, y [m] of the line: the position without steps at updates."""

MAX_POINTS = 20_000
"""Maximum number of points of a track; beyond it every second one is dropped to bound memory."""

_FLOOR_STRIDE = 5
"""One point in so many tells of floors, about two per second."""

_GAP_SECONDS = 0.5
"""Interval between states [s] above which samples were missing; normally it is 0.1 s."""


@dataclass
class DisplayedTrack:
    """Displayed track of one device.

    Attributes:
        points: thinned beyond `MAX_POINTS`. A list that only grows: when earlier points change,
            another takes its place, as viewers read it while a thread adds points.
        origin: (3,) position displayed as zero [m].
        since: index of the first point that fixes still move; points before a gap in which the
            yaw was lost stay where they are.
    """

    points: list[Point] = field(default_factory=list)
    origin: FloatArray = field(default_factory=lambda: np.zeros(3))
    since: int = 0

    def add(self, state: NavState, p_W: FloatArray) -> None:
        """Append the newest state, with its (3,) position without steps at updates [m]."""
        after_gap = bool(self.points) and state.time - self.points[-1][0] > _GAP_SECONDS
        if after_gap and state.covariance[2, 2] > MAX_PRIOR_YAW_SIGMA**2:
            self.since = len(self.points)
        self.points.append(point_of(state, p_W))
        if len(self.points) > MAX_POINTS:
            self.points, self.since = self.points[::2], self.since // 2

    def floor_changes(self) -> list[FloorChange]:
        """Return the changes of floor so far."""
        points = self.points[::_FLOOR_STRIDE]
        if len(points) < 2:
            return []
        time, height, x, y = np.array([[p[0], p[3], p[10], p[11]] for p in points]).T
        speed = np.hypot(np.gradient(x, time), np.gradient(y, time))
        return floor_changes(time, height, speed)[0]

    def move(self, before: NavState, after: NavState) -> None:
        """Transform earlier points by the map-frame change that turned `before` into `after`."""
        turn = float(yaw_of(Rotation.from_matrix(after.R_WB @ before.R_WB.T))[0])
        R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        shift = after.p_W[:2] - R @ before.p_W[:2]
        rise = after.p_W[2] - before.p_W[2]
        table = np.array(self.points[self.since :]).reshape(-1, 12)
        for xy in (slice(1, 3), slice(10, 12)):
            table[:, xy] = table[:, xy] @ R.T + shift
        table[:, 3] += rise
        table[:, 5] = (table[:, 5] + math.degrees(turn) + 180.0) % 360.0 - 180.0
        P = table[:, [6, 7, 7, 8]].reshape(-1, 2, 2)
        table[:, 6:9] = (R @ P @ R.T).reshape(-1, 4)[:, [0, 1, 3]]
        self.points = self.points[: self.since] + table.tolist()


def point_of(state: NavState, p_W: FloatArray) -> Point:
    """Return the point of a state, and of its position without steps, rounded for the screen."""
    P = state.covariance
    values = (
        *state.p_W,
        float(np.linalg.norm(state.v_W)),
        math.degrees(float(yaw_of(Rotation.from_matrix(state.R_WB))[0])),
        P[6, 6],
        P[6, 7],
        P[7, 7],
        math.degrees(math.sqrt(P[2, 2])),
        *p_W[:2],
    )
    return [round(state.time, 4), *(round(float(value), 5) for value in values)]
