"""Training data of recordings: read, checked, cut into streams and kept in the cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stario.sequences.datasets.array_cache import Part, kept, read_parts
from stario.sequences.datasets.batch import Skipped, each, skipped
from stario.sequences.datasets.cache_files import cache_file, recording_file
from stario.sequences.errors import InputError, StarioError
from stario.sequences.inspection.checks import check_units
from stario.sequences.legs import LegStream, leg_streams
from stario.sequences.readers.archive import split_name
from stario.sequences.sequence import ImuSequence, low_rate_message
from stario.sequences.truth.problems import check_truth
from stario.sequences.windows import Attitude, WorldStream, world_streams

Stream = WorldStream | LegStream
"""Training data of a network: with poses, or with legs between known positions."""

_POSES = "poses"
_OPEN_FILES = 10_240
"""Number of open files to ask for where a system states no limit; macOS allows no more."""


def recorded(
    paths: Sequence[Path],
    read: Callable[[Path], ImuSequence],
    options: Mapping[str, object],
    folder: Path,
    jobs: int | None = None,
    attitude: Attitude = "levelled",
) -> Iterator[Sequence[Stream] | Skipped]:
    """Yield each recording's streams: from the cache, or read, checked and added to it.

    Args:
        paths: recordings with poses, positions or waypoints.
        read: picklable function that reads a path.
        options: everything that `read` depends on besides the path, as plain values.
        folder: cache folder, shared with the processes that read.
        jobs: number of processes, as for `stario.sequences.datasets.batch.each`.
        attitude: as for `world_streams`.
    """
    _allow_many_files()
    work = partial(_stored, read=read, options=dict(options), folder=folder, attitude=attitude)
    for path, outcome in zip(paths, each(work, paths, jobs), strict=True):
        # Worker processes return the name of a cache file rather than its content.
        streams = _opened(outcome) if isinstance(outcome, Path) else outcome
        if streams is None:
            try:
                streams = _streams(read(path), attitude)
            except StarioError as error:
                streams = skipped(path, error)
        yield streams


def _allow_many_files() -> None:
    """Raise the number of files that may be open: each recording keeps one, systems allow 1,024."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _OPEN_FILES if hard == resource.RLIM_INFINITY else hard
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def cached(
    key: Mapping[str, object], build: Callable[[], Sequence[Stream]], folder: Path
) -> Sequence[Stream]:
    """Return the cached streams of a key, or else build them and add them to the cache.

    The key has plain values that determine the result, except for this package's code.
    """
    file = cache_file(folder, key)
    streams = kept(file, build, _parts)
    return (_opened(file) or build()) if streams is None else streams


def _stored(
    path: Path,
    read: Callable[[Path], ImuSequence],
    options: Mapping[str, object],
    folder: Path,
    attitude: Attitude,
) -> Path | Sequence[Stream]:
    """Return a recording's cache file, or its streams if that cannot be written."""
    if not split_name(path)[0].exists():
        return _streams(read(path), attitude)
    file = recording_file(folder, path, {**options, "attitude": attitude})
    streams = kept(file, lambda: _streams(read(path), attitude), _parts)
    return file if streams is None else streams


def _streams(sequence: ImuSequence, attitude: Attitude) -> list[Stream]:
    check_units(sequence)
    if sequence.truth is None and sequence.positions is not None:
        legs = leg_streams(sequence)
        if not legs:
            raise InputError(
                f"{sequence.name}: {sequence.positions.kind}",
                "no unbroken stretch of 12 s with two legs",
                "legs of at least 1.5 s at walking speed",
            )
        return list(legs)
    check_truth(sequence)
    streams: list[Stream] = list(world_streams(sequence, attitude=attitude))
    if not streams:
        raise InputError(
            f"{sequence.name}: truth", "no unbroken stretch of 2 s", "a trajectory to train on",
            "" if sequence.truth is None else low_rate_message(sequence.truth),
        )  # fmt: skip
    return streams


def _parts(streams: Sequence[Stream]) -> list[Part]:
    return [
        (
            {"name": stream.name, "kind": getattr(stream, "kind", _POSES)},
            {name: value for name, value in vars(stream).items() if isinstance(value, np.ndarray)},
        )
        for stream in streams
    ]


def _opened(file: Path) -> list[Stream] | None:
    """Return memory-mapped streams, or None if the file is missing or incomplete."""
    parts = read_parts(file)
    return None if parts is None else [_stream(*part) for part in parts]


def _stream(values: dict[str, Any], arrays: dict[str, Any]) -> Stream:
    if values["kind"] == _POSES:
        return WorldStream(values["name"], **arrays)
    return LegStream(**values, **arrays)
