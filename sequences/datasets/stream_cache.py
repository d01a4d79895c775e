"""World-frame streams kept on disk: built once, then memory-mapped, so that they need no memory.

One file per recording and set of options, in the layout of safetensors: a header, then the numbers
of all stretches. A file takes its name only when it is whole, so a killed writer leaves nothing
that is read, and of two writers at once the second replaces the first by the same content. The
folder may be deleted at any time.

The key of a recording is its path, the name, size and modification time of its files, the
options it is read with, and the code that reads it. Hashing the files' bytes instead would read
100 hours of recordings, and the images beside some of them, at every start; what it would notice
besides is a file that was replaced by one of the same size and the same time.
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

from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError, StarioError
from stario.sequences.files import atomic_write
from stario.sequences.inspection.checks import check_units
from stario.sequences.legs import LegStream, leg_streams
from stario.sequences.readers import FORMATS
from stario.sequences.readers.archive import split_name
from stario.sequences.readers.published.oxiod import capture_file
from stario.sequences.sequence import ImuSequence, too_slow
from stario.sequences.windows import Attitude, WorldStream, world_streams

log = logging.getLogger(__name__)

Stream = WorldStream | LegStream
"""What a network learns from: with poses, or with legs between known positions."""

_TABLES = {"poses": ("imu_W", "position_W", "facing_W"), "legs": ("imu_N", "facing_N", "legs")}

_SUFFIX = ".streams"
_ABANDONED_S = 3600.0


def cache_folder() -> Path:
    """The folder `STARIO_CACHE`, or `stario` in `XDG_CACHE_HOME`, or in `~/.cache`."""
    if named := os.environ.get("STARIO_CACHE"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stario"


def recorded(
    paths: Sequence[Path],
    read: Callable[[Path], ImuSequence],
    options: Mapping[str, object],
    folder: Path,
    jobs: int | None = None,
    attitude: Attitude = "levelled",
) -> Iterator[list[Stream] | Skipped]:
    """The streams of each recording, from the cache or read, checked and put there.

    Args:
        paths: recordings with poses, positions or waypoints.
        read: how a path is read; can be pickled.
        options: what `read` depends on besides the path, as plain values.
        folder: the cache's; shared with the processes that read.
        jobs: processes, as for `stario.sequences.datasets.batch.each`.
        attitude: as for `world_streams`.
    """
    work = partial(_stored, read=read, options=dict(options), folder=folder, attitude=attitude)
    for path, outcome in zip(paths, each(work, paths, jobs), strict=True):
        # Another process hands over a file's name rather than what is in it.
        streams = _opened(outcome) if isinstance(outcome, Path) else outcome
        if streams is None:
            try:
                streams = _streams(read(path), attitude)
            except StarioError as error:
                streams = Skipped(str(path), str(error))
        yield streams


def cached(
    key: Mapping[str, object], build: Callable[[], Sequence[Stream]], folder: Path
) -> Sequence[Stream]:
    """What `build` returns, from the cache where something of this key is there.

    Args:
        key: plain values that say all that the result depends on, but for this package's code.
        build: makes the streams.
        folder: the cache's.
    """
    file = folder / (_digest({**key, "code": _code()}) + _SUFFIX)
    streams = _opened(file)
    if streams is not None:
        return streams
    built = build()
    return (_opened(file) if _written(file, built) else None) or built


def recording_key(path: Path, options: Mapping[str, object]) -> str:
    """Digest of what is made of a recording: of its files, what they are read with, the code.

    Args:
        path: that exists.
        options: what the result depends on besides the files and this package's code.
    """
    stamps = [
        (str(file), stat.st_size, stat.st_mtime_ns)
        for file in recording_files(path)
        for stat in (file.stat(),)
    ]
    return _digest(
        {"path": str(path.resolve()), "files": stamps, "options": options, "code": _code()}
    )


def recording_files(path: Path) -> list[Path]:
    """The files that a recording's content comes from, and perhaps others beside them."""
    path, member = split_name(path)
    if member is not None:
        return [path]
    while path != path.parent and _is_recording(path.parent, path.parent.stat().st_mtime_ns):
        path = path.parent  # imu0/data.csv belongs to the folder that holds its truth as well
    if path.is_dir():
        return sorted(p for p in path.rglob("*") if p.is_file())
    if any(FORMATS[name].recognises(path) for name in ("phone", "wide")):
        return sorted(p for p in path.parent.iterdir() if p.is_file())  # sensors, poses beside
    if not FORMATS["oxiod"].recognises(path):
        return [path]
    number = "".join(filter(str.isdigit, path.stem))
    siblings = (p for p in path.parent.iterdir() if p.suffix == path.suffix and p.is_file())
    alike = {p for p in siblings if "".join(filter(str.isdigit, p.stem)) == number}
    return sorted(alike | set(filter(None, [capture_file(path)])))


@cache
def _is_recording(folder: Path, changed_ns: int) -> bool:
    """Asked once for all the files of a folder, which may be thousands."""
    return any(known.recognises(folder) for known in FORMATS.values())


def _stored(
    path: Path,
    read: Callable[[Path], ImuSequence],
    options: Mapping[str, object],
    folder: Path,
    attitude: Attitude,
) -> Path | list[Stream]:
    """The cache's file of a recording, or its streams where nothing can be written."""
    if not split_name(path)[0].exists():
        return _streams(read(path), attitude)
    file = folder / (recording_key(path, {**options, "attitude": attitude}) + _SUFFIX)
    if _opened(file) is not None:
        return file
    streams = _streams(read(path), attitude)
    return file if _written(file, streams) else streams


def _streams(sequence: ImuSequence, attitude: Attitude) -> list[Stream]:
    check_units(sequence)
    if sequence.truth is None and sequence.positions is not None:
        legs = leg_streams(sequence)
        if not legs:
            raise InputError(
                f"{sequence.name}: {sequence.positions.kind}",
                "no two legs in an unbroken stretch of 12 s",
                "legs of 1.5 s and more at walking speed",
            )
        return list(legs)
    streams: list[Stream] = list(world_streams(sequence, attitude=attitude))
    if not streams:
        raise InputError(
            f"{sequence.name}: truth", "no unbroken stretch of 2 s", "a trajectory to learn from",
            "" if sequence.truth is None else too_slow(sequence.truth),
        )  # fmt: skip
    return streams


def _digest(key: Mapping[str, object]) -> str:
    text = json.dumps(key, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=20).hexdigest()


@cache
def _code() -> str:
    """Digest of this package: streams that other code has made are not found again."""
    digest = hashlib.blake2b(digest_size=20)
    for file in code_files():
        digest.update(file.read_bytes())
    return digest.hexdigest()


def code_files() -> list[Path]:
    """All that streams are made by: readers, levelling, windows, simulation."""
    return sorted(Path(str(importlib.resources.files("stario.sequences"))).rglob("*.py"))


def _written(file: Path, streams: Sequence[Stream]) -> bool:
    """Whether the streams could be put into the cache, which runs do without if need be."""
    if not streams:
        return False
    tables = [_tables(stream) for stream in streams]
    told = [
        {"name": s.name, "kind": getattr(s, "kind", "poses"), "rows": [len(v) for v in t.values()]}
        for s, t in zip(streams, tables, strict=True)
    ]
    content = safetensors.numpy.save(
        {name: np.concatenate([table[name] for table in tables]) for name in tables[0]},
        metadata={"streams": json.dumps(told)},
    )
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        _sweep(file)
        with atomic_write(file, "wb") as target:
            target.write(content)
    except (OSError, InputError) as error:
        log.warning("%s: windows are not kept for the next run: %s", file.parent, error)
        return False
    return True


def _sweep(file: Path) -> None:
    """Remove what killed writers of this file have left."""
    for left in file.parent.glob(f".{file.name}.*.tmp"):
        with suppress(FileNotFoundError):  # its writer has just finished
            if time.time() - left.stat().st_mtime > _ABANDONED_S:
                left.unlink()


def _tables(stream: Stream) -> dict[str, NDArray[Any]]:
    """A stream's numbers, by name; those of one name have their rows in common over streams."""
    if isinstance(stream, WorldStream):
        return {name: getattr(stream, name) for name in _TABLES["poses"]}
    legs = [stream.start, stream.stop, stream.displacement, stream.sigma]
    return {
        "imu_N": stream.imu_N,
        "facing_N": stream.facing_N,
        "legs": np.column_stack(legs).astype(np.float64),
    }


def _stream(name: str, kind: str, tables: Mapping[str, NDArray[Any]]) -> Stream:
    """The stream of `_tables`."""
    if kind == "poses":
        return WorldStream(name, **tables)
    legs = tables["legs"]
    return LegStream(
        name, kind, tables["imu_N"], tables["facing_N"],
        legs[:, 0], legs[:, 1], legs[:, 2:5], legs[:, 5:7],
    )  # fmt: skip


def _opened(file: Path) -> list[Stream] | None:
    """Streams whose numbers are read when they are used; None where the file is not whole."""
    try:
        size = file.stat().st_size
        with file.open("rb") as source:
            length = int.from_bytes(source.read(8), "little")
            header = json.loads(source.read(min(length, size)))
        told = json.loads(header.pop("__metadata__")["streams"])
        if size != 8 + length + max(tensor["data_offsets"][1] for tensor in header.values()):
            raise ValueError(f"{size} bytes")
        whole = {name: _mapped(file, 8 + length, tensor) for name, tensor in header.items()}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.warning("%s: not whole, built anew: %s", file, error)
        return None
    names = list(_TABLES["poses" if told[0]["kind"] == "poses" else "legs"])
    first = dict.fromkeys(names, 0)
    streams = []
    for one in told:
        rows = dict(zip(names, one["rows"], strict=True))
        tables = {name: whole[name][first[name] : first[name] + rows[name]] for name in names}
        first = {name: first[name] + rows[name] for name in names}
        streams.append(_stream(one["name"], one["kind"], tables))
    return streams


def _mapped(file: Path, begin: int, tensor: Mapping[str, Any]) -> NDArray[Any]:
    offset, shape = begin + tensor["data_offsets"][0], tuple(tensor["shape"])
    dtype = {"F32": "<f4", "F64": "<f8"}[tensor["dtype"]]
    return np.asarray(np.memmap(file, dtype=dtype, mode="r", offset=offset, shape=shape))
