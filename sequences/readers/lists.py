"""List files: one recording per line, as the data sets publish their splits.

An archive's name may be followed by a filter of its recordings, as for `find_recordings`:
`file.h5 person=dan place="building 2"`. Blanks around a name, a `,type` after it and comments from
`#` on are ignored, as are blank lines at the end. An empty entry elsewhere is an error, because
the data sets' own readers take it for the folder itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.archive import AttributeFilter, split_name
from stario.sequences.readers.lines import first_line, first_lines, numbers_in, read_lines

_SUFFIXES = (".txt", ".list", ".lst")
_HEAD_LINES = 20
_OXIOD_FORMS = ("syn", "raw")
_FILTER = re.compile(r"\s+(?P<key>[A-Za-z]\w*)=(?P<value>\"[^\"]*\"|[^\s\",]+)\s*$")


def is_list(path: Path) -> bool:
    """Return whether a file may be a list: a text suffix and no row of numbers in its first lines.

    A line with a single number may be a name, as in TLIO's lists.
    """
    if path.suffix.lower() not in _SUFFIXES or first_line(path, comments=True) is None:
        return False
    lines = first_lines(path, _HEAD_LINES)
    return all(len(numbers_in(line, mark)) < 2 for line in lines for mark in (",", ";", None))


def list_entries(path: Path) -> Iterator[tuple[Path, AttributeFilter] | ReadError]:
    """Yield the paths that a list names, each with the filter of its recordings, or a line's error.

    Names are relative to the list's folder or a folder in it. If that folder holds no folders, they
    may also be relative to its parent or a folder in that. `data1/imu3.csv` is also found as
    `data1/syn/imu3.csv` (OxIOD).

    Raises:
        ReadError: the list cannot be read or names nothing, or is some other long text.
    """
    lines = read_lines(path)
    while lines and not lines[-1].strip():
        lines.pop()
    numbered = enumerate(lines, 1)
    written = [(k, x.split("#")[0]) for k, x in numbered if not x.lstrip().startswith("#")]
    if not written:
        raise ReadError(path, "list", "no entry", "names of recordings")
    bases = _bases(path.parent)
    if len(written) > _HEAD_LINES and not any(_names_any(bases, text) for _, text in written):
        shown = f"{len(written)} lines without an existing name, such as {written[0][1]:.60}"
        raise ReadError(path, "list", shown, "a recording, or a list of them")
    for number, text in written:
        text, where = _split_filters(text)
        name = _name_in(text)
        line = f"line {number}"
        if not name:
            fix = "delete the line"
            yield ReadError(path, line, "an empty entry", "a recording's name", fix)
        elif (found := _located(bases, Path(name))) is None:
            fix = "remove the line or fetch the recording"
            found_name = f"{name!r}, which does not exist"
            yield ReadError(path, line, found_name, "the name of a recording", fix)
        else:
            yield found, where


def _names_any(bases: list[Path], text: str) -> bool:
    """Return whether a line names a file or folder that exists."""
    name = _name_in(_split_filters(text)[0])
    return bool(name) and _located(bases, Path(name)) is not None


def _name_in(text: str) -> str:
    """Return the name in a line without its filters."""
    return text.split(",")[0].strip()


def _split_filters(text: str) -> tuple[str, AttributeFilter]:
    """Split the `key=value` filters off the end of a line."""
    where: dict[str, list[str]] = {}
    while match := _FILTER.search(text):
        where.setdefault(match["key"], []).insert(0, match["value"].strip('"'))
        text = text[: match.start()]
    return text, where


def _bases(folder: Path) -> list[Path]:
    inside = _folders(folder)
    if inside:
        return [folder, *inside]
    return [folder, folder.parent, *_folders(folder.parent)]


def _folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _located(bases: list[Path], name: Path) -> Path | None:
    forms = [name, *(name.parent / form / name.name for form in _OXIOD_FORMS)]
    candidates = (base / form for base in bases for form in forms)
    return next((path for path in candidates if split_name(path)[0].exists()), None)
