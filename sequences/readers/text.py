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
class Table:
    """Columns of a file as numbers.

    Attributes:
        path: the file.
        row_format: how it is written.
        columns: indices of the columns in the file.
        values: (N, K) their numbers; `nan` and empty cells are NaN.
        rows: the rows as text.
    """

    path: Path
    row_format: RowFormat
    columns: list[int]
    values: FloatArray
    rows: list[Row]

    @property
    def line_numbers(self) -> list[int]:
        """Number of each row's line."""
        return [number for number, _ in self.rows]

    def cells(self, column: int) -> list[str]:
        """Return the text of a column of the file, empty in rows that are too short."""
        mark = self.row_format.delimiter
        cells = (line.split(mark, column + 1) for _, line in self.rows)
        return [row[column].strip() if column < len(row) else "" for row in cells]

    def stamps_ns(
        self, column: int = 0, unit_ns: int = 1, kept: IntArray | None = None
    ) -> IntArray:
        """Return a column of times (N,) as integer nanoseconds, which float64 cannot hold exactly.

        Args:
            column: index of the column in the file.
            unit_ns: its unit [ns].
            kept: rows to return the times of; all if None.
        """
        rows = range(len(self.rows)) if kept is None else kept.tolist()
        since_1970 = FILETIME_1970 if unit_ns == FILETIME_NS else 0
        times = self._times(column, "time", rows, finite=True)
        try:
            stamps = [round((time - since_1970) * unit_ns) for time in times]
            return np.array(stamps, dtype=np.int64)
        except OverflowError:
            found = f"a time of {float(max(map(abs, times)) * unit_ns):.3g} ns"
            fix = "is its unit the one that the header names?"
            raise ReadError(self.path, "time", found, "at most 9.2e18 ns", fix) from None

    def seconds(self, column: int, title: str, unit_ns: int, origin: int) -> FloatArray:
        """Return a column of times (N,) as seconds since those of a row, exactly as written.

        Args:
            column: index of the column in the file.
            title: its title, for errors.
            unit_ns: its unit [ns].
            origin: the row; if it has no time, the first one below that has.
        """
        times = self._times(column, title, range(len(self.rows)), finite=False)
        start = next((time for time in times[origin:] if time.is_finite()), Decimal(0))
        return np.array([float((time - start) * unit_ns / 10**9) for time in times])

    def _times(self, column: int, title: str, rows: Iterable[int], finite: bool) -> list[Decimal]:
        cells, times = self.cells(column), list[Decimal]()
        for row in rows:
            try:
                time = Decimal(cells[row])
            except InvalidOperation:
                time = None
            if time is None or (finite and not time.is_finite()):
                where = f"line {self.line_numbers[row]}, {title}"
                raise ReadError(self.path, where, repr(cells[row]), "a time")
            times.append(time)
        return times


def read_table(
    path: Path,
    columns: int | list[int],
    row_format: RowFormat = RowFormat(),
    titles: Sequence[str] = (),
    killed: bool = False,
) -> Table:
    """Read columns of numbers; `nan` and empty cells become NaN.

    Args:
        path: the file.
        columns: number of columns to return, or the indices of those to return.
        row_format: how the rows are written.
        titles: titles of these columns, for errors.
        killed: whether to skip a last row that is cut short because the recorder was killed.

    Raises:
        ReadError: a row is cut short or holds something that is not a number.
    """
    wanted = list(range(columns)) if isinstance(columns, int) else columns
    rows, mark = row_format.rows(path), row_format.delimiter
    titles = titles or [f"column {k + 1}" for k in wanted]
    if killed and len(rows) > 1:
        cut = ends_within_a_row(path, mark)
        try:
            _numbers_in_row(path, row_format, rows[-1], wanted, titles)
        except ReadError:
            cut = True
        if cut:
            _log.warning(
                "%s: skipped the last row, line %d, which is cut short", path, rows.pop()[0]
            )
    try:  # several times as fast, but it neither knows blank cells nor explains what is wrong
        lines = [line for _, line in rows]
        values = np.loadtxt(lines, delimiter=mark, usecols=wanted, comments=None, ndmin=2)
    except ValueError:
        values = np.array([_numbers_in_row(path, row_format, row, wanted, titles) for row in rows])
    return Table(path, row_format, wanted, values, rows)


def _numbers_in_row(
    path: Path, row_format: RowFormat, row: Row, wanted: list[int], titles: Sequence[str]
) -> list[float]:
    """Return the numbers in some columns of a row, NaN where a cell holds none."""
    number, cells = row[0], row[1].split(row_format.delimiter)
    if len(cells) <= max(wanted):
        fix = "is the file cut short?"
        if len(cells) == 1:
            fix = "separate the values as in the other lines, or remove the line"
        found = f"{len(cells)} values"
        raise ReadError(path, f"line {number}", found, f"{max(wanted) + 1}", fix)
    numbers = []
    for column, title in zip(wanted, titles, strict=True):
        cell = cells[column]
        try:
            numbers.append(float(cell or "nan"))
        except ValueError:
            if not is_missing(cell):
                fix = "write a decimal point" if "," in cell else ""
                where = f"line {number}, {title}"
                raise ReadError(path, where, repr(cell.strip()), "a number", fix) from None
            numbers.append(float("nan"))
    return numbers


def is_missing(cell: str) -> bool:
    """Return whether a cell is blank or says that there is no value."""
    return cell.strip().lower() in ("", "na", "n/a", "null", "none")


def seconds(stamps_ns: IntArray, origin_ns: np.int64 | int) -> FloatArray:
    """Convert time stamps [ns] to seconds since an origin."""
    return (stamps_ns - origin_ns).astype(np.float64) * 1e-9
