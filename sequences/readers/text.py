"""Rows of numbers in text files, read exactly; errors name file, line and column."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import ReadError
from stario.sequences.readers.dates import with_seconds
from stario.sequences.readers.lines import ends_within_a_row, is_row, read_lines, unquoted
from stario.sequences.sequence import FloatArray
from stario.sequences.units import FILETIME_1970, FILETIME_NS

_log = logging.getLogger(__name__)

IntArray = NDArray[np.int64]

Row = tuple[int, str]
"""Number of a row's line in its file, counted from 1, and its text."""

_LARGE_BYTES = 2_000_000


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
        """Return the rows of a file, without quotes.

        Raises:
            ReadError: the file cannot be read or has none.
        """
        lines = [unquoted(line, self.delimiter, self.decimal) for line in read_lines(path)]
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
        line_numbers: number of each row's line.
        rows: the rows as text; None for a file that pandas read.
        frame: the numbers as pandas read them, by column; None otherwise.
    """

    path: Path
    row_format: RowFormat
    columns: list[int]
    values: FloatArray
    line_numbers: Sequence[int]
    rows: list[Row] | None = None
    frame: Any = None

    def cells(self, column: int) -> list[str]:
        """Return the text of a column of the file, empty in rows that are too short."""
        rows = self.row_format.rows(self.path) if self.rows is None else self.rows
        mark = self.row_format.delimiter
        after = ((*line.split(mark, column + 1), *[""] * (column + 1)) for _, line in rows)
        return [cells[column].strip() for cells in after]

    def stamps_ns(
        self, column: int = 0, unit_ns: int = 1, kept: IntArray | None = None
    ) -> IntArray:
        """Return a column of times (N,) as integer nanoseconds, which float64 cannot hold exactly.

        Args:
            column: index of the column in the file.
            unit_ns: its unit [ns].
            kept: rows to return the times of; all if None.

        Raises:
            ReadError: a cell is not a time.
        """
        kept = np.arange(len(self.values)) if kept is None else kept
        since_1970 = FILETIME_1970 if unit_ns == FILETIME_NS else 0
        if self.frame is not None:
            numbers = self.frame[column].to_numpy()[kept]
            if numbers.dtype.kind == "i":
                stamps = (numbers.astype(np.int64) - since_1970) * unit_ns
                return np.asarray(stamps, dtype=np.int64)
            if not since_1970 and np.spacing(np.abs(numbers).max()) * unit_ns < 0.5:
                return np.asarray(np.rint(numbers * unit_ns), dtype=np.int64)
        cells = self.cells(column)
        exact = [self._stamp(k, cells[k], since_1970, unit_ns) for k in kept.tolist()]
        try:
            return np.array(exact, dtype=np.int64)
        except OverflowError:
            found = f"a time of {max(map(abs, exact)):.3g} ns"
            fix = "is its unit the one that the header names?"
            raise ReadError(self.path, "time", found, "at most 9.2e18 ns", fix) from None

    def _stamp(self, row: int, cell: str, since: int, unit_ns: int) -> int:
        try:
            whole, _, fraction = cell.partition(".")
            if whole.removeprefix("-").isdecimal() and not fraction:
                return (int(whole) - since) * unit_ns
            if whole.isdecimal() and fraction.isdecimal():
                # By digits: seconds since 1970 with nine decimals exceed the precision of a float.
                return (int(whole) - since) * unit_ns + round(float(f"0.{fraction}") * unit_ns)
            return round((float(cell) - since) * unit_ns)
        except (ValueError, OverflowError):
            where = f"line {self.line_numbers[row]}, time"
            raise ReadError(self.path, where, repr(cell), "a time") from None

    def seconds(self, column: int, title: str, unit_ns: int, origin: int) -> FloatArray:
        """Return a column of times (N,) as seconds since those of a row, exactly as written.

        Args:
            column: index of the column in the file.
            title: its title, for errors.
            unit_ns: its unit [ns].
            origin: the row; if it has no time, the first one below that has.

        Raises:
            ReadError: a cell is not a time.
        """
        if self.frame is not None:
            numbers = self.frame[column].to_numpy()
            if numbers.dtype.kind == "i":
                return np.asarray((numbers - numbers[origin]) * unit_ns / 1e9, dtype=np.float64)
            if unit_ns == 10**9 and numbers[origin] == 0.0:
                return np.asarray(numbers, dtype=np.float64)
        stamps = []
        for number, cell in zip(self.line_numbers, self.cells(column), strict=True):
            try:
                stamps.append(Decimal(cell))
            except InvalidOperation:
                raise ReadError(
                    self.path, f"line {number}, {title}", repr(cell), "a time"
                ) from None
        start = next((stamp for stamp in stamps[origin:] if stamp.is_finite()), Decimal(0))
        return np.array([float((stamp - start) * unit_ns / 10**9) for stamp in stamps])


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
    cut = killed and ends_within_a_row(path, row_format.delimiter)
    if not cut and (quick := _read_quickly(path, row_format, wanted)) is not None:
        return quick
    rows = row_format.rows(path)
    titles = titles or [f"column {k + 1}" for k in wanted]
    if killed and len(rows) > 1 and (cut or not _is_whole(path, row_format, rows[-1], wanted)):
        _log.warning("%s: skipped the last row, line %d, which is cut short", path, rows.pop()[0])
    values = np.array([numbers_in_row(path, row_format, row, wanted, titles) for row in rows])
    return Table(path, row_format, wanted, values, [number for number, _ in rows], rows)


def _read_quickly(path: Path, row_format: RowFormat, wanted: list[int]) -> Table | None:
    """Read a large file with pandas, five times as fast; return None if it cannot.

    It reads neither small files, for which importing pandas takes longer, nor dates, nor blank or
    malformed cells or rows cut short.
    """
    try:
        if path.stat().st_size < _LARGE_BYTES or row_format.dated or _has_mark_within_a_row(path):
            return None
        import pandas as pd  # half a second, which small files do not need

        frame = pd.read_csv(
            path,
            sep=r"\s+" if row_format.delimiter is None else row_format.delimiter,
            header=None,
            skiprows=row_format.skip,
            usecols=sorted(wanted),
            comment="#",
            decimal=row_format.decimal,
            na_filter=False,
        )
    except (OSError, ValueError):
        return None
    if not all(kind.kind in "if" for kind in frame.dtypes) or not len(frame):
        return None
    lines = range(row_format.skip + 1, row_format.skip + 1 + len(frame))
    values = frame[wanted].to_numpy(dtype=np.float64)
    return Table(path, row_format, wanted, values, lines, frame=frame)


def _has_mark_within_a_row(path: Path) -> bool:
    """Return whether a `#` begins no comment, as in `-1.#IND`, of which pandas would read -1."""
    content = path.read_bytes()
    return content.count(b"#") > content.startswith(b"#") + content.count(b"\n#")


def _is_whole(path: Path, row_format: RowFormat, row: Row, wanted: list[int]) -> bool:
    try:
        numbers_in_row(path, row_format, row, wanted, [""] * len(wanted))
    except ReadError:
        return False
    return True


def numbers_in_row(
    path: Path, row_format: RowFormat, row: Row, wanted: list[int], titles: Sequence[str]
) -> list[float]:
    """Return the numbers in some columns of a row, NaN where a cell holds none.

    Raises:
        ReadError: the row is cut short or holds something that is not a number.
    """
    number, cells = row[0], row[1].split(row_format.delimiter)
    try:
        return [float(cells[column] or "nan") for column in wanted]
    except (ValueError, IndexError):
        pass  # explained below
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
            numbers.append(float(cell))
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
