"""Training data of recordings: read, checked, cut into streams and kept in the cache.

A file of the cache holds the streams of a recording in the layout of safetensors: a header, then
the numbers of all of them, which are memory-mapped, so that they need no memory. It gets its name
only when it is complete: a killed writer leaves nothing that would be read, and if two write at
once, the second replaces the first's file by the same content. The folder may be deleted at any
time.

A file's name begins with a digest of the code that its content depends on. The rest depends on a
key: for a recording, its path, the names, sizes and modification times of its files, and the
options it is read with. Hashing the files' bytes instead would read 100 hours of recordings, and
the images next to some of them, at every start; it would detect only one more case: a file replaced
by one of the same size and modification time.
"""

from __future__ import annotations

import hashlib
import importlib.resources
import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from stario.sequences.datasets.batch import Skipped, each, skipped
from stario.sequences.errors import InputError, StarioError
from stario.sequences.files import atomic_write, remove_abandoned
from stario.sequences.inspection.checks import check_units
from stario.sequences.legs import LegStream, leg_streams
from stario.sequences.readers import FORMATS
from stario.sequences.readers.archive import split_name
from stario.sequences.readers.published.oxiod import capture_file
from stario.sequences.sequence import ImuSequence, low_rate_message
from stario.sequences.truth.problems import check_truth
from stario.sequences.windows import Attitude, WorldStream, world_streams

Stream = WorldStream | LegStream
"""Training data of a network: with poses, or with legs between known positions."""

log = logging.getLogger(__name__)

_POSES = "poses"

_ABANDONED_S = 3600.0

_OPEN_FILES = 10_240
"""Number of open files to ask for where a system states no limit; macOS allows no more."""

_SUFFIX = ".streams"

_UNUSED_S = 30 * 86_400.0
"""Time after which a file of other code that nobody has read is removed [s]."""

_UNRELATED = (
    "accuracy/",
    "drawing/",
    "inspection/magnetic.py",
    "inspection/report.py",
    "inspection/stillness.py",
)
"""Parts of this package that nothing in the cache depends on."""


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
    file = _cache_file(folder, key)
    streams = _kept(file, build)
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
    files, options = recording_stamps(path), {**options, "attitude": attitude}
    file = _cache_file(folder, {"path": str(path.resolve()), "files": files, "options": options})
    streams = _kept(file, lambda: _streams(read(path), attitude))
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


def _kept(file: Path, build: Callable[[], Sequence[Stream]]) -> Sequence[Stream] | None:
    """Build what a file lacks and write it there; return it if it could not be, None if it was."""
    if _opened(file) is not None:
        return None
    built = build()
    return None if _written(file, built) else built


def _written(file: Path, streams: Sequence[Stream]) -> bool:
    """Write streams to the cache; return False, with a warning, if they cannot be written."""
    if not streams:
        return False
    kinds = [{"name": stream.name, "kind": getattr(stream, "kind", _POSES)} for stream in streams]
    arrays = {
        f"{k} {name}": np.ascontiguousarray(value)  # a slice would be written wrongly
        for k, stream in enumerate(streams)
        for name, value in vars(stream).items()
        if isinstance(value, np.ndarray)
    }
    content = safetensors.numpy.save(arrays, metadata={"streams": json.dumps(kinds)})
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(file.parent, _ABANDONED_S, file.name)
        _remove_unused(file.parent)
        with atomic_write(file, "wb") as target:
            target.write(content)
    except (OSError, InputError) as error:
        log.warning("%s: windows are not kept for the next run: %s", file.parent, error)
        return False
    return True


def _opened(file: Path) -> list[Stream] | None:
    """Return memory-mapped streams, or None if the file is missing or incomplete."""
    try:
        mapped = np.memmap(file, dtype=np.uint8, mode="r")  # once: each map keeps a file open
        begin = 8 + int.from_bytes(mapped[:8].tobytes(), "little")
        header = json.loads(mapped[8:begin].tobytes())
        kinds = json.loads(header.pop("__metadata__")["streams"])
        if len(mapped) != begin + max(tensor["data_offsets"][1] for tensor in header.values()):
            raise ValueError(f"{len(mapped)} bytes")
        arrays: list[dict[str, NDArray[Any]]] = [{} for _ in kinds]
        for label, tensor in header.items():
            k, name = label.split()
            arrays[int(k)][name] = _array(mapped[begin:], tensor)
        return [_stream(*both) for both in zip(kinds, arrays, strict=True)]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, LookupError, TypeError) as error:
        log.warning("%s: incomplete, will be rebuilt: %s", file, error)
        return None


def _array(content: NDArray[np.uint8], tensor: Mapping[str, Any]) -> NDArray[Any]:
    begin, stop = tensor["data_offsets"]
    dtype = {"F32": "<f4", "F64": "<f8", "I64": "<i8"}[tensor["dtype"]]
    return np.asarray(content[begin:stop].view(dtype).reshape(tensor["shape"]))


def _stream(known: dict[str, Any], arrays: dict[str, Any]) -> Stream:
    if known["kind"] == _POSES:
        return WorldStream(known["name"], **arrays)
    return LegStream(**known, **arrays)


def cache_folder() -> Path:
    """Return the folder `STARIO_CACHE`, else `stario` in `XDG_CACHE_HOME`, else in `~/.cache`."""
    if named := os.environ.get("STARIO_CACHE"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stario"


def _cache_file(folder: Path, key: Mapping[str, object]) -> Path:
    """Return the file of a key: plain values that determine its content, besides this code."""
    text = json.dumps(key, sort_keys=True, default=str)
    digest = hashlib.blake2b(text.encode(), digest_size=20).hexdigest()
    return folder / f"{_code()}-{digest}{_SUFFIX}"


def recording_stamps(path: Path) -> list[tuple[str, int, int]]:
    """Return name, size and modification time [ns] of a recording's files: they tell changes."""
    return [
        (str(file), stat.st_size, stat.st_mtime_ns)
        for file in recording_files(path)
        for stat in (file.stat(),)
    ]


def _remove_unused(folder: Path) -> None:
    """Remove files that other code has written and that have not been read for 30 days."""
    for file in folder.iterdir():
        if file.suffix == _SUFFIX and not file.name.startswith(_code()):
            with suppress(OSError):  # another process has removed it, or has it open on Windows
                stat = file.stat()
                if time.time() - max(stat.st_atime, stat.st_mtime) > _UNUSED_S:
                    file.unlink()


def recording_files(path: Path) -> list[Path]:
    """Return the files that a recording is read from, and possibly others next to them."""
    path, member = split_name(path)
    if member is not None:
        return [path]
    while path != path.parent and _is_recording(path.parent, path.parent.stat().st_mtime_ns):
        path = path.parent  # imu0/data.csv belongs to the folder that also holds its truth
    if path.is_dir():
        return sorted(p for p in path.rglob("*") if p.is_file())
    if any(FORMATS[name].recognises(path) for name in ("phone", "wide")):
        return sorted(p for p in path.parent.iterdir() if p.is_file())  # other sensors, poses
    if not FORMATS["oxiod"].recognises(path):
        return [path]
    number = "".join(filter(str.isdigit, path.stem))
    siblings = (p for p in path.parent.iterdir() if p.suffix == path.suffix and p.is_file())
    same_number = {p for p in siblings if "".join(filter(str.isdigit, p.stem)) == number}
    return sorted(same_number | set(filter(None, [capture_file(path)])))


@cache
def _is_recording(folder: Path, changed_ns: int) -> bool:
    """Return whether a folder is a recording; cached, as it may hold thousands of files."""
    return any(known.recognises(folder) for known in FORMATS.values())


@cache
def _code() -> str:
    """Return a digest of the code, so that files of other versions are not reused."""
    digest = hashlib.blake2b(digest_size=6)
    for file in code_files():
        digest.update(file.read_bytes())
    return digest.hexdigest()


def code_files() -> list[Path]:
    """Return the source files that the cache depends on: readers, levelling, simulation, ..."""
    folder = Path(str(importlib.resources.files("stario.sequences")))
    return sorted(
        file
        for file in folder.rglob("*.py")
        if not file.relative_to(folder).as_posix().startswith(_UNRELATED)
    )
