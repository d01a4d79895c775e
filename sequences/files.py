"""Atomic writing of results (complete or not at all), and tracks in TUM format."""

from __future__ import annotations

import csv
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import number_in
from stario.sequences.attitude.rotations import NORM_TOLERANCE
from stario.sequences.errors import InputError, ReadError
from stario.sequences.sequence import FloatArray, Trajectory

_TUM_FIELDS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


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
    """Yield a temporary path for libraries that open files themselves; else as `atomic_write`.

    Raises:
        InputError: the folder does not exist, `path` is a folder, or the system refuses to write
            there.
    """
    path = Path(path)
    with _temporary(path, "a file") as temporary:
        if path.is_dir():
            raise InputError("path", f"the folder {path}", "a file")
        yield temporary
        temporary.replace(path)


@contextmanager
def atomic_folder(path: Path | str) -> Iterator[Path]:
    """Create a folder that appears under its name only when it is complete.

    The block fills a temporary folder next to `path`, which is renamed to `path` at the end; an
    exception in the block leaves nothing behind.

    Args:
        path: the folder to create; it may exist already if it is empty.

    Raises:
        InputError: `path` exists and is not an empty folder, its parent does not exist, or the
            system refuses to write there.
    """
    path = Path(path)
    with _temporary(path, "a folder") as temporary:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise InputError("path", f"{path}, which exists", "a new folder")
        temporary.mkdir()
        yield temporary
        if path.exists():
            path.rmdir()
        temporary.rename(path)


@contextmanager
def _temporary(path: Path, kind: str) -> Iterator[Path]:
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


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write the valid poses as TUM lines `t x y z qx qy qz qw` with 9 decimals, body to world.

    Raises:
        InputError: there is no valid pose, or the folder does not exist.
    """
    valid = trajectory.valid
    if not valid.any():
        raise InputError("trajectory", "no valid pose", "at least one")
    rows = np.column_stack(
        [trajectory.time[valid], trajectory.position_W[valid], trajectory.quat_xyzw[valid]]
    )
    with atomic_write(path) as file:
        np.savetxt(file, rows, fmt="%.9f", delimiter=" ")


def read_tum(path: Path | str) -> Trajectory:
    """Read a TUM track; lines starting with `#` and empty lines are skipped.

    Raises:
        ReadError: the file cannot be read, or a line does not hold eight finite numbers with
            increasing time and a unit quaternion; the error names line and field.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(path, "file", str(error), "a readable TUM text file") from error
    numbered = [
        (number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise ReadError(path, "file", "no pose", "lines of " + " ".join(_TUM_FIELDS))
    rows = np.array([_tum_row(path, number, line) for number, line in numbered])
    _check_tum(path, [number for number, _ in numbered], rows)
    return Trajectory(
        time=rows[:, 0], position_W=rows[:, 1:4], attitude_WB=Rotation.from_quat(rows[:, 4:])
    )


def write_json(path: Path | str, obj: object) -> None:
    """Write JSON, indented by 2, keys in their order; NaN and infinity become null.

    NumPy numbers and arrays, dataclasses and paths are written as their plain counterparts.

    Raises:
        InputError: the object holds another type, or the folder does not exist.
    """
    with atomic_write(path) as file:
        file.write(json_text(obj))


def json_text(obj: object) -> str:
    """Return the text that `write_json` writes.

    Raises:
        InputError: the object holds a value without a plain counterpart.
    """
    return json.dumps(_plain(obj), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_rows(path: Path | str, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows, as mappings from column to value, to a CSV; missing cells stay empty."""
    names = dict.fromkeys(key for row in rows for key in row)
    with atomic_write(path) as file:
        writer = csv.DictWriter(file, list(names), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


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


def _tum_row(path: Path, number: int, line: str) -> list[float]:
    words = line.split()
    if len(words) != len(_TUM_FIELDS):
        expected = f"{len(_TUM_FIELDS)}: " + " ".join(_TUM_FIELDS)
        raise ReadError(path, f"line {number}", f"{len(words)} values", expected)
    row = [number_in(word) for word in words]
    for name, word, value in zip(_TUM_FIELDS, words, row, strict=True):
        if not math.isfinite(value):
            raise ReadError(path, f"line {number}, {name}", repr(word), "a finite number")
    return row


def _check_tum(path: Path, numbers: list[int], rows: FloatArray) -> None:
    not_increasing = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if len(not_increasing):
        k = int(not_increasing[0])
        found = f"{rows[k + 1, 0]!s} after {rows[k, 0]!s}"
        raise ReadError(path, f"line {numbers[k + 1]}, t", found, "strictly increasing seconds")
    norm = np.linalg.norm(rows[:, 4:], axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > NORM_TOLERANCE)
    if len(bad):
        k = int(bad[0])
        raise ReadError(
            path, f"line {numbers[k]}, qx qy qz qw", f"norm {norm[k]:.4g}", "a unit quaternion"
        )


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
