"""Readers, one module per format; a recording's format is recognised by its content.

Whatever is wrong with a file, readers and their helpers raise `ReadError`; only functions that may
be called from outside, and those that raise anything else, say so. Recognising never raises.
"""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from filecmp import cmp
from pathlib import Path

from stario.sequences.arrays import check_choice, short_repr
from stario.sequences.clean_samples import in_order
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers import bag, generic_csv, unpacking
from stario.sequences.readers.archive import (
    AttributeFilter,
    archive_members,
    filter_words,
    is_archive,
    read_archive,
    split_name,
)
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.phones import event_lines, phone
from stario.sequences.readers.published import euroc, oxiod, ridi, rnin, ronin, tlio
from stario.sequences.readers.text import (
    first_line,
    first_lines,
    is_row,
    may_be_read,
    numbers_in,
    read_lines,
)
from stario.sequences.readers.unrecognised import unrecognised
from stario.sequences.sequence import ImuSequence

__all__ = ["FORMATS", "Format", "find_recordings", "read_recording", "write_csv"]


@dataclass(frozen=True)
class Format:
    """A format of recordings: how to recognise and how to read it.

    Attributes:
        recognises: whether a path (file or folder) holds a recording in this format; must neither
            raise nor read more than a few lines.
        read: function that reads the recording; it raises ReadError if a file is missing or
            malformed, InputError if a package is not installed.
        words: name shown to users if the reader does not set a more specific one.
        options: names of further arguments of `read`, all of them strings.
    """

    recognises: Callable[[Path], bool]
    read: Callable[..., ImuSequence]
    words: str
    options: tuple[str, ...] = ()


def _unpacked(unpack: Callable[..., None], source: str = "") -> Callable[..., ImuSequence]:
    """Return a function that reads the one recording that `unpack` writes of a path.

    Its errors name the path and the file in it. An empty `source` is told by the files.
    """

    def read(path: Path, **options: str) -> ImuSequence:
        with tempfile.TemporaryDirectory(prefix="stario-") as temporary:
            folder = Path(temporary)
            unpack(path, folder, **options)
            inside = [folder] if _recognised(folder) else sorted(_below(folder)) or [folder]
            if len(inside) > 1:
                names = ", ".join(str(one.relative_to(folder)) for one in inside[:4])
                found = f"{len(inside)} recordings ({names})"
                fix = f"unpack the {path.suffix[1:].lower() or 'zip'}"
                raise ReadError(path, "content", found, "one", fix)
            with unpacking.named_after(path, folder):
                sequence = read_recording(inside[0])
        name = path.stem if inside == [folder] else sequence.name
        return replace(sequence, name=name, source=source or sequence.source)

    return read


_log = logging.getLogger(__name__)

_EVENTS = "logger with one line per event"
_LONG = "logger with the sensor named in each row"

FORMATS: dict[str, Format] = {
    "archive": Format(lambda path: is_archive(split_name(path)[0]), read_archive, "archive"),
    "ronin": Format(ronin.is_ronin, ronin.read_ronin, "RoNIN"),
    "ridi": Format(ridi.is_ridi, ridi.read_ridi, "RIDI"),
    "imunet": Format(ridi.is_imunet, ridi.read_imunet, "IMUNet recorder"),
    "rnin": Format(rnin.is_rnin, rnin.read_rnin, "RNIN"),
    "tlio": Format(tlio.is_tlio, tlio.read_tlio, "TLIO"),
    "bag": Format(bag.is_bag, bag.read_bag, "ROS bag", ("imu_topic", "truth_topic")),
    "euroc": Format(euroc.is_euroc, euroc.read_euroc, "EuRoC layout"),
    "oxiod": Format(oxiod.is_oxiod, oxiod.read_oxiod, "OxIOD"),
    "advio": Format(phone.is_advio, phone.read_advio, "ADVIO"),
    "phone": Format(phone.is_phone, phone.read_phone, "phone"),
    "joined": Format(unpacking.is_joined, _unpacked(unpacking.unpack_joined), "phone"),
    "wide": Format(phone.is_wide, phone.read_wide, "phone"),
    "events": Format(event_lines.is_event_lines, event_lines.read_event_lines, _EVENTS),
    "zip": Format(unpacking.is_zip, _unpacked(unpacking.unpack_zip), "zip"),
    "json": Format(unpacking.is_json_export, _unpacked(unpacking.unpack_json), "Sensor Logger"),
    "csv": Format(generic_csv.is_generic_csv, generic_csv.read_generic_csv, "generic CSV"),
    "long": Format(unpacking.is_long_form, _unpacked(unpacking.unpack_long_form, _LONG), "phone"),
    "untimed": Format(unpacking.is_untimed, _unpacked(unpacking.unpack_joined), "phone", ("rate",)),
}
"""Known formats by name, tried in this order, more specific ones first; `euroc` also covers TUM-VI,
`ridi` also IMUNet's processed recordings. Files are found below a folder by `_SUFFIXES`."""

_SUFFIXES = (
    *(".csv", ".txt", ".tsv", ".log", ".json", ".zip"),
    *(".bag", ".mcap", ".db3", ".hdf5", ".h5"),
)
"""Suffixes of files that may be a recording by themselves."""

_LIST_SUFFIXES = (".txt", ".list", ".lst")
_HEAD_LINES = 20
_OXIOD_FORMS = ("syn", "raw")
_FILTER = re.compile(r"\s+(?P<key>[A-Za-z]\w*)=(?P<value>\"[^\"]*\"|[^\s\",]+)\s*$")


def read_recording(path: str | Path, format: str = "auto", **options: str) -> ImuSequence:
    """Read a recording.

    Args:
        path: a file or a folder, depending on the format; `file.h5:name` in an archive.
        format: a name in `FORMATS`, or "auto" to recognise the format by the content.
        options: further arguments of the format's reader: `imu_topic` and `truth_topic` for a bag,
            `rate` [samples/s] for a table without times.

    Raises:
        InputError: `path` is not a path, the format is unknown, or it does not take an option.
        ReadError: the path does not exist, no format matches, or the content is malformed.
    """
    check_choice("format", format, ("auto", *FORMATS))
    path = _readable(path, "a recording")
    name = _recognised(path) if format == "auto" else format
    if "rate" in options and format == "auto":  # by which even an unknown table is read
        name = "untimed"
    if name is None:
        raise unrecognised(path, sorted(_below(path)))
    for option in options:
        if option not in FORMATS[name].options:
            known = ", ".join(FORMATS[name].options) or "none"
            raise InputError(option, f"an option that format {name} does not take", known)
    sequence = in_order(FORMATS[name].read(path, **options))
    return sequence if sequence.source else replace(sequence, source=FORMATS[name].words)


def find_recordings(
    path: str | Path,
    on_error: Callable[[ReadError], None] | None = None,
    where: AttributeFilter | None = None,
) -> list[Path]:
    """Return the recordings at a path: the path itself, those that it lists, or all below it.

    A list is a text file with the name of a recording, or of a folder of recordings, on each line.
    The recordings of a folder are sorted. Folders called `raw` next to a folder `syn` are skipped:
    they hold OxIOD's unsynchronised duplicates.

    Args:
        path: a recording, a list file or a folder.
        on_error: called for each list entry that is empty or does not exist; the others are still
            returned. Without it, such an entry raises its error.
        where: attributes that recordings must have (only those in archives have any): patterns for
            each attribute, one of which must match, `{"person": ["dan", "ha*"]}`.

    Raises:
        ReadError: the path does not exist, a folder or archive holds no recording, no recording has
            the attributes, or a list entry is invalid.
        InputError: `path` is not a path, or `where` has no list of patterns.
    """
    for key, patterns in (where or {}).items():
        if isinstance(patterns, str):  # its letters would be the patterns
            raise InputError("where", f"{key!r}: {patterns!r}", f"{key!r}: [{patterns!r}]")
    path = _readable(path, "a recording or a folder of them")
    if is_archive(path):
        if members := archive_members(path, where):
            return members
        raise ReadError(path, "imu/t", "none in the whole archive", "recordings with IMU samples")
    if _recognised(path):
        return _with_attributes([path], where)
    if is_list(path):
        return _listed(path, on_error, where)
    found = [path] if path.is_file() else sorted(_below(path))
    if not found:
        raise unrecognised(path, [])
    _warn_of_copies(found)
    return _with_attributes(found, where)


def _warn_of_copies(found: list[Path]) -> None:
    """Say which files are copies, `walk (1).csv`: counted twice, a recording weighs twice."""
    by_size: dict[int, list[Path]] = {}
    for path in sorted(filter(Path.is_file, found), key=lambda path: (len(path.name), path)):
        alike = by_size.setdefault(path.stat().st_size, [])
        if original := next((one for one in alike if cmp(one, path, shallow=False)), None):
            _log.warning("%s: the same recording as %s: remove one", path, original)
        else:
            alike.append(path)


def _readable(path: str | Path, expected: str) -> Path:
    """Return a path, checked to be that of a file or a folder that may be read."""
    if not isinstance(path, str | Path):
        raise InputError("path", short_repr(path), f"the path of {expected}")
    path = Path(path)
    file = split_name(path)[0]
    if not file.exists():
        raise ReadError(path, "path", "no such file or folder", expected)
    if not (file.is_file() or file.is_dir()):  # readers look at a file several times
        raise ReadError(path, "path", "a pipe or device", expected, "save its content as a file")
    if not may_be_read(file):
        raise ReadError(path, "path", "no permission to read", expected, "fix its permissions")
    return path


def _with_attributes(found: list[Path], where: AttributeFilter | None) -> list[Path]:
    """Return the recordings whose attributes match; only those in archives have any."""
    if not where or not found:
        return found
    chosen: list[Path] = []
    first: ReadError | None = None
    for file in dict.fromkeys(file for file, name in map(split_name, found) if name):
        try:
            matching = set(archive_members(file, where))
            chosen += [path for path in found if path in matching]
        except ReadError as error:
            first = first or error
    if chosen:
        return chosen
    field = f"recordings with {filter_words(where)}"
    fix = "only recordings in archives have attributes"
    raise first or ReadError(found[0], field, "none", "at least one", fix)


def _below(path: Path) -> list[Path]:
    found: list[Path] = []
    for folder, subfolders, files in os.walk(path):
        here = Path(folder)
        visible = [name for name in subfolders if not name.startswith(".")]
        recordings = [name for name in visible if _recognised(here / name)]
        found += [here / name for name in recordings]
        left_out = {*recordings, *(["raw"] if "syn" in visible else [])}
        subfolders[:] = [name for name in visible if name not in left_out]
        for file in (here / name for name in files if name.lower().endswith(_SUFFIXES)):
            if is_archive(file):
                found += archive_members(file)
            elif _recognised(file):
                found.append(file)
    return found


def _listed(
    path: Path, on_error: Callable[[ReadError], None] | None, where: AttributeFilter | None
) -> list[Path]:
    """Return the recordings that a list names, each once.

    Names are relative to the list's folder or a folder in it. If that folder holds no folders, they
    may also be relative to its parent or a folder in that. `data1/imu3.csv` is also found as
    `data1/syn/imu3.csv` (OxIOD). An archive's name may be followed by a filter, as for
    `find_recordings`: `file.h5 person=dan place="building 2"`. Blanks around a name, a `,type`
    after it and comments from `#` on are ignored.
    """
    numbered = enumerate(read_lines(path), 1)
    entries = [(k, *_parsed(x.split("#")[0])) for k, x in numbered if is_row(x)]
    if not entries:
        raise ReadError(path, "list", "no entry", "names of recordings")
    folder = path.parent
    bases = [folder, *(_folders(folder) or [folder.parent, *_folders(folder.parent)])]
    located = [_located(bases, name) for _, name, _ in entries]
    if len(entries) > _HEAD_LINES and not any(located):
        text = f"{len(entries)} lines without an existing name, such as {entries[0][1]:.60}"
        raise ReadError(path, "list", text, "a recording, or a list of them")
    found: list[Path] = []
    for (number, name, of_entry), inside in zip(entries, located, strict=True):
        try:
            found += find_recordings(_entry(path, number, name, inside), where=of_entry)
        except ReadError as error:
            if on_error is None:
                raise
            on_error(error)
    return _with_attributes(list(dict.fromkeys(found)), where)


def _entry(path: Path, number: int, name: str, located: Path | None) -> Path:
    """Return where a list's entry is.

    An empty one is an error, because the data sets' own readers take it for the folder itself, as
    is a nested list: it could be a cycle.
    """
    line = f"line {number}"
    if not name:
        raise ReadError(path, line, "an empty entry", "a recording's name", "delete the line")
    if located is None:
        found, fix = f"{name!r}, which does not exist", "remove the line or fetch the recording"
        raise ReadError(path, line, found, "the name of a recording", fix)
    if not _recognised(located) and is_list(located):
        raise ReadError(path, "list", f"another list, {located.name}", "recordings")
    return located


def is_list(path: Path) -> bool:
    """Return whether a file may be a list: a text suffix and no row of numbers in its first lines.

    A line with a single number may be a name, as in TLIO's lists.
    """
    if path.suffix.lower() not in _LIST_SUFFIXES or not first_line(path, comments=True):
        return False
    lines = first_lines(path, _HEAD_LINES)
    return all(len(numbers_in(line, mark)) < 2 for line in lines for mark in (",", ";", None))


def _parsed(text: str) -> tuple[str, AttributeFilter]:
    """Return the name in a line, and the `key=value` filters at its end."""
    where: dict[str, list[str]] = {}
    while match := _FILTER.search(text):
        where.setdefault(match["key"], []).insert(0, match["value"].strip('"'))
        text = text[: match.start()]
    return text.split(",")[0].strip(), where


def _folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _located(bases: list[Path], name: str) -> Path | None:
    if not name:
        return None
    path = Path(name)
    forms = [path, *(path.parent / form / path.name for form in _OXIOD_FORMS)]
    candidates = (base / form for base in bases for form in forms)
    return next((found for found in candidates if split_name(found)[0].exists()), None)


def _recognised(path: Path) -> str | None:
    """Return the name of the format that matches a path's content, or None."""
    try:
        return next((name for name, known in FORMATS.items() if known.recognises(path)), None)
    except PermissionError:  # of a folder somewhere below: `os.walk` passes it over as well
        return None
