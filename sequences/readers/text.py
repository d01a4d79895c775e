"""Numbers from comma-separated files, with errors that name file, line and column."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.sequence import FloatArray


def read_lines(path: Path) -> list[str]:
    """Lines of a text file.

    Raises:
        ReadError: the file is missing, empty or not text.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise ReadError(path, "file", "nothing there", "a readable file") from None
    except (UnicodeDecodeError, IsADirectoryError) as error:
        raise ReadError(path, "file", type(error).__name__, "UTF-8 text") from None
    if not any(line.strip() for line in lines):
        raise ReadError(path, "file", "no line", "rows of numbers", "is the download complete?")
    return lines


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
    rows = [line for line in lines[skip:] if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise ReadError(path, "rows", "none below the header", "rows of numbers")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = np.loadtxt(rows, delimiter=",", ndmin=2, usecols=range(columns))
        if time_ns:
            table[:, 0] = _seconds_since_first(rows)
    except (ValueError, IndexError):
        table = np.array(
            [
                _row(path, k, text, columns)
                for k, text in enumerate(lines, 1)
                if k > skip and text.strip() and not text.lstrip().startswith("#")
            ]
        )
        if time_ns:
            table[:, 0] = _seconds_since_first(rows)
    return np.asarray(table, dtype=np.float64)


def first_time_ns(path: Path) -> int:
    """The first row's time stamp [ns] of a file whose first column is integer nanoseconds."""
    for line in read_lines(path):
        if line.strip() and not line.lstrip().startswith("#"):
            cell = line.split(",")[0].strip()
            try:
                return int(float(cell)) if "." in cell or "e" in cell.lower() else int(cell)
            except ValueError:
                raise ReadError(path, "time", repr(cell), "nanoseconds") from None
    raise ReadError(path, "rows", "none below the header", "rows of numbers")


def _seconds_since_first(rows: list[str]) -> FloatArray:
    stamps = [
        int(float(c)) if "." in c or "e" in c.lower() else int(c)
        for c in (row.split(",", 1)[0].strip() for row in rows)
    ]
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
