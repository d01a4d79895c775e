"""Description of a file or folder that is no recording in any known format."""

from __future__ import annotations

from pathlib import Path

from stario.sequences.arrays import shortlist
from stario.sequences.errors import ReadError
from stario.sequences.readers.columns import HEADER
from stario.sequences.readers.phones.files import (
    NO_SAMPLES,
    SUFFIXES,
    groups_of,
    is_complete,
    phone_recordings,
    sensors_in,
)
from stario.sequences.readers.poses import pose_files
from stario.sequences.readers.text import first_bytes, first_line, first_lines, may_be_read
from stario.sequences.readers.unpacking import is_echo

_KNOWN = "a recording in a known format (`stario inspect --help` lists them)"
_EXPORT = "export as CSV, or as the zip or folder that the app writes"
_CONTAINERS = {
    b"SQLite format 3": "an SQLite database",
    b"PK\x03\x04": "a zip without text files (such as a spreadsheet), or one that is cut short",
    b"\xd0\xcf\x11\xe0": "a spreadsheet",
    b"\x1f\x8b": "a file compressed with gzip",
    b"7z\xbc\xaf": "a file compressed with 7-Zip",
    b"MATLAB": "a MATLAB file",
}
"""First bytes of files that may hold a recording but are not unpacked, and their description."""


def unrecognised(path: Path, inside: list[Path]) -> ReadError:
    """Return an error that describes what was found instead of one recording, perhaps `inside`."""
    if inside:
        found, fix = f"a folder of {len(inside)} recordings", f"name one, such as {inside[0]}"
        return ReadError(path, "content", found, _KNOWN, fix)
    if error := _incomplete(path):
        return error
    beside = phone_recordings(path.parent) if path.is_file() else []
    if part_of := next((one for one in beside if path in one.files), None):
        found, fix = "one sensor of a recording", f"name its gyroscope: {part_of.gyro}"
        return ReadError(path, "content", found, "a recording", fix)
    if path.is_dir() and (files := _of_several_devices(path)):
        found = f"files of different devices or recordings ({shortlist(files)})"
        expected, fix = "those of one", "name the files of one alike: gyro_a.csv and accel_a.csv"
        return ReadError(path, "sensors", found, expected, fix)
    if path.is_dir() and (poses := pose_files(path)):
        expected = "a gyroscope file and an accelerometer file"
        fix = "put the IMU files into the same folder"
        return ReadError(path, "content", f"only poses, {poses[0].name}", expected, fix)
    for part in sorted(path.rglob("*")) if path.is_dir() else ():
        if part.is_dir() and (error := _incomplete(part)):
            return error
    found, fix = _folder(path) if path.is_dir() else _file(path)
    return ReadError(path, "content", found, _KNOWN, fix)


def _incomplete(path: Path) -> ReadError | None:
    """Return the error of a folder or file that lacks gyroscope or accelerometer, else None."""
    groups = groups_of(path) if path.is_dir() else []
    unread = [file for group in groups for file in group.unread]
    present = sensors_in(path)
    sensors = "" if is_complete(present) else " and ".join(present)
    if not (sensors or unread):
        return None
    for file in unread:
        if not may_be_read(file):
            expected = "a sensor of the recording"
            return ReadError(file, "path", "no permission to read", expected, "fix its permissions")
    names = " and ".join(file.name for file in unread)
    fix = f"{names}: {NO_SAMPLES}" if unread else "log both"
    found = f"only {sensors}" if sensors else "none"
    return ReadError(path, "sensors", found, "a gyroscope and an accelerometer", fix)


def _of_several_devices(folder: Path) -> list[str]:
    """Return the names of gyroscope and accelerometer files, empty if a folder lacks either."""
    files: dict[str, set[str]] = {}
    for group in groups_of(folder):
        for sensor, tables in group.tables.items():
            files.setdefault(sensor, set()).update(table.file.name for table in tables)
    used = (files.get(sensor, set()) for sensor in ("gyro", "accel", "linear"))
    return sorted(set().union(*used)) if is_complete(files) else []


def _folder(path: Path) -> tuple[str, str]:
    """Return what a folder holds and what is wrong with the first file that may be a recording."""
    entries = sorted(p.name for p in path.iterdir() if not p.name.startswith("."))
    found = f"a folder with {shortlist(entries) or 'nothing'}"
    files = [file for file in sorted(path.rglob("*")) if file.suffix.lower() in SUFFIXES]
    if not files:
        return found, "name a folder with a recording"
    words, fix = _file(files[0])
    return f"{found}; {files[0].relative_to(path)} holds {words}", fix


def _file(path: Path) -> tuple[str, str]:
    """Return what a file holds and what to do about it."""
    start, line = first_bytes(path), first_line(path)
    for mark, words in _CONTAINERS.items():
        if start.startswith(mark):
            return words, _EXPORT
    if start.startswith(b"\x80"):
        return "a pickle, which may run code", "save it as CSV or npy of plain numbers"
    if is_echo(first_lines(path, 1)):
        return "text of `rostopic echo`", "name the bag, or write it with `rostopic echo -p`"
    if not line:
        return "no line of text", "is it empty or compressed?"
    return f"{line.strip()[:60]!r}", f"a CSV of your own must start with {HEADER}"
