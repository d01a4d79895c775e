"""Recordings aligned with their truth at ticks, and a network's predictions along them.

The alignment depends on the recording alone: several sets of weights share it. A network predicts
along the IMU's own levelled attitude. Windows overlap by half: each contributes the mean velocity
over its second, and the velocity between two ticks is the mean over the windows that cover them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.imu.direction import Complex
from stario.fusion.imu.stateful import Predictor, StatefulInference
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError
from stario.sequences.findings import warn
from stario.sequences.inspection.checks import check_units
from stario.sequences.inspection.constant_values import dead_axes
from stario.sequences.legs import gaps_and_jumps
from stario.sequences.levelled_stream import TICK_SECONDS, LevelledStream, levelled_streams
from stario.sequences.sequence import (
    BoolArray,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
    is_gap,
)
from stario.sequences.truth.problems import warn_of_truth
from stario.sequences.windows import WINDOW_SECONDS

Kind = Literal["poses", "positions", "waypoints"]

UPDATES = round(WINDOW_SECONDS / TICK_SECONDS)
"""Number of windows that begin within the length of one."""

_BATCH = 128


@dataclass(frozen=True, eq=False)
class AlignedPiece:
    """An unbroken stretch of a recording with its ground truth at the stream's K ticks.

    Attributes:
        stream: IMU, levelled without the truth.
        position_W: (K,) horizontal position x + iy [m]; NaN where unknown, and for waypoints.
        breaks: (K,) number of gaps and jumps of the truth before each tick: a displacement between
            two ticks is known if both have the same number.
        yaw_WN: (K,) yaw [rad] that rotates N to the true world; NaN where the attitude is unknown.
        waypoint_time: (W,) times of the waypoints [s].
        waypoint_W: (W,) positions x + iy of the waypoints [m].
    """

    stream: LevelledStream
    position_W: Complex
    breaks: np.ndarray[tuple[int], np.dtype[np.int64]]
    yaw_WN: FloatArray
    waypoint_time: FloatArray
    waypoint_W: Complex


@dataclass(frozen=True, eq=False)
class Aligned:
    """A recording aligned with its truth, for the benchmark of networks.

    Attributes:
        path: path as given.
        name: name of the recording.
        kind: kind of its ground truth.
        attributes: person, device, place and similar, where known.
        pieces: its unbroken stretches.
    """

    path: Path
    name: str
    kind: Kind
    attributes: dict[str, str]
    pieces: list[AlignedPiece]


def aligned_recording(sequence: ImuSequence, path: Path) -> Aligned:
    """Level a recording and resample its truth at the ticks.

    Raises:
        InputError: there is no truth of any kind, or only one pose or position of it is valid, no
            unbroken stretch of 2 s, or a wrong unit.
    """
    check_units(sequence)
    warn(sequence.name, dead_axes(sequence))
    streams = levelled_streams(sequence)
    if not streams:
        raise InputError(f"{sequence.name}: samples", "no unbroken stretch", "one of 2 s")
    known = sequence.truth or sequence.positions
    if known is not None and known.valid.sum() < 2:
        raise InputError(f"{sequence.name}: truth", f"{known.valid.sum()} valid", "two or more")
    if sequence.truth is not None:
        kind: Kind = "poses"
        pieces = [_with_poses(stream, sequence.truth) for stream in streams]
    elif sequence.positions is not None:
        track = sequence.positions
        kind = track.kind
        if kind == "waypoints":
            pieces = [_with_waypoints(stream, track) for stream in streams]
        else:
            at = track.time[track.valid], track.position_W[track.valid]
            pieces = [_with_known(stream, *at, gaps_and_jumps(*at)) for stream in streams]
    else:
        raise InputError(f"{sequence.name}: truth", "none", "poses, positions or waypoints")
    attributes = {name: str(value) for name, value in sequence.attributes.items()}
    warn_of_truth(sequence)
    return Aligned(path, sequence.name, kind, attributes, pieces)


def aligned_recordings(
    paths: Sequence[Path], read: Callable[[Path], ImuSequence], jobs: int | None = 1
) -> Iterator[Aligned | Skipped]:
    """Yield each recording aligned, in order; `read` is picklable, `jobs` is as for `each`."""
    return each(partial(_read_aligned, read=read), paths, jobs)


def _read_aligned(path: Path, read: Callable[[Path], ImuSequence]) -> Aligned:
    return aligned_recording(read(path), path)


def _with_poses(stream: LevelledStream, truth: Trajectory) -> AlignedPiece:
    time, position_W = truth.time[truth.valid], truth.position_W[truth.valid]
    piece = _with_known(stream, time, position_W, is_gap(np.diff(time)))
    attitude = truth.at(stream.ticks).attitude_WB
    yaw_WN = yaw_of(attitude * Rotation.from_matrix(stream.R_NB).inv())
    yaw_WN[np.isnan(piece.position_W)] = np.nan
    return replace(piece, yaw_WN=yaw_WN)


def _with_known(
    stream: LevelledStream, time: FloatArray, position_W: FloatArray, bad: BoolArray
) -> AlignedPiece:
    """Interpolate positions (n, 2 or 3) to the ticks, except across bad steps (n - 1,)."""
    ticks = stream.ticks
    before = np.searchsorted(time, ticks, side="right") - 1
    inside = (before >= 0) & (before < len(bad))
    inside[inside] = ~bad[before[inside]]
    xy = np.interp(ticks, time, position_W[:, 0]) + 1j * np.interp(ticks, time, position_W[:, 1])
    breaks = np.searchsorted(time[1:][bad], ticks, side="right")
    none = np.empty(0)
    unknown = np.full(len(ticks), np.nan)
    position = np.where(inside, xy, complex(np.nan, np.nan))
    return AlignedPiece(stream, position, breaks, unknown, none, none.astype(complex))


def _with_waypoints(stream: LevelledStream, track: PositionTrack) -> AlignedPiece:
    inside = track.valid & (track.time >= stream.ticks[0]) & (track.time <= stream.ticks[-1])
    count = len(stream.R_NB)
    return AlignedPiece(
        stream,
        np.full(count, complex(np.nan, np.nan)),
        np.zeros(count, dtype=np.int64),
        np.full(count, np.nan),
        track.time[inside],
        track.position_W[inside, 0] + 1j * track.position_W[inside, 1],
    )


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of a network for the M windows of a piece.

    Attributes:
        displacement_N: (M, 3) displacement over the second from tick m [m].
        covariance_N: (M, 3, 3) covariance [m^2].
    """

    displacement_N: FloatArray
    covariance_N: FloatArray

    def track(self) -> Complex:
        """Return the horizontal position x + iy (M + 2,) [m] at the ticks, 0 at the first."""
        steps = (self.displacement_N[:, 0] + 1j * self.displacement_N[:, 1]) / UPDATES
        cover = np.ones(UPDATES)
        total, count = np.convolve(steps, cover), np.convolve(np.ones(len(steps)), cover)
        return np.concatenate([[0.0], np.cumsum(total / count)])


@runtime_checkable
class RecordingPredictor(Protocol):
    """Predictor of a whole recording that needs no network."""

    def predictions(self, recording: Aligned) -> list[Predictions]:
        """Return a predictor's predictions for every piece, in N; a network begins each anew."""
        ...


def predictions(model: Predictor | RecordingPredictor, recording: Aligned) -> list[Predictions]:
    """Return a network's predictions for every piece of a recording, in frame N.

    Args:
        model: network, its memory reset at every piece; or another predictor.
        recording: the recording, aligned with its truth.
    """
    if isinstance(model, RecordingPredictor):
        return model.predictions(recording)
    return [predict_stream(model, piece.stream) for piece in recording.pieces]


def predict_stream(model: Predictor, stream: LevelledStream) -> Predictions:
    """Return a network's predictions along an unbroken stretch, in frame N."""
    network = StatefulInference(model, UPDATES)
    windows, heading = stream.windows(), stream.headings
    parts = [
        network.predict(windows[first : first + _BATCH], heading[first : first + _BATCH])
        for first in range(0, len(windows), _BATCH)
    ]
    displacement, covariance = zip(*parts, strict=True)
    return Predictions(np.concatenate(displacement), np.concatenate(covariance))
