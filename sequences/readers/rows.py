"""Rows of a text file as numbers, with errors that name the line and the column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import is_row
from stario.sequences.sequence import FloatArray

NumberedLine = tuple[int, str]
"""Number of a line in its file, counted from 1, and its text."""


def rows_below(path: Path, lines: list[str], skip: int) -> list[NumberedLine]:
    """Return a file's lines below its header that hold cells, with their numbers.

    Raises:
        ReadError: there is none.
    """
    numbered = [(k, line) for k, line in enumerate(lines[skip:], skip + 1) if is_row(line)]
    if not numbered:
        raise ReadError(path, "rows", "none below the header", "rows of numbers")
    return numbered


def parsed_rows(
    path: Path,
    numbered: list[NumberedLine],
    delimiter: str | None,
    columns: Sequence[int],
    titles: Sequence[str] = (),
) -> FloatArray:
    """Return columns of rows as numbers (N, K), NaN where a cell holds none.

    Args:
        path: the file, for errors.
        numbered: the rows.
        delimiter: separator of the cells; None for blanks.
        columns: indices of the columns.
        titles: names of these columns for errors; their numbers if empty.

    Raises:
        ReadError: a row is cut short or holds something that is not a number.
    """
    rows = [line for _, line in numbered]
    with suppress(ValueError, IndexError):
        return np.loadtxt(rows, comments=None, delimiter=delimiter, ndmin=2, usecols=columns)
    if delimiter is not None:
        filled = _blank(delimiter).sub("nan", "\n".join(rows)).split("\n")
        with suppress(ValueError, IndexError):
            return np.loadtxt(filled, comments=None, delimiter=delimiter, ndmin=2, usecols=columns)
    titles = titles or [f"column {k + 1}" for k in columns]
    return np.array([_row(path, row, delimiter, columns, titles) for row in numbered])


def _blank(delimiter: str) -> re.Pattern[str]:
    """Return a pattern for blank cells within a line; a line end is not a blank."""
    blanks = rf"[^\S\n{delimiter}]*"
    return re.compile(
        rf"(?<={delimiter}){blanks}(?={delimiter}|$)|^{blanks}(?={delimiter})", flags=re.MULTILINE
    )


def _row(
    path: Path,
    numbered: NumberedLine,
    delimiter: str | None,
    columns: Sequence[int],
    titles: Sequence[str],
) -> list[float]:
    """Parse one row slowly, to raise an error that names its line and column."""
    check_width(path, numbered, delimiter, 1 + max(columns))
    number, line = numbered
    cells, row = line.split(delimiter), []
    for column, title in zip(columns, titles, strict=True):
        cell = cells[column].strip()
        try:
            row.append(float("nan") if is_missing(cell) else float(cell))
        except ValueError:
            fix = "write a decimal point" if "," in cell else ""
            where = f"line {number}, {title}"
            raise ReadError(path, where, repr(cell), "a number", fix) from None
    return row


def check_width(path: Path, numbered: NumberedLine, delimiter: str | None, needed: int) -> None:
    """Check that a row has the cells that are needed.

    Raises:
        ReadError: it is cut short.
    """
    number, line = numbered
    count = len(line.split(delimiter))
    if count < needed:
        fix = "is the file cut short?"
        if count == 1 and delimiter is not None:
            fix = f"separate the values by {delimiter!r} as in the other lines, or remove the line"
        raise ReadError(path, f"line {number}", f"{count} values", f"{needed}", fix)


def is_missing(cell: str) -> bool:
    """Return whether a cell is blank or says that there is no value."""
    return cell.strip().lower() in ("", "na", "n/a", "null", "none")
