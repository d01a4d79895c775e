"""Atomic writing of results, complete or not at all, and folders for them."""

from __future__ import annotations

import errno
import itertools
import json
import math
import os
import secrets
import shutil
import time
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from stario.sequences.errors import InputError


def opened(path: Path) -> IO[bytes]:
    """Open a file for reading its bytes.

    Raises:
        OSError: it cannot be read, or is a pipe or a device, for whose content a reader would wait.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "A pipe or device", str(path))
    return path.open("rb")


def opened_text(path: Path) -> str:
    """Return a file's text in UTF-8, without its mark; raises what `opened` does, or ValueError."""
    with opened(path) as file:
        return file.read().decode("utf-8-sig")


@contextmanager
def atomic_write(path: Path | str, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file that appears under its name only when it is complete.

    The content goes to a temporary file in the same folder, which replaces `path` at the end of the
    block; an exception in the block leaves `path` unchanged and no temporary file behind.

    Args:
        path: the file to write or replace; its folder must exist.
        mode: "w" for text (UTF-8, Unix line ends), "wb" for bytes.

    Raises:
        InputError: the folder does not exist, `path` is a folder, or the system refuses to write
            there.
    """
    text: dict[str, str] = {} if "b" in mode else {"encoding": "utf-8", "newline": "\n"}
    with atomic_path(path) as temporary:
        # Exclusive creation, unlike `tempfile`, leaves the permissions to the user's umask.
        exclusive = mode.replace("w", "x")
        with temporary.open(exclusive, **text) as file:  # type: ignore[call-overload]
            yield file
            file.flush()
            os.fsync(file.fileno())


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path for libraries that open files themselves; else as `atomic_write`."""
    path = Path(path)
    with suppress(OSError):  # such as of a name that is too long, which is told below
        path = path.resolve() if path.is_symlink() else path  # the link itself stays
    with temporary_path(path, "a file") as temporary:
        if path.exists() and not path.is_file():
            kind = "folder" if path.is_dir() else "device or pipe"
            raise InputError("path", f"the {kind} {path}", "a file")
        yield temporary
        temporary.replace(path)


@contextmanager
def atomic_folder(path: Path | str, replaced: Container[str] = ()) -> Iterator[Path]:
    """Create a folder that appears under its name only when it is complete.

    The block fills a temporary folder next to `path`, which is renamed to `path` at the end; an
    exception in the block leaves nothing behind.

    Args:
        path: the folder to create; it may exist already if it holds no other files than `replaced`.
        replaced: files in the folder that may be replaced, relative to it.

    Raises:
        InputError: `path` is a file or a folder with other files, its parent does not exist, or the
            system refuses to write there.
    """
    path = Path(path)
    with temporary_path(path, "a folder") as temporary:
        if path.exists():
            _check_replaceable(path, replaced)
        temporary.mkdir()
        yield temporary
        if path.exists():
            shutil.rmtree(path)
        temporary.rename(path)


def _check_replaceable(path: Path, replaced: Container[str]) -> None:
    """Check that a path is a folder without other files than `replaced`."""
    if not path.is_dir():
        raise InputError("path", f"the file {path}", "a folder, new or empty")
    for other in sorted(path.rglob("*")):
        if not other.is_dir() and other.relative_to(path).as_posix() not in replaced:
            found = f"{other}, which would be lost"
            raise InputError("path", found, "a new or empty folder", "choose another folder")


@contextmanager
def temporary_path(path: Path, kind: str) -> Iterator[Path]:
    """Yield a path next to `path`, removed after an exception; `OSError`s get a remedy."""
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"
    try:
        if not path.parent.is_dir():
            expected = f"{kind} in an existing folder"
            raise InputError("path", str(path), expected, "create the folder")
        try:
            yield temporary
        except BaseException:
            if temporary.is_dir():
                shutil.rmtree(temporary, ignore_errors=True)
            else:
                temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        found = f"{path}: {error.strerror or error}"
        fix = "choose another folder, fix its permissions or free disk space"
        raise InputError("path", found, "a writable location", fix) from error


def check_folder(folder: Path) -> None:
    """Check a folder for results before any work that could not be written; create nothing.

    Raises:
        InputError: the folder, or one above it, is a file or cannot be written to.
    """
    existing = next(part for part in (folder, *folder.parents) if part.exists())
    if not existing.is_dir():
        raise InputError(str(existing), "a file", "a folder, new or existing")
    if not os.access(existing, os.W_OK):
        raise InputError(str(existing), "no permission to write", "a folder that can be written")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents.

    Raises:
        InputError: the path is taken by something else, or permission is denied.
    """
    check_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            str(folder), error.strerror or "an error", "a folder that can be created"
        ) from error


def remove_abandoned(folder: Path, seconds: float, name: str = "*") -> None:
    """Remove temporary files that killed writers have left; younger ones may be in use.

    Args:
        folder: the folder of the files that were to be written.
        seconds: age from which a temporary file counts as left behind [s].
        name: name of the file that was to be written, or a pattern.
    """
    for temporary in folder.glob(f".{name}.*.tmp"):
        with suppress(FileNotFoundError):  # its writer has just finished
            if time.time() - temporary.stat().st_mtime > seconds:
                temporary.unlink()


def unused_name(name: str, taken: Container[str]) -> str:
    """Return the name, or the first of name-2, name-3, ... that is not taken."""
    names = (f"{name}-{k}" if k > 1 else name for k in itertools.count(1))
    return next(candidate for candidate in names if candidate not in taken)


def write_json(path: Path | str, obj: object) -> None:
    """Write JSON, indented by 2, keys in their order; NaN and infinity become null.

    NumPy numbers and arrays, dataclasses and paths are written as their plain counterparts.

    Raises:
        InputError: the object holds another type, or the folder does not exist.
    """
    with atomic_write(path) as file:
        file.write(json_text(obj))


def json_text(obj: object) -> str:
    """Return the text that `write_json` writes; raises what that does for the object."""
    return json.dumps(_plain(obj), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_npz(path: Path | str, **arrays: ArrayLike) -> None:
    """Write arrays to a compressed npz, exactly at `path`, without pickling.

    Raises:
        InputError: an array holds objects, or the folder does not exist.
    """
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    for name, value in plain.items():
        if value.dtype.hasobject:
            raise InputError(name, f"dtype {value.dtype}", "numbers, bool or text")
    with atomic_write(path, "wb") as file:
        np.savez_compressed(file, **plain)  # type: ignore[arg-type]


def _plain(obj: object) -> object:
    """Convert `obj` to JSON's own types."""
    if is_dataclass(obj) and not isinstance(obj, type):
        return _plain(asdict(obj))
    if isinstance(obj, dict):
        return {str(key): _plain(value) for key, value in obj.items()}
    if isinstance(obj, (list, tuple)):
        return [_plain(value) for value in obj]
    if isinstance(obj, (np.ndarray, np.generic)):
        return _plain(obj.tolist())
    if isinstance(obj, Path):
        return str(obj)
    if isinstance(obj, float):
        return obj if math.isfinite(obj) else None
    if obj is None or isinstance(obj, (bool, int, str)):
        return obj
    raise InputError("JSON value", type(obj).__name__, "numbers, text, lists and dictionaries")
