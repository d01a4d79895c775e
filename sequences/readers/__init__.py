"""Readers: one file per format, recognised by what a file holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from stario.sequences.errors import InputError, ReadError
from stario.sequences.inspection.samples import in_order
from stario.sequences.readers.archive import (
    Where,
    archive_members,
    is_archive,
    is_archive_member,
    read_archive,
    split_name,
)
from stario.sequences.readers.bag import is_bag, read_bag
from stario.sequences.readers.columns import HEADER
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.lists import is_list, list_entries
from stario.sequences.readers.own_csv import is_own_csv, read_own_csv
from stario.sequences.readers.phones.event_lines import is_event_lines, read_event_lines
from stario.sequences.readers.phones.files import lone_sensors
from stario.sequences.readers.phones.json_export import is_json_export, laid_out
from stario.sequences.readers.phones.phone import is_phone, is_wide, read_phone, read_wide
from stario.sequences.readers.poses import pose_files
from stario.sequences.readers.published.advio import is_advio, read_advio
from stario.sequences.readers.published.euroc import is_euroc, read_euroc
from stario.sequences.readers.published.imunet import is_imunet, read_imunet
from stario.sequences.readers.published.oxiod import is_oxiod, read_oxiod
from stario.sequences.readers.published.ridi import is_ridi, read_ridi
from stario.sequences.readers.published.rnin import is_rnin, read_rnin
from stario.sequences.readers.published.ronin import is_ronin, read_ronin
from stario.sequences.readers.published.tlio import is_tlio, read_tlio
from stario.sequences.readers.text import first_line, magic
from stario.sequences.readers.zipped import is_zip, unpacked
from stario.sequences.sequence import ImuSequence

__all__ = ["FORMATS", "Format", "find_recordings", "read_recording", "write_csv"]


@dataclass(frozen=True)
class Format:
    """How a format is told from others, and how it is read.

    Attributes:
        recognises: whether a path (file or folder) holds a recording in this format; must neither
            raise nor read more than a few lines.
        read: reads it, or raises ReadError.
        words: what it is called before a person, where the reader knows no better.
        options: names of what else `read` takes, all text.
    """

    recognises: Callable[[Path], bool]
    read: Callable[..., ImuSequence]
    words: str
    options: tuple[str, ...] = ()


def _is_archive_or_member(path: Path) -> bool:
    return is_archive(path) or is_archive_member(path)


def _read_zip(path: Path) -> ImuSequence:
    """Read the one recording in a zip; its errors name the zip and the file in it."""
    with unpacked(path) as folder:
        found = sorted(_below(folder)) if not _is_recording(folder) else [folder]
        if len(found) > 1:
            names = ", ".join(str(one.relative_to(folder)) for one in found[:4])
            raise ReadError(
                path, "content", f"{len(found)} recordings, {names}", "one", "unpack it"
            )
        return _read_unpacked(path, folder, found[0] if found else folder)


def _read_json(path: Path) -> ImuSequence:
    with laid_out(path) as folder:
        return _read_unpacked(path, folder, folder)


def _read_unpacked(path: Path, folder: Path, inside: Path) -> ImuSequence:
    """Read what was unpacked from `path`; errors name `path` instead of the folder."""
    try:
        sequence = read_recording(inside)
    except ReadError as error:
        file = str(error.path).replace(str(folder), str(path))
        field = error.field.removeprefix(f"{error.path}: ")
        found, fix = (text.replace(f"{folder}/", "") for text in (error.found, error.fix))
        raise ReadError(file, field, found, error.expected, fix) from None
    return replace(sequence, name=path.stem) if inside == folder else sequence


FORMATS: dict[str, Format] = {
    "archive": Format(_is_archive_or_member, read_archive, "archive"),
    "ronin": Format(is_ronin, read_ronin, "RoNIN"),
    "ridi": Format(is_ridi, read_ridi, "RIDI"),
    "imunet": Format(is_imunet, read_imunet, "IMUNet's recorder"),
    "rnin": Format(is_rnin, read_rnin, "RNIN"),
    "tlio": Format(is_tlio, read_tlio, "TLIO"),
    "bag": Format(is_bag, read_bag, "ROS bag", options=("imu_topic", "truth_topic")),
    "euroc": Format(is_euroc, read_euroc, "EuRoC layout"),
    "oxiod": Format(is_oxiod, read_oxiod, "OxIOD"),
    "advio": Format(is_advio, read_advio, "ADVIO"),
    "phone": Format(is_phone, read_phone, "phone"),
    "wide": Format(is_wide, read_wide, "phone"),
    "events": Format(is_event_lines, read_event_lines, "logger with one line per event"),
    "zip": Format(is_zip, _read_zip, "zip"),
    "json": Format(is_json_export, _read_json, "Sensor Logger"),
    "csv": Format(is_own_csv, read_own_csv, "CSV of one's own"),
}
"""Known formats by name, asked in this order, the more particular first; `euroc` is TUM-VI's as
well, `ridi` that of IMUNet's processed recordings."""

_SUFFIXES = (
    *(".csv", ".txt", ".tsv", ".log", ".json", ".zip"),
    *(".bag", ".mcap", ".db3", ".hdf5", ".h5"),
)
"""Files that may be a recording by themselves."""

_CONTAINERS = (
    (b"SQLite format 3", "an SQLite database"),
    (b"PK\x03\x04", "a zip without text files, as a spreadsheet is, or one that is cut short"),
    (b"\xd0\xcf\x11\xe0", "a spreadsheet"),
    (b"\x1f\x8b", "a file compressed with gzip"),
    (b"7z\xbc\xaf", "a file compressed with 7-Zip"),
    (b"MATLAB", "a MATLAB file"),
)
"""How files begin that may hold a recording but are not unpacked."""


def read_recording(path: str | Path, format: str = "auto", **options: str) -> ImuSequence:
    """Read a recording.

    Args:
        path: a file or a folder, as the format has it; of an archive `file.h5:name`.
        format: a name in `FORMATS`, or "auto" to recognise it by its content.
        options: what the format's reader takes besides: `imu_topic` and `truth_topic` of a bag.

    Raises:
        InputError: the format's name is unknown, or it does not take an option.
        ReadError: nothing is there, no format fits, or the content is malformed.
    """
    if not isinstance(path, str | Path):
        raise InputError("path", f"{path!r:.60}", "the path of a recording")
    path = Path(path)
    if format != "auto" and format not in FORMATS:
        raise InputError("format", repr(format), f"auto, {', '.join(FORMATS)}")
    if not split_name(path)[0].exists():
        raise ReadError(path, "path", "nothing there", "a recording")
    name = _recognised(path) if format == "auto" else format
    if name is None:
        raise _unknown(path)
    for option in options:
        if option not in FORMATS[name].options:
            known = ", ".join(FORMATS[name].options) or "none"
            raise InputError(option, f"an option of a {name} recording", known)
    sequence = in_order(FORMATS[name].read(path, **options))
    return sequence if sequence.source else replace(sequence, source=FORMATS[name].words)


def find_recordings(
    path: str | Path,
    on_error: Callable[[ReadError], None] | None = None,
    where: Where | None = None,
) -> list[Path]:
    """The recordings at a path: itself if it is one, those that it lists, else all below it.

    A list is a text file with the name of a recording, or of a folder of some, on each line. Of a
    folder the recordings come in sorted order; folders called `raw` beside `syn` are left out:
    OxIOD's unsynchronised doubles.

    Args:
        path: a recording, a list file or a folder.
        on_error: called for each entry of a list that is empty or leads nowhere; the others are
            returned all the same. Without it such an entry is raised.
        where: attributes that recordings must have, which only those of an archive do: for each
            patterns, one of which must fit, `{"person": ["dan", "ha*"]}`.

    Raises:
        ReadError: nothing is there, a folder holds no recording, or a list's entry is wrong.
    """
    path = Path(path)
    if not split_name(path)[0].exists():
        raise ReadError(path, "path", "nothing there", "a recording or a folder of recordings")
    if is_archive(path):
        return archive_members(path, where)
    if _is_recording(path):
        return _with_attributes([path], where)
    if is_list(path):
        return _listed(path, on_error, where)
    if path.is_file():
        return _with_attributes([path], where)
    found = sorted(_below(path))
    if not found:
        if pose_files(path) or lone_sensors(path):
            raise _unknown(path)
        raise ReadError(path, "folder", "no recording", f"recordings in {_names()}")
    return _with_attributes(found, where)


def _with_attributes(found: list[Path], where: Where | None) -> list[Path]:
    """Those of the recordings whose attributes fit; only archives' have any."""
    if not where or not found:
        return found
    members: dict[Path, list[Path]] = {}
    for path in found:
        if is_archive_member(path):
            members.setdefault(split_name(path)[0], []).append(path)
    chosen: list[Path] = []
    errors: list[ReadError] = []
    for file, paths in members.items():
        try:
            fitting = set(archive_members(file, where))
            chosen += [path for path in paths if path in fitting]
        except ReadError as error:
            errors.append(error)
    if errors and not chosen:
        raise errors[0]
    if not chosen:
        asked = ", ".join(f"{key}={value}" for key, values in where.items() for value in values)
        fix = "recordings outside of archives have no attributes"
        raise ReadError(found[0], f"recordings with {asked}", "none", "some", fix)
    return chosen


def _below(path: Path) -> list[Path]:
    found: list[Path] = []
    for folder, subfolders, files in os.walk(path):
        here = Path(folder)
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
        whole = [name for name in subfolders if _is_recording(here / name)]
        found += [here / name for name in whole]
        doubles = {"raw"} if "syn" in subfolders else set()
        subfolders[:] = [name for name in subfolders if name not in {*whole, *doubles}]
        for name in files:
            if not name.lower().endswith(_SUFFIXES):
                continue
            if is_archive(here / name):
                found += archive_members(here / name)
            elif _is_recording(here / name):
                found.append(here / name)
    return found


def _listed(
    path: Path, on_error: Callable[[ReadError], None] | None, where: Where | None
) -> list[Path]:
    """What a list names, each once; a list in a list is an error, or it could name itself."""
    found: list[Path] = []
    for entry in list_entries(path):
        try:
            if isinstance(entry, ReadError):
                raise entry
            if not _is_recording(entry.path) and is_list(entry.path):
                raise ReadError(path, "list", f"the list {entry.path.name}", "names of recordings")
            found += find_recordings(entry.path, where=entry.where)
        except ReadError as error:
            if on_error is None:
                raise
            on_error(error)
    return _with_attributes(list(dict.fromkeys(found)), where)


def _is_recording(path: Path) -> bool:
    return _recognised(path) is not None


def _recognised(path: Path) -> str | None:
    """Name of the format whose content a path has."""
    return next((name for name, known in FORMATS.items() if known.recognises(path)), None)


def _names() -> str:
    return f"one of the formats {', '.join(FORMATS)}"


def _poses_alone(path: Path, pose: Path) -> ReadError:
    expected = "a gyroscope's and an accelerometer's file"
    fix = "put the IMU's files beside them"
    return ReadError(path, "content", f"poses alone, {pose.name}", expected, fix)


def _unknown(path: Path) -> ReadError:
    """What was seen instead of a recording, in one line."""
    fix = ""
    if path.is_dir() and (inside := sorted(_below(path))):
        found, fix = f"a folder of {len(inside)} recordings", f"name one, such as {inside[0]}"
    elif lone := lone_sensors(path):
        expected = "a gyroscope and an accelerometer"
        return ReadError(path, "sensors", f"{' and '.join(lone)} alone", expected, "log both")
    elif path.is_dir() and (poses := pose_files(path)):
        return _poses_alone(path, poses[0])
    elif path.is_dir():
        there = sorted(p.name for p in path.iterdir() if not p.name.startswith("."))
        names = ", ".join(there[:5]) + (f" and {len(there) - 5} more" if len(there) > 5 else "")
        found, fix = f"a folder with {names or 'nothing'}", "name one recording in it"
    elif kind := next((words for start, words in _CONTAINERS if magic(path).startswith(start)), ""):
        found, fix = kind, "export as CSV, or as the zip or folder that the app writes"
    elif magic(path, 2)[:1] == b"\x80":
        found, fix = "a pickle, which may run code", "save it as CSV or npy of plain numbers"
    elif (line := first_line(path)) is None:
        found, fix = "no line of text", "is it empty or compressed?"
    else:
        found, fix = f"{line.strip()[:60]!r}", f"for a CSV of your own start with {HEADER}"
    return ReadError(path, "content", found, _names(), fix)
