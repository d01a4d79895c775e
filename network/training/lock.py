"""Exclusive use of a run's folder: two runs in it would overwrite each other's files."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from stario.sequences.errors import ConfigError, InputError
from stario.sequences.files import remove_abandoned

LOCK_FILE = ".lock"
"""Stays in the folder: removing it could let two runs lock two files of that name."""

_ABANDONED_S = 600.0
"""Age of temporary files that are removed [s]: without locks, younger ones may be in use."""
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Create a run's folder and keep other runs out of it within the block.

    The system releases the lock when the process ends, even if it is killed. Where it has none
    (Windows, some network drives), runs are not kept apart. Temporary files that killed runs have
    left are removed.

    Raises:
        ConfigError: another run is using the folder.
        InputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK_FILE).open("ab")
    except OSError as error:
        found = f"{folder}: {error.strerror or error}"
        raise InputError("folder", found, "a writable folder", "choose another (--out)") from error
    with file:
        _lock(file, folder)
        remove_abandoned(folder, _ABANDONED_S)
        yield


def _lock(file: IO[bytes], folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _TAKEN:
            return
        raise ConfigError(
            "folder",
            f"{folder}, in which another run is training",
            "a folder for this run alone",
            "wait for that run or train into another folder (--out)",
        ) from error
