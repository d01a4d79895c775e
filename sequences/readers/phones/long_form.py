"""One table for all sensors, with a column that names the sensor of each row.

    time,sensor,x,y,z
    0.000,gyroscope,0.01,-0.02,0.03
    0.002,accelerometer,0.1,0.2,9.8

The rows are sorted into a file for each sensor, to be read as the folder of a phone's logger.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import head_lines, is_row, read_lines, unquoted
from stario.sequences.readers.phones.files import SUFFIXES
from stario.sequences.readers.phones.sensor_words import sensor_of, words_of
from stario.sequences.readers.table_head import first_row

_HEAD_ROWS = 50
_MIN_SHARE = 0.5
"""Share of the first rows that must name a known sensor; others are of other sensors."""


@dataclass(frozen=True)
class _Layout:
    """Index of the first row, separator of the cells, and index of the column of sensors."""

    first: int
    delimiter: str | None
    column: int


def is_long_form(path: Path) -> bool:
    """Return whether a file's rows name their sensors; never raises."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    lines = [line for line in head_lines(path)[:-1] if is_row(line)]
    return not is_echo(lines) and _layout(lines) is not None


def is_echo(lines: list[str]) -> bool:
    """Return whether lines are the text of `rostopic echo`, which names sensors as well."""
    return lines[:1] != [] and lines[0].rstrip() == "header:"


def unpack_long_form(path: Path, folder: Path) -> None:
    """Write a file for each sensor into a folder.

    Raises:
        ReadError: the file cannot be read or has another form.
    """
    lines = [line for line in read_lines(path) if is_row(line)]
    layout = _layout(lines)
    if layout is None:
        raise ReadError(path, "rows", "none that name a sensor", "a column of sensors' names")
    above, below = lines[max(layout.first - 1, 0) : layout.first], lines[layout.first :]
    titles = [_cells(line, layout.delimiter) for line in above]
    sensors: dict[str, list[list[str]]] = {}
    for row in (_cells(line, layout.delimiter) for line in below):
        name = "".join(row[layout.column : layout.column + 1])
        stem = re.sub(r"\W+", "_", name) or "unnamed"
        sensors.setdefault(stem, []).append(row)
    for stem, own in sensors.items():
        kept = ([cell for k, cell in enumerate(row) if k != layout.column]
                for row in [*titles, *own])  # fmt: skip
        text = "".join((layout.delimiter or " ").join(row) + "\n" for row in kept)
        (folder / f"{stem}.csv").write_text(text, encoding="utf-8")


def _layout(lines: list[str]) -> _Layout | None:
    """Return how lines without blank ones are written, None if they are not of this form."""
    found = first_row(lines[:_HEAD_ROWS], least=3)  # the time may be a date
    if found is None:
        return None
    first, delimiter, _ = found
    rows = [_cells(line, delimiter) for line in lines[first : first + _HEAD_ROWS]]
    rows = [row for row in rows if len(row) == len(rows[0])]
    for column, cells in enumerate(zip(*rows, strict=True)):
        if len(rows) > 1 and sum(map(_names_sensor, cells)) >= _MIN_SHARE * len(cells):
            return _Layout(first, delimiter, column)
    return None


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip() for cell in unquoted(line, delimiter).split(delimiter)]


def _names_sensor(cell: str) -> bool:
    """Return whether a cell names a sensor by more than a letter or two: not `n/a`."""
    return sensor_of(word for word in words_of(cell) if len(word) > 2) is not None
