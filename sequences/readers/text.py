"""Reading of numbers from text files, with errors that name file, line and column."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import ReadError
from stario.sequences.readers.dates import with_seconds
from stario.sequences.readers.lines import ends_within_a_row, read_lines, unquoted
from stario.sequences.readers.rows import NumberedLine, parsed_rows, rows_below
from stario.sequences.sequence import FloatArray
from stario.sequences.units import FILETIME_1970, FILETIME_PER_SECOND

_log = logging.getLogger(__name__)

IntArray = NDArray[np.int64]

_LARGE_BYTES = 2_000_000


@dataclass(frozen=True)
class Table:
    """Rows of numbers as they are in a file.

    Attributes:
        path: the file.
        values: (N, K) numbers; `nan` and empty cells are NaN.
        first_row: line number of the first row in the file, counted from 1.
        cells: function that returns the text of a column of the file.
        frame: the numbers as pandas read them, None otherwise.
    """

    path: Path
    values: FloatArray
    first_row: int
    cells: Callable[[int], list[str]]
    frame: Any = None

    def numbers(self, column: int) -> NDArray[Any] | None:
        """Return a column that was read, integers if all are written so; None without pandas."""
        return None if self.frame is None else self.frame[column].to_numpy()

    def stamps_ns(
        self, column: int = 0, per_second: int = 10**9, rows: IntArray | None = None
    ) -> IntArray:
        """Return a column of times (N,) as integer nanoseconds, which float64 cannot hold exactly.

        Args:
            column: index of the column in the file.
            per_second: number of the column's units in a second.
            rows: rows to return the times of; all if None.

        Raises:
            ReadError: a cell is not a time.
        """
        unit_ns = 10**9 // per_second
        since_1970 = FILETIME_1970 if per_second == FILETIME_PER_SECOND else 0
        rows = np.arange(len(self.values)) if rows is None else rows
        numbers = self.numbers(column)
        numbers = None if numbers is None else numbers[rows]
        if numbers is not None and numbers.dtype.kind == "i":
            return np.asarray((numbers.astype(np.int64) - since_1970) * unit_ns, dtype=np.int64)
        if (
            not since_1970
            and numbers is not None
            and np.spacing(np.abs(numbers).max()) * unit_ns < 0.5
        ):
            return np.asarray(np.rint(numbers * unit_ns), dtype=np.int64)
        cells = self.cells(column)
        try:
            stamps = [(int(cells[k]) - since_1970) * unit_ns for k in rows]
        except ValueError:
            stamps = [self._stamp(k, cells[k], unit_ns) for k in rows.tolist()]
        try:
            return np.array(stamps, dtype=np.int64)
        except OverflowError:
            found = f"a time of {max(map(abs, stamps)):.3g} ns"
            fix = "is its unit the one that the header names?"
            raise ReadError(self.path, "time", found, "at most 9.2e18 ns", fix) from None

    def _stamp(self, row: int, cell: str, unit_ns: int) -> int:
        try:
            whole, _, fraction = cell.strip().partition(".")
            if whole.isdecimal() and (fraction.isdecimal() or not fraction):
                # By digits: seconds since 1970 with nine decimals exceed the precision of a float.
                return int(whole) * unit_ns + round(float(f"0.{fraction or 0}") * unit_ns)
            return round(float(cell) * unit_ns)
        except (ValueError, OverflowError):
            where = f"line {row + self.first_row}, time"
            raise ReadError(self.path, where, repr(cell.strip()), "a time") from None


def read_table(
    path: Path,
    columns: int | list[int],
    skip: int = 0,
    delimiter: str | None = ",",
    decimal: str = ".",
    killed: bool = False,
    dated: bool = False,
) -> Table:
    """Read rows of numbers; `nan` and empty cells become NaN.

    Args:
        path: the file; lines that start with `#` are skipped.
        columns: number of columns to return, or the indices of those to return.
        skip: number of header lines.
        delimiter: separator of the cells; None for blanks.
        decimal: decimal mark, a point or a comma.
        killed: whether to skip a last row that is cut short because the app was killed.
        dated: whether to read dates and times of day as seconds, as `with_seconds` does.

    Raises:
        ReadError: a row is cut short or holds something that is not a number.
    """
    wanted = list(range(columns)) if isinstance(columns, int) else columns
    cut = killed and ends_within_a_row(path, delimiter)
    quick = None if cut or dated else read_quickly(path, skip, delimiter, wanted, decimal)
    if quick is not None:
        return quick
    numbered = _numbered_rows(path, skip, delimiter, decimal, dated)
    if killed and len(numbered) > 1 and (cut or not _is_row(path, numbered[-1], delimiter, wanted)):
        _log.warning("%s: skipped the last row, which is cut short", path)
        numbered.pop()
    values = parsed_rows(path, numbered, delimiter, wanted)
    return Table(path, values, numbered[0][0], partial(_column, numbered, delimiter))


def read_quickly(
    path: Path, skip: int, delimiter: str | None, wanted: list[int], decimal: str = "."
) -> Table | None:
    """Read a large file with pandas, five times as fast as with NumPy; return None if it cannot.

    It cannot read a small file, or any without pandas, nor blank or malformed cells or rows cut
    short, which only the slow reader reports. Arguments are those of `read_table`; `wanted` are the
    indices of its columns.
    """
    try:
        if path.stat().st_size < _LARGE_BYTES or _has_mark_within_a_row(path.read_bytes()):
            return None
        pandas = importlib.import_module("pandas")
        frame = pandas.read_csv(
            path,
            sep=r"\s+" if delimiter is None else delimiter,
            header=None,
            skiprows=skip,
            usecols=sorted(wanted),
            comment="#",
            decimal=decimal,
            na_filter=False,
        )
    except (ImportError, OSError, ValueError, UnicodeDecodeError):
        return None
    if not all(kind.kind in "if" for kind in frame.dtypes) or not len(frame):
        return None

    def cells(column: int) -> list[str]:
        return _column(_numbered_rows(path, skip, delimiter, decimal), delimiter, column)

    return Table(path, frame[wanted].to_numpy(dtype=np.float64), skip + 1, cells, frame)


def _has_mark_within_a_row(content: bytes) -> bool:
    """Return whether a `#` begins no comment, as in `-1.#IND`, of which pandas would read -1."""
    return content.count(b"#") > content.startswith(b"#") + content.count(b"\n#")


def _numbered_rows(
    path: Path, skip: int, delimiter: str | None, decimal: str, dated: bool = False
) -> list[NumberedLine]:
    """Return the rows below `skip` lines, with decimal points and without quotes or dates."""
    lines = [unquoted(line, delimiter, decimal) for line in read_lines(path)]
    return rows_below(path, with_seconds(lines) if dated else lines, skip)


def _is_row(path: Path, row: NumberedLine, delimiter: str | None, wanted: list[int]) -> bool:
    try:
        parsed_rows(path, [row], delimiter, wanted)
    except ReadError:
        return False
    return True


def _column(numbered: list[NumberedLine], delimiter: str | None, column: int) -> list[str]:
    return [line.split(delimiter, column + 1)[column] for _, line in numbered]


def seconds(stamps_ns: IntArray, origin_ns: np.int64 | int) -> FloatArray:
    """Convert time stamps [ns] to seconds since an origin."""
    return (stamps_ns - origin_ns).astype(np.float64) * 1e-9
