"""Legs between known positions: ground truth for recordings without a true attitude.

The displacement between two waypoints, or two instants of a position track, is known in the map
frame, but its yaw relative to the levelled IMU is not. From such recordings a network learns on
stretches of levelled IMU samples with their legs (`stario.network.training.losses`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError
from stario.sequences.levelled_stream import levelled_streams
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, PositionTrack
from stario.sequences.windows import WINDOW_RATE

_SHORTEST_STRETCH = 12.0
"""Minimum length of a stretch [s]."""

_TRACK_STEP = 2.0
"""Time between the positions of a track that delimit its legs [s]."""

_SHORTEST_LEG, _FASTEST_LEG = 1.5, 2.5
"""Shorter legs [s] and faster legs [m/s] are rejected: mistaken taps, and rides."""

_FASTEST_STEP, _MAX_STEP = 6.0, 0.25
"""A faster step between two samples [m/s] is a jump of the track; a longer step [s] is a gap."""

_JUMP_SIGMAS = 3.0
"""Shorter jumps, in standard deviations that the source states, are noise."""

_SLOW_STEP, _SLOWEST_STEP = 2.5, 3.0
"""In a low-rate track, for example from GNSS, a gap is longer than this many median steps or than
this many seconds, whichever is less: a pedestrian has turned by then."""

_TRACK_SIGMA = 0.15
"""Sigma of a track's positions [m]: the reference device is not rigidly fixed to the IMU."""

_INDEPENDENT = 0.2
"""Share of the standard deviation a source states that differs from one position to the next. Those
of satellites share most of their error: stated as 3.1 m per axis, differences over 5 s were off by
0.8 m."""

_TAP_SIGMA, _TAP_TIME = 0.4, 0.3
"""Sigma of a waypoint's position [m], and of the time at which it is tapped [s]."""


@dataclass(frozen=True, eq=False, repr=False)
class LegStream:
    """Unbroken stretch of levelled IMU samples with legs between known positions.

    Attributes:
        name: name of the recording.
        kind: kind of the positions, "waypoints" or "positions".
        imu_N: (N, 6) float32, gyroscope [rad/s] and specific force [m/s^2] in N.
        facing_N: (N, 2) float32, facing direction of the device.
        start: (M,) start times of the legs [s], from the beginning of the stretch.
        stop: (M,) end times of the legs [s], likewise.
        displacement: (M, 3) displacements in the map frame [m]; z is 0 if positions are 2-D.
        sigma: (M, 2) standard deviations of the two ends of each leg [m].
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

    def __repr__(self) -> str:
        return f"LegStream({len(self)} samples and {len(self.start)} legs of {self.name})"

    def part(self, start: int, stop: int) -> LegStream:
        """Return samples [start, stop) and the legs that lie within them."""
        begin = start / WINDOW_RATE
        length = max(stop - start, 0) / WINDOW_RATE
        inside = (self.start >= begin) & (self.stop <= begin + length)
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


def leg_streams(sequence: ImuSequence) -> list[LegStream]:
    """Cut a recording with known positions into unbroken stretches with at least two legs.

    Raises:
        InputError: the recording has no known positions, its rate is not accepted, or it has the
            wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    if sequence.positions is None:
        raise InputError(f"{sequence.name}: positions", "none", "positions or waypoints")
    start, stop, displacement, sigma = _legs(sequence.positions)
    streams = []
    for stream in levelled_streams(sequence, _SHORTEST_STRETCH):
        legs = LegStream(
            sequence.name,
            sequence.positions.kind,
            stream.imu_N,
            stream.facing_N,
            start - stream.start,
            stop - stream.start,
            displacement,
            sigma,
        ).part(0, len(stream))
        if len(legs.start) >= 2:
            streams.append(legs)
    return streams


def gaps_and_jumps(time: FloatArray, position: FloatArray) -> BoolArray:
    """Return which steps (N - 1,) of a position track are gaps, or jumps of the position source.

    Args:
        time: (N,) [s].
        position: (N, 2 or 3) [m].
    """
    step = np.diff(time)
    usual = float(np.median(step)) if len(step) else 0.0
    longest = max(_MAX_STEP, min(_SLOW_STEP * usual, _SLOWEST_STEP))
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / step
    return np.asarray((speed > _FASTEST_STEP) | (step > longest))


def jumps(known: PositionTrack) -> FloatArray:
    """Return the lengths [m] of steps that no pedestrian took, far beyond the sigma stated."""
    if known.sigma is None or known.kind == "waypoints":
        return np.empty(0)
    time, position, sigma = (x[known.valid] for x in (known.time, known.position_W, known.sigma))
    length = np.linalg.norm(np.diff(position, axis=0), axis=1)
    fast = length > _FASTEST_STEP * np.diff(time)
    return np.asarray(length[fast & (length > _JUMP_SIGMAS * np.hypot(sigma[1:], sigma[:-1]))])


def _legs(known: PositionTrack) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return start, stop (M,) [s], displacement (M, 3) [m] and sigma of the ends (M, 2) [m]."""
    time, position = known.time[known.valid], known.position_W[known.valid]
    if position.shape[1] == 2:
        position = np.column_stack([position, np.zeros(len(position))])
    if known.kind == "waypoints":
        ends = np.arange(len(time))
        unbroken = np.ones_like(ends[1:], dtype=np.bool_)
    else:
        # The first position in each interval.
        whole = np.floor((time - time[:1]) / _TRACK_STEP)
        ends = np.flatnonzero(np.diff(whole, prepend=-1.0) > 0.0)
        breaks = np.concatenate([[0], np.cumsum(gaps_and_jumps(time, position))])
        unbroken = np.diff(breaks[ends]) == 0
    start, stop = time[ends[:-1]], time[ends[1:]]
    displacement = np.diff(position[ends], axis=0)
    speed = np.linalg.norm(displacement, axis=1) / (stop - start)
    keep = unbroken & (stop - start >= _SHORTEST_LEG) & (speed <= _FASTEST_LEG)
    sigma = _ends_sigma(known, ends, speed)
    return start[keep], stop[keep], displacement[keep], sigma[keep]


def _ends_sigma(known: PositionTrack, ends: NDArray[np.int64], speed: FloatArray) -> FloatArray:
    """Return the standard deviations (M, 2) [m] of the ends of legs of speeds (M,) [m/s].

    `ends` (M + 1,) are the valid positions that delimit them.
    """
    taps = known.kind == "waypoints"
    if known.sigma is None:
        sigma = np.full(len(ends), _TAP_SIGMA if taps else _TRACK_SIGMA)
    else:
        stated = known.sigma[known.valid][ends]
        sigma = stated if taps else np.maximum(_INDEPENDENT * stated, _TRACK_SIGMA)
    of_legs = np.stack([sigma[:-1], sigma[1:]], axis=1)
    return np.hypot(of_legs, _TAP_TIME * speed[:, None]) if taps else of_legs
