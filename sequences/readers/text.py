"""Numbers from comma-separated files, with errors that name file, line and column."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.sequence import FloatArray

_HEAD_BYTES = 8192


def read_lines(path: Path) -> list[str]:
    """Lines of a text file.

    Raises:
        ReadError: the file is missing, empty or not text.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise ReadError(path, "file", "nothing there", "a readable file") from None
    except (UnicodeDecodeError, OSError) as error:
        raise ReadError(path, "file", type(error).__name__, "UTF-8 text") from None
    if not any(line.strip() for line in lines):
        raise ReadError(path, "file", "no line", "rows of numbers", "is the download complete?")
    return lines


def first_line(path: Path, comments: bool = False) -> str | None:
    """The first line of a text file that is not blank, or None if it has none or is no text.

    Reads little of the file, and never raises: it serves to recognise formats.

    Args:
        path: the file.
        comments: return a line that starts with `#` as well.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return None
    if b"\0" in head:
        return None
    # The head may end within a character: what is replaced there is never looked at.
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    kept = (x for x in lines if x.strip() and (comments or not x.lstrip().startswith("#")))
    return next(kept, None)


def first_numbers(path: Path) -> list[float]:
    """The first row's numbers, or an empty list if the first row is anything else."""
    try:
        return [float(cell) for cell in (first_line(path) or "").split(",")]
    except ValueError:
        return []


def read_table(path: Path, columns: int, skip: int = 0, time_ns: bool = False) -> FloatArray:
    """Rows of comma-separated numbers as (N, columns); `nan` and empty cells become NaN.

    Args:
        path: the file; lines that start with `#` are skipped.
        columns: how many numbers a row must at least hold; more are dropped.
        skip: how many header lines come first.
        time_ns: the first column is integer nanoseconds: returned as seconds since the first row,
            because float64 cannot hold an epoch in nanoseconds.

    Raises:
        ReadError: a row is cut short or holds something that is not a number.
    """
    lines = read_lines(path)
    rows = [line for line in lines[skip:] if _is_row(line)]
    if not rows:
        raise ReadError(path, "rows", "none below the header", "rows of numbers")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = np.loadtxt(rows, delimiter=",", ndmin=2, usecols=range(columns))
    except (ValueError, IndexError):
        table = np.array(
            [
                _row(path, k, text, columns)
                for k, text in enumerate(lines, 1)
                if k > skip and _is_row(text)
            ]
        )
    if time_ns:
        table[:, 0] = _seconds_since_first(path, lines, skip)
    return np.asarray(table, dtype=np.float64)


def first_time_ns(path: Path) -> int:
    """The first row's time stamp [ns] of a file whose first column is integer nanoseconds."""
    for number, line in enumerate(read_lines(path), 1):
        if _is_row(line):
            return _stamp(path, number, line)
    raise ReadError(path, "rows", "none below the header", "rows of numbers")


def _is_row(line: str) -> bool:
    text = line.strip()
    return bool(text) and text[0] != "#"


def _stamp(path: Path, number: int, line: str) -> int:
    cell = line.split(",", 1)[0].strip()
    try:
        return int(cell) if cell.isdecimal() else int(float(cell))
    except (ValueError, OverflowError):
        raise ReadError(path, f"line {number}, time", repr(cell), "integer nanoseconds") from None


def _seconds_since_first(path: Path, lines: list[str], skip: int) -> FloatArray:
    stamps = [_stamp(path, k, x) for k, x in enumerate(lines, 1) if k > skip and _is_row(x)]
    return (np.array(stamps, dtype=np.int64) - stamps[0]).astype(np.float64) * 1e-9


def _row(path: Path, number: int, text: str, columns: int) -> list[float]:
    cells = text.split(",")
    if len(cells) < columns:
        raise ReadError(
            path,
            f"line {number}",
            f"{len(cells)} values",
            f"{columns}",
            "the file looks cut short" if number > 1 else "",
        )
    values = []
    for k, cell in enumerate(cells[:columns], 1):
        try:
            values.append(float(cell) if cell.strip() else float("nan"))
        except ValueError:
            raise ReadError(
                path, f"line {number}, column {k}", repr(cell.strip()), "a number"
            ) from None
    return values
