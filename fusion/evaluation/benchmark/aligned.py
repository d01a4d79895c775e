"""Recordings aligned with their truth, at ticks, for the benchmark of networks; cached on disk.

Everything here depends on the recording alone, so several sets of weights share it, and later calls
read it from the cache.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.datasets.array_cache import Part, read_parts, write_parts
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.datasets.cache_files import recording_file
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding, warn
from stario.sequences.inspection.checks import check_units
from stario.sequences.inspection.constant_values import dead_axes
from stario.sequences.legs import gaps_and_jumps
from stario.sequences.levelled_stream import LevelledStream, levelled_streams
from stario.sequences.sequence import (
    BoolArray,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
    is_gap,
)
from stario.sequences.truth.problems import truth_findings

Kind = Literal["poses", "positions", "waypoints"]

Complex = np.ndarray[tuple[int], np.dtype[np.complex128]]
"""Horizontal positions or vectors x + iy."""

_SHARED = ("name", "kind", "attributes", "problems")
_STREAM = ("imu_N", "facing_N", "R_NB")
_TRUTH = ("position_W", "breaks", "yaw_WN", "waypoint_time", "waypoint_W")
_COMPLEX = ("position_W", "waypoint_W")


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
        problems: findings about its ground truth.
    """

    path: Path
    name: str
    kind: Kind
    attributes: dict[str, str]
    pieces: list[AlignedPiece]
    problems: tuple[Finding, ...]


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
    problems = tuple(truth_findings(sequence))
    return Aligned(path, sequence.name, kind, attributes, pieces, problems)


def aligned_recordings(
    paths: Sequence[Path],
    read: Callable[[Path], ImuSequence],
    options: dict[str, object],
    folder: Path,
    jobs: int | None = 1,
) -> Iterator[Aligned | Skipped]:
    """Yield each recording aligned, from the cache or newly read, in the order of the paths.

    Args:
        paths: paths of the recordings.
        read: function that reads a path; must be picklable.
        options: plain values that the result of `read` depends on besides the path.
        folder: folder of the cache.
        jobs: number of processes, as for `stario.sequences.datasets.batch.each`.
    """
    work = partial(_cached, read=read, options=options, folder=folder)
    yield from each(work, paths, jobs)


def _cached(
    path: Path, read: Callable[[Path], ImuSequence], options: dict[str, object], folder: Path
) -> Aligned:
    file = recording_file(folder, path, {**options, "preparation": _code()})
    parts = read_parts(file)
    if parts is None:
        parts = _parts(aligned_recording(read(path), path))
        write_parts(file, parts)
    found = _from_parts(path, parts)
    warn(found.name, found.problems)
    return found


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


@cache
def _code() -> str:
    """Return a digest of this module, so that files of its other versions are not reused."""
    return hashlib.blake2b(Path(__file__).read_bytes(), digest_size=20).hexdigest()


def _parts(aligned: Aligned) -> list[Part]:
    shared = {name: getattr(aligned, name) for name in _SHARED}
    shared["problems"] = [asdict(found) for found in aligned.problems]
    parts = []
    for piece in aligned.pieces:
        arrays = {name: getattr(piece.stream, name) for name in _STREAM}
        arrays |= {name: getattr(piece, name) for name in _TRUTH}
        for name in _COMPLEX:  # the file's format has no double complex numbers
            arrays[name] = arrays[name].view(np.float64)
        parts.append(({**shared, "start": piece.stream.start}, arrays))
    return parts


def _from_parts(path: Path, parts: Sequence[Part]) -> Aligned:
    pieces = []
    for values, arrays in parts:
        arrays = arrays | {name: arrays[name].view(np.complex128) for name in _COMPLEX}
        stream = LevelledStream(values["start"], *(arrays[name] for name in _STREAM))
        pieces.append(AlignedPiece(stream, *(arrays[name] for name in _TRUTH)))
    name, kind, attributes, problems = (parts[0][0][key] for key in _SHARED)
    return Aligned(
        path, name, kind, attributes, pieces, tuple(Finding(**each) for each in problems)
    )
