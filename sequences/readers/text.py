"""Rows of numbers in text files, read exactly; errors name file, line and column."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import (
    ends_within_a_row,
    is_row,
    read_lines,
    unquoted,
    with_seconds,
)
from stario.sequences.sequence import FloatArray
from stario.sequences.units import FILETIME_1970, FILETIME_NS

_log = logging.getLogger(__name__)

IntArray = NDArray[np.int64]

Row = tuple[int, str]
"""Number of a row's line in its file, counted from 1, and its text."""


@dataclass(frozen=True)
class RowFormat:
    """How the rows of a file are written.

    Attributes:
        skip: number of lines above the rows; below, lines that start with `#` are skipped.
        delimiter: separator of the cells; None for blanks.
        decimal: decimal mark, a point or a comma.
        dated: whether dates and times of day are read as seconds, as `with_seconds` does.
    """

    skip: int = 0
    delimiter: str | None = ","
    decimal: str = "."
    dated: bool = False

    def cells(self, line: str) -> list[str]:
        """Return a line's cells without quotes, with decimal points."""
        return unquoted(line, self.delimiter, self.decimal).split(self.delimiter)

    def rows(self, path: Path) -> list[Row]:
        """Return the rows of a file, without quotes."""
        lines = read_lines(path)
        if self.decimal != "." or any('"' in line for line in lines):
            lines = [unquoted(line, self.delimiter, self.decimal) for line in lines]
        lines = with_seconds(lines) if self.dated else lines
        rows = [row for row in enumerate(lines[self.skip :], self.skip + 1) if is_row(row[1])]
        if not rows:
            raise ReadError(path, "rows", "none below the header", "rows of numbers")
        return rows


@dataclass(frozen=True)
class Column:
    """A column's index, its title, and the unit in that in the tables' spelling, if any."""

    index: int
    title: str = ""
    unit: str = ""

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.title or f"column {self.index + 1}"


@dataclass(frozen=True)
class Table:
    """Columns of a file as numbers, the first of them times.

    Attributes:
        path: the file.
        row_format: how it is written.
        columns: places of the columns in the file.
        values: (N, K) their numbers; `nan` and empty cells are NaN.
        rows: the rows as text.
    """

    path: Path
    row_format: RowFormat
    columns: Sequence[Column]
    values: FloatArray
    rows: list[Row]

    @property
    def line_numbers(self) -> IntArray:
        """Number (N,) of each row's line."""
        return np.array([number for number, _ in self.rows])

    def cells(self, column: int) -> list[str]:
        """Return the text of a column of the file, empty in rows that are too short."""
        mark = self.row_format.delimiter
        cells = (line.split(mark, column + 1) for _, line in self.rows)
        return [row[column].strip() if column < len(row) else "" for row in cells]

    def stamps_ns(self, unit_ns: int = 1, kept: IntArray | None = None) -> IntArray:
        """Return the times (N,), or those of `kept` rows, in integer nanoseconds.

        Their unit is `unit_ns`; float64 cannot hold them exactly.
        """
        since_1970 = FILETIME_1970 if unit_ns == FILETIME_NS else 0
        times = self._times(range(len(self.rows)) if kept is None else kept.tolist(), finite=True)
        try:
            stamps = [round((time - since_1970) * unit_ns) for time in times]
            return np.array(stamps, dtype=np.int64)
        except OverflowError:
            found = f"a time of {float(max(map(abs, times)) * unit_ns):.3g} ns"
            fix = "is its unit the one that the header names?"
            raise ReadError(self.path, "time", found, "at most 9.2e18 ns", fix) from None

    def seconds(self, unit_ns: int, origin: int) -> FloatArray:
        """Return the times (N,) as seconds since those of a row, exactly as written.

        Args:
            unit_ns: their unit [ns].
            origin: the row; if it has no time, the first one below that has.
        """
        times = self._times(range(len(self.rows)), finite=False)
        start = next((time for time in times[origin:] if time.is_finite()), Decimal(0))
        return np.array([float((time - start) * unit_ns / 10**9) for time in times])

    def _times(self, rows: Iterable[int], finite: bool) -> list[Decimal]:
        clock, times = self.columns[0], list[Decimal]()
        cells = self.cells(clock.index)
        for row in rows:
            try:
                time = Decimal(cells[row])
            except InvalidOperation:
                time = None
            if time is None or (finite and not time.is_finite()):
                where = f"line {self.rows[row][0]}, {clock.title or 'time'}"
                raise ReadError(self.path, where, repr(cells[row]), "a time")
            times.append(time)
        return times


def read_table(
    path: Path,
    columns: int | Sequence[Column],
    row_format: RowFormat = RowFormat(),
    killed: bool = False,
) -> Table:
    """Read columns of numbers, their count or places; `nan` and empty cells become NaN.

    A last row that is cut short, because the recorder was `killed`, is then skipped.
    """
    places = [Column(k) for k in range(columns)] if isinstance(columns, int) else columns
    rows, mark = row_format.rows(path), row_format.delimiter
    if killed and len(rows) > 1:
        cut = ends_within_a_row(path, mark)
        try:
            _numbers_in_row(path, rows[-1], mark, places)
        except ReadError:
            cut = True
        if cut:
            _log.warning(
                "%s: skipped the last row, line %d, which is cut short", path, rows.pop()[0]
            )
    try:  # several times as fast, but it neither knows blank cells nor explains what is wrong
        lines = [line for _, line in rows]
        used = [place.index for place in places]
        values = np.loadtxt(lines, delimiter=mark, usecols=used, comments=None, ndmin=2)
    except ValueError:
        values = np.array([_numbers_in_row(path, row, mark, places) for row in rows])
    return Table(path, row_format, places, values, rows)


def _numbers_in_row(
    path: Path, row: Row, mark: str | None, places: Sequence[Column]
) -> list[float]:
    """Return the numbers in some columns of a row, NaN where a cell holds none."""
    (number, line), most = row, max(place.index for place in places)
    cells = line.split(mark)
    if len(cells) <= most:
        fix = "is the file cut short?"
        if len(cells) == 1:
            fix = "separate the values as in the other lines, or remove the line"
        raise ReadError(path, f"line {number}", f"{len(cells)} values", f"{most + 1}", fix)
    numbers = []
    for place in places:
        cell = cells[place.index]
        try:
            numbers.append(float(cell or "nan"))
        except ValueError:
            if not is_missing(cell):
                fix = "write a decimal point" if "," in cell else ""
                where = f"line {number}, {place.name}"
                raise ReadError(path, where, repr(cell.strip()), "a number", fix) from None
            numbers.append(float("nan"))
    return numbers


def is_missing(cell: str) -> bool:
    """Return whether a cell is blank or says that there is no value."""
    return cell.strip().lower() in ("", "na", "n/a", "null", "none")


def seconds(stamps_ns: IntArray, origin_ns: np.int64 | int) -> FloatArray:
    """Convert time stamps [ns] to seconds since an origin."""
    return (stamps_ns - origin_ns).astype(np.float64) * 1e-9
