"""One table for all sensors, with a column that names the sensor of each row.

    time,sensor,x,y,z
    0.000,gyroscope,0.01,-0.02,0.03
    0.002,accelerometer,0.1,0.2,9.8

The rows are sorted into a file for each sensor, to be read as the folder of a phone's logger.
"""

from __future__ import annotations

import re
from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import head_lines, is_row, read_lines
from stario.sequences.readers.phones.files import SUFFIXES
from stario.sequences.readers.phones.sensor_words import sensor_of, words_of
from stario.sequences.readers.table_head import first_row
from stario.sequences.readers.text import RowFormat

_HEAD_ROWS = 50
_MIN_SHARE = 0.5
"""Share of the first rows that must name a known sensor; others are of other sensors."""


def is_long_form(path: Path) -> bool:
    """Return whether a file's rows name their sensors; never raises."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    lines = [line for line in head_lines(path)[:-1] if is_row(line)]
    return not is_echo(lines) and _column_of_sensors(lines) is not None


def is_echo(lines: list[str]) -> bool:
    """Return whether lines are the text of `rostopic echo`, which names sensors as well."""
    return lines[:1] != [] and lines[0].rstrip() == "header:"


def unpack_long_form(path: Path, folder: Path) -> None:
    """Write a file for each sensor into a folder.

    Raises:
        ReadError: the file cannot be read or has another form.
    """
    lines = [line for line in read_lines(path) if is_row(line)]
    found = _column_of_sensors(lines)
    if found is None:
        raise ReadError(path, "rows", "none that name a sensor", "a column of sensors' names")
    written, column = found
    rows = [[cell.strip() for cell in written.cells(line)] for line in lines]
    titles, below = rows[max(written.skip - 1, 0) : written.skip], rows[written.skip :]
    sensors: dict[str, list[list[str]]] = {}
    for row in below:
        stem = re.sub(r"\W+", "_", "".join(row[column : column + 1])) or "unnamed"
        sensors.setdefault(stem, []).append(row)
    for stem, own in sensors.items():
        kept = ([*row[:column], *row[column + 1 :]] for row in [*titles, *own])
        text = "".join((written.delimiter or " ").join(row) + "\n" for row in kept)
        (folder / f"{stem}.csv").write_text(text, encoding="utf-8")


def _column_of_sensors(lines: list[str]) -> tuple[RowFormat, int] | None:
    """Return how rows among non-blank lines are written, and the column that names sensors."""
    written = first_row(lines[:_HEAD_ROWS], least=3)  # the time may be a date
    if written is None:
        return None
    rows = [written.cells(line) for line in lines[written.skip : written.skip + _HEAD_ROWS]]
    rows = [row for row in rows if len(row) == len(rows[0])]
    for column, cells in enumerate(zip(*rows, strict=True)):
        if len(rows) > 1 and sum(map(_names_sensor, cells)) >= _MIN_SHARE * len(cells):
            return written, column
    return None


def _names_sensor(cell: str) -> bool:
    """Return whether a cell names a sensor by more than a letter or two: not `n/a`."""
    return sensor_of(word for word in words_of(cell) if len(word) > 2) is not None
