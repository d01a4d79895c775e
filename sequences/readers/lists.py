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
from stario.sequences.readers.lines import first_line, first_lines, is_row, numbers_in, read_lines

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
    """
    numbered = enumerate(read_lines(path), 1)
    entries = [(k, *_parsed(x.split("#")[0])) for k, x in numbered if is_row(x)]
    if not entries:
        raise ReadError(path, "list", "no entry", "names of recordings")
    folder = path.parent
    bases = [folder, *(_folders(folder) or [folder.parent, *_folders(folder.parent)])]
    if len(entries) > _HEAD_LINES and not any(_located(bases, name) for _, name, _ in entries):
        found = f"{len(entries)} lines without an existing name, such as {entries[0][1]:.60}"
        raise ReadError(path, "list", found, "a recording, or a list of them")
    for number, name, where in entries:
        line = f"line {number}"
        if not name:
            fix = "delete the line"
            yield ReadError(path, line, "an empty entry", "a recording's name", fix)
        elif (located := _located(bases, name)) is None:
            fix = "remove the line or fetch the recording"
            found_name = f"{name!r}, which does not exist"
            yield ReadError(path, line, found_name, "the name of a recording", fix)
        else:
            yield located, where


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
