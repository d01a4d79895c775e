"""Legs between known positions: what is true of a recording without attitude.

Between two waypoints, or two instants of a position track, the displacement on the map is known but
for a yaw that the levelled IMU does not have. Stretches of levelled IMU with their legs are what a
network learns from such recordings (`stario.network.training.weak_truth`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import InputError
from stario.sequences.levelled_stream import levelled_streams
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, PositionTrack
from stario.sequences.windows import WINDOW_RATE

_TRACK_STEP = 2.0
"""Between the positions of a track that end its legs [s]."""

_SHORTEST_LEG, _FASTEST_LEG = 1.5, 2.5
"""Legs that are shorter [s] or faster [m/s] are a tap by mistake, or a ride."""

_FASTEST_STEP, _LONGEST_STEP = 6.0, 0.25
"""A track that moves faster between two samples [m/s] has jumped; a longer step [s] is a gap."""

_SLOW_STEP, _SLOWEST_STEP = 2.5, 3.0
"""Of a slow track, as satellites give, a gap is longer than so many usual steps, or than so long
[s]: a walker has turned by then."""

_TRACK_SIGMA = 0.15
"""Of a track's positions [m]: what carries the truth is not what carries the IMU."""

_TAP_SIGMA, _TAP_TIME = 0.4, 0.3
"""Of a waypoint's position [m], and of the time at which it is tapped [s]."""


@dataclass(frozen=True, eq=False)
class LegStream:
    """An unbroken stretch of levelled IMU with legs between known positions.

    Attributes:
        name: the recording's.
        kind: of the positions, "waypoints" or "positions".
        imu_N: (N, 6) float32, gyroscope [rad/s] and specific force [m/s^2] in N.
        facing_N: (N, 2) float32, which way the device faces.
        start: (M,) of the legs, from the stretch's beginning [s].
        stop: (M,) of them [s].
        displacement: (M, 3) of the legs on the map [m]; of waypoints on a level floor.
        sigma: deviation of each leg's ends (M, 2) [m].
    """

    name: str
    kind: str
    imu_N: NDArray[np.float32]
    facing_N: NDArray[np.float32]
    start: FloatArray
    stop: FloatArray
    displacement: FloatArray
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.imu_N)

    def part(self, start: int, stop: int) -> LegStream:
        """Samples from start to before stop, with the legs that lie within."""
        begin, end = start / WINDOW_RATE, max(stop, start) / WINDOW_RATE
        inside = (self.start >= begin) & (self.stop <= end)
        part = slice(start, max(stop, start))
        return LegStream(
            self.name,
            self.kind,
            self.imu_N[part],
            self.facing_N[part],
            self.start[inside] - begin,
            self.stop[inside] - begin,
            self.displacement[inside],
            self.sigma[inside],
        )


def leg_streams(sequence: ImuSequence, min_seconds: float = 12.0) -> list[LegStream]:
    """Cut a recording with known positions into unbroken stretches with two legs at least.

    Args:
        sequence: with positions or waypoints.
        min_seconds: shorter stretches are left out [s].

    Raises:
        InputError: it has no known positions, or its rate is not accepted.
    """
    if sequence.positions is None:
        raise InputError(f"{sequence.name}: positions", "none", "positions or waypoints")
    start, stop, displacement, sigma = _legs(sequence.positions)
    streams = []
    for stream in levelled_streams(sequence, min_seconds):
        begin, end = stream.start, stream.start + len(stream) / WINDOW_RATE
        inside = (start >= begin) & (stop <= end)
        if inside.sum() < 2:
            continue
        streams.append(
            LegStream(
                sequence.name,
                sequence.positions.kind,
                stream.imu_N,
                stream.facing_N,
                start[inside] - begin,
                stop[inside] - begin,
                displacement[inside],
                sigma[inside],
            )
        )
    return streams


def broken_steps(time: FloatArray, position: FloatArray) -> BoolArray:
    """Which steps (N - 1,) of a position track are gaps, or jumps of what gave the positions.

    Args:
        time: (N,) [s].
        position: (N, 2 or 3) [m].
    """
    step = np.diff(time)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / step
    return np.asarray((speed > _FASTEST_STEP) | (step > _longest_step(step)))


def _longest_step(step: FloatArray) -> float:
    """Of a track with these steps (n,) the longest that is no gap [s]."""
    if not len(step):
        return _LONGEST_STEP
    return max(_LONGEST_STEP, min(_SLOW_STEP * float(np.median(step)), _SLOWEST_STEP))


def _ticks(time: FloatArray) -> NDArray[np.int64]:
    """Which of the times (n,) [s] make steps of `_TRACK_STEP`, or of more across a gap."""
    if not len(time):
        return np.zeros(0, dtype=np.int64)
    whole = np.floor((time - time[0]) / _TRACK_STEP)
    return np.flatnonzero(np.diff(whole, prepend=-1.0) > 0.0)


def _legs(known: PositionTrack) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Start and stop (M,) [s], displacement (M, 3) [m] and the ends' deviations (M, 2) [m]."""
    time, position = known.time[known.valid], known.position_W[known.valid]
    if position.shape[1] == 2:
        position = np.column_stack([position, np.zeros(len(position))])
    if known.kind == "waypoints":
        ends = np.arange(len(time))
        whole = np.ones(max(len(ends) - 1, 0), dtype=np.bool_)
    else:
        ends = _ticks(time)
        breaks = np.concatenate([[0], np.cumsum(broken_steps(time, position))])
        whole = np.diff(breaks[ends]) == 0
    start, stop = time[ends[:-1]], time[ends[1:]]
    displacement = np.diff(position[ends], axis=0)
    speed = np.linalg.norm(displacement, axis=1) / (stop - start)
    keep = whole & (stop - start >= _SHORTEST_LEG) & (speed <= _FASTEST_LEG)
    if known.kind == "waypoints":
        sigma = np.hypot(_TAP_SIGMA, _TAP_TIME * speed)
    else:
        sigma = np.full(len(speed), _TRACK_SIGMA)
    ends_sigma = np.stack([sigma, sigma], axis=1)
    return start[keep], stop[keep], displacement[keep], ends_sigma[keep]
