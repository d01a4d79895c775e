"""Head of a text file's table: separator, decimal mark, titles and first rows.

Cells are separated by commas, semicolons, tabs or blanks; with any of the latter three, numbers may
have a decimal comma. The first row of numbers determines both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from stario.sequences.arrays import number_in
from stario.sequences.errors import ReadError
from stario.sequences.readers.columns import with_units_below
from stario.sequences.readers.phones.sensor_words import axis_of, is_time, words_of
from stario.sequences.readers.text import (
    Column,
    RowFormat,
    Table,
    decimal_mark,
    head_lines,
    is_missing,
    read_table,
    unquoted,
    with_seconds,
)
from stario.sequences.sequence import FloatArray

_SEPARATORS = (";", "\t", ",", None)
"""Separators in the order in which they are tried, None for blanks; a comma may be the decimal mark
as well if cells are quoted."""

_MARK_ROWS = 5
"""Number of rows that determine the decimal mark."""

_HEAD_LINES, _HEAD_ROWS = 96, 24
"""Number of lines within which the rows must begin, and of the rows that show what columns hold."""

_TITLES = {
    *map("".join, product(("device", "imu", "node"), ("", "id", "name", "number", "address"))),
    *("i", "instance", "mac", "macaddress", "serial", "serialnumber"),
    *("side", "limb", "placement", "bodypart", "sensorlocation", "sensorplacement"),
}
"""Titles, without blanks and the like, of such a column; `I` is that of ArduPilot's logs."""

_MOST = 9
"""Number of different values above which a column says something else."""


@dataclass(frozen=True)
class TableHead:
    """How to read a file's rows, and the first of them.

    Attributes:
        file: the file.
        row_format: how its rows are written.
        titles: titles of the columns; empty without any.
        rows: (N, K) first rows, NaN where a cell is not a number.
        dates: indices of the columns with dates or times of day, which become seconds.
    """

    file: Path
    row_format: RowFormat
    titles: list[str]
    rows: FloatArray
    dates: frozenset[int] = frozenset()

    def read(self, columns: int | Sequence[Column]) -> Table:
        """Read columns, the clock first, without a last row that is cut short."""
        return read_table(self.file, columns, self.row_format, killed=True)

    def clock(self, column: Column) -> Column:
        """Return a clock's column with its unit, seconds if it holds dates."""
        return replace(column, unit="s") if column.index in self.dates else column


def table_heads(file: Path, least: int = 4) -> Iterator[TableHead]:
    """Yield the head of a file's table and, if there are dates, that with dates as seconds.

    Yields nothing without a row of `least` numbers; never raises.
    """
    lines = head_lines(file)
    numbers = [k for k, line in enumerate(lines) if line.strip()][:_HEAD_LINES]
    written = [lines[k] for k in numbers]
    if head := _head(file, numbers, written, least):
        yield head
    in_seconds = with_seconds(written)
    if in_seconds != written and (head := _head(file, numbers, in_seconds, least)):
        row_format = head.row_format
        cells = row_format.cells(written[numbers.index(row_format.skip)])
        dates = frozenset(k for k, cell in enumerate(cells) if math.isnan(number_of(cell)))
        yield replace(head, dates=dates, row_format=replace(row_format, dated=bool(dates)))


def _head(file: Path, numbers: list[int], lines: list[str], least: int) -> TableHead | None:
    """Return the head of a table in lines without blank ones, given their numbers in the file."""
    found = first_row(lines, least)
    if found is None:
        return None
    first, delimiter = found.skip, found.delimiter
    rows = [found.cells(line) for line in lines[first:]]
    rows = (rows[:-1] if len(rows) > 2 else rows)[:_HEAD_ROWS]  # the last line may be cut
    width = max(set(map(len, rows)), key=list(map(len, rows)).count)
    above = lines[:first]
    while above and _is_incomplete_row(found.cells(above[-1])):
        above.pop()
    titles = _titles(above, delimiter, width)
    values = np.array([[number_of(cell) for cell in row] for row in rows if len(row) == width])
    return TableHead(file, replace(found, skip=numbers[first]), titles[:width], values)


def _titles(above: list[str], delimiter: str | None, width: int) -> list[str]:
    """Return the titles of `width` columns in a line above the rows, or in one above their units.

    They may be separated in another way than the rows, as NumPy's `savetxt` writes them, and lines
    of other text may follow them.
    """
    separators = dict.fromkeys((delimiter, ",", ";", "\t"))
    nearest = (above[:end] for end in range(len(above), 0, -1))
    lines = [_titles_at(upto, separator) for upto in nearest for separator in separators]
    found = [titles for titles in lines if len(titles) == width]
    if found:
        named = (some for some in found if any(is_time(one) or axis_of(one) for one in some))
        return next(named, found[0])
    return [] if delimiter is None else _titles_at(above, delimiter)  # not the words of a comment


def _is_incomplete_row(cells: list[str]) -> bool:
    """Return whether cells are those of a row with few numbers: a sensor has not started yet."""
    present = [cell for cell in cells if not is_missing(cell) and cell.strip().lower() != "nan"]
    return bool(present) and all(math.isfinite(number_of(cell)) for cell in present)


def _titles_at(above: list[str], delimiter: str | None) -> list[str]:
    lines = [unquoted(line.lstrip("# "), delimiter).split(delimiter) for line in above[-2:]]
    titles = with_units_below(*lines) if len(lines) == 2 else None
    titles = titles or (lines[-1] if lines else [])
    return [title.strip(" #\"'\ufeff") for title in titles]


def first_row(lines: list[str], least: int = 4) -> RowFormat | None:
    """Return how rows are written, by the first of `least` numbers, if any; no line is blank."""
    for k, line in enumerate(lines):
        if line.lstrip().startswith("#"):
            continue
        for delimiter in _SEPARATORS:
            decimal = decimal_mark(lines[k : k + _MARK_ROWS], delimiter)
            row_format = RowFormat(k, delimiter, decimal)
            cells = row_format.cells(line)
            numbers = sum(math.isfinite(number_of(cell)) for cell in cells)
            if numbers >= least and 2 * numbers >= sum(bool(cell.strip()) for cell in cells):
                return row_format
    return None


def number_of(cell: str) -> float:
    """Return the number in a cell, perhaps quoted; NaN if it holds none."""
    return number_in(cell.strip(" \"'"))


def refuse_several_devices(table: Table, titles: Sequence[str], column: int) -> None:
    """Refuse rows of several devices, whose samples must not be mixed.

    Rows in which a column of the sensor is blank do not count.
    """
    for index, title in enumerate(titles):
        if "".join(words_of(title)) not in _TITLES:
            continue
        pairs = zip(table.cells(index), table.cells(column), strict=True)
        devices = dict.fromkeys(device for device, cell in pairs if not is_missing(cell))
        if 1 < len(devices) <= _MOST:
            names = ", ".join(name or "blank" for name in devices)
            found = f"several devices ({names})"
            raise ReadError(table.path, title.strip(), found, "one", "keep the rows of one")
