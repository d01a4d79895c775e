"""Files of the cache: folder, names, and the removal of those that nobody uses any more.

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
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

from stario.sequences.readers import FORMATS
from stario.sequences.readers.archive import split_name
from stario.sequences.readers.published.oxiod import capture_file

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


def cache_folder() -> Path:
    """Return the folder `STARIO_CACHE`, else `stario` in `XDG_CACHE_HOME`, else in `~/.cache`."""
    if named := os.environ.get("STARIO_CACHE"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stario"


def cache_file(folder: Path, key: Mapping[str, object]) -> Path:
    """Return the file of a key: plain values that determine its content, besides this code."""
    text = json.dumps(key, sort_keys=True, default=str)
    digest = hashlib.blake2b(text.encode(), digest_size=20).hexdigest()
    return folder / f"{_code()}-{digest}{_SUFFIX}"


def recording_file(folder: Path, path: Path, options: Mapping[str, object]) -> Path:
    """Return the file of a recording; the options are all else that its content depends on."""
    key = {"path": str(path.resolve()), "files": recording_stamps(path), "options": options}
    return cache_file(folder, key)


def recording_stamps(path: Path) -> list[tuple[str, int, int]]:
    """Return name, size and modification time [ns] of a recording's files: they tell changes."""
    return [
        (str(file), stat.st_size, stat.st_mtime_ns)
        for file in recording_files(path)
        for stat in (file.stat(),)
    ]


def remove_unused(folder: Path) -> None:
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
