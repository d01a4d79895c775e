"""Readers: one file per format, recognised by what a file holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.columns import HEADER
from stario.sequences.readers.euroc import is_euroc, read_euroc
from stario.sequences.readers.own_csv import is_own_csv, read_own_csv, write_csv
from stario.sequences.readers.oxiod import is_oxiod, read_oxiod
from stario.sequences.readers.text import first_line
from stario.sequences.sequence import ImuSequence

__all__ = ["FORMATS", "Format", "find_recordings", "read_recording", "write_csv"]


@dataclass(frozen=True)
class Format:
    """How a format is told from others, and how it is read.

    Attributes:
        recognises: whether a path (file or folder) holds a recording in this format; must neither
            raise nor read more than a few lines.
        read: reads it, or raises ReadError.
    """

    recognises: Callable[[Path], bool]
    read: Callable[[Path], ImuSequence]


FORMATS: dict[str, Format] = {
    "euroc": Format(is_euroc, read_euroc),
    "oxiod": Format(is_oxiod, read_oxiod),
    "csv": Format(is_own_csv, read_own_csv),
}
"""Known formats by name, asked in this order; `euroc` is TUM-VI's as well."""


def read_recording(path: str | Path, format: str = "auto") -> ImuSequence:
    """Read a recording.

    Args:
        path: a file, or the folder of an EuRoC or TUM-VI recording.
        format: a name in `FORMATS`, or "auto" to recognise it by its content.

    Raises:
        InputError: the format's name is unknown.
        ReadError: nothing is there, no format fits, or the content is malformed.
    """
    path = Path(path)
    if format != "auto" and format not in FORMATS:
        raise InputError("format", repr(format), f"auto, {', '.join(FORMATS)}")
    if not path.exists():
        raise ReadError(path, "path", "nothing there", "a recording")
    if format != "auto":
        return FORMATS[format].read(path)
    for known in FORMATS.values():
        if known.recognises(path):
            return known.read(path)
    raise _unknown(path)


def find_recordings(path: str | Path) -> list[Path]:
    """The recordings at a path: itself if it is one, else all below it in sorted order.

    Folders called `raw` beside `syn` are left out: OxIOD's unsynchronised doubles.

    Raises:
        ReadError: nothing is there, or a folder holds no recording.
    """
    path = Path(path)
    if not path.exists():
        raise ReadError(path, "path", "nothing there", "a recording or a folder of recordings")
    if path.is_file() or _is_recording(path):
        return [path]
    found: list[Path] = []
    for folder, subfolders, files in os.walk(path):
        here = Path(folder)
        whole = [name for name in subfolders if _is_recording(here / name)]
        found += [here / name for name in whole]
        doubles = {"raw"} if "syn" in subfolders else set()
        subfolders[:] = [
            name
            for name in subfolders
            if name not in {*whole, *doubles} and not name.startswith(".")
        ]
        found += [
            here / name
            for name in files
            if name.lower().endswith((".csv", ".txt")) and _is_recording(here / name)
        ]
    if not found:
        raise ReadError(path, "folder", "no recording", f"recordings in {_names()}")
    return sorted(found)


def _is_recording(path: Path) -> bool:
    return any(known.recognises(path) for known in FORMATS.values())


def _names() -> str:
    return f"one of the formats {', '.join(FORMATS)}"


def _unknown(path: Path) -> ReadError:
    """What was seen instead of a recording, in one line."""
    if path.is_dir():
        found, fix = "a folder without mav0/imu0/data.csv", "name one recording in it"
    elif (line := first_line(path)) is None:
        found, fix = "no line of text", "is it empty or compressed?"
    else:
        found, fix = f"{line.strip()[:60]!r}", f"for a CSV of your own start with {HEADER}"
    return ReadError(path, "content", found, _names(), fix)
