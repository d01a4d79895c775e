"""Rows of a generic CSV below its header: times, numbers, and which rows are IMU samples."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.clocks import (
    LATEST_S,
    assumed_unit,
    refuse_counts_and_dates,
    time_unit,
)
from stario.sequences.readers.columns import IMU, QUANTITIES, Column, Header, unit_factor
from stario.sequences.readers.dates import with_seconds
from stario.sequences.readers.lines import decimal_mark, ends_within_a_row, is_row, unquoted
from stario.sequences.readers.rows import (
    NumberedLine,
    check_width,
    is_missing,
    parsed_rows,
    rows_below,
)
from stario.sequences.readers.text import read_quickly
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.units import TIME_UNITS

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Rows:
    """Content of the rows.

    Attributes:
        table: columns (N,) by canonical name.
        time: (N,) times [s].
        is_imu: (N,) mask of IMU samples.
        line_numbers: line number of each row.
        assumed_unit: unit that times without one were taken for; empty if it is certain.
    """

    table: dict[str, FloatArray]
    time: FloatArray
    is_imu: BoolArray
    line_numbers: Sequence[int]
    assumed_unit: str = ""


def read_rows(path: Path, lines: list[str], header: Header) -> Rows:
    """Return the rows of a file, given its lines and its header.

    Raises:
        ReadError: there is none, or one is malformed; names its line and column.
    """
    decimal = decimal_mark(lines[header.lines :], header.separator)
    _check_width(path, lines, header, decimal)
    if len(lines) > header.lines + 1 and ends_within_a_row(path, header.separator):
        # The recorder was killed while it wrote: all earlier rows are complete.
        _log.warning("%s: skipped the last line, %d, which is cut short", path, len(lines))
        return _rows_carefully(path, lines[:-1], header, decimal)
    rows = _rows_quickly(path, header, decimal)
    return rows or _rows_carefully(path, lines, header, decimal)


def _check_width(path: Path, lines: list[str], header: Header, decimal: str) -> None:
    """Check that the first row has no more cells than there are titles: which ones lack a title?"""
    numbered = enumerate(lines[header.lines :], header.lines + 1)
    number, first = next(((k, line) for k, line in numbered if is_row(line)), (0, ""))
    cells = unquoted(first, header.separator, decimal).rstrip(f"{header.separator} ")
    count = cells.count(header.separator) + 1
    if count > len(header.titles):
        found, expected = f"{count} values", f"{len(header.titles)} as in the header"
        fix = "name every column, and write decimal points"
        raise ReadError(path, f"line {number}", found, expected, fix)


def _rows_quickly(path: Path, header: Header, decimal: str) -> Rows | None:
    """Return the rows of a large file if every row is complete, else None."""
    columns = header.columns
    names = ["t", *(name for name in QUANTITIES if name in columns)]
    used = [columns[name].index for name in names]
    quick = read_quickly(path, header.lines, header.separator, used, decimal)
    if quick is None:
        return None
    stamps = quick.numbers(columns["t"].index)
    per_second, assumed = _per_second(path, columns["t"], quick.values[:, 0])
    if stamps is not None and stamps.dtype.kind == "i":
        time = np.asarray((stamps - stamps[0]) / per_second, dtype=np.float64)
    elif stamps is not None and per_second == 1 and stamps[0] == 0.0:
        time = np.asarray(stamps, dtype=np.float64)
    else:  # long decimals must be subtracted before they are rounded
        return None
    count = len(time)
    return Rows(
        table=dict(zip(names, quick.values.T, strict=True)),
        time=time,
        is_imu=np.ones(count, dtype=np.bool_),
        line_numbers=range(quick.first_row, quick.first_row + count),
        assumed_unit=assumed,
    )


def _rows_carefully(path: Path, lines: list[str], header: Header, decimal: str) -> Rows:
    columns = header.columns
    below = rows_below(path, lines, header.lines)
    numbered = [(number, unquoted(line, header.separator, decimal)) for number, line in below]
    needed = 1 + max(column.index for column in columns.values())
    for row in numbered:
        check_width(path, row, header.separator, needed)
    if _is_dated(numbered[0][1], header):
        lines = with_seconds(line for _, line in numbered)
        numbered = [(number, line) for (number, _), line in zip(numbered, lines, strict=True)]
        columns = {**columns, "t": replace(columns["t"], unit="s")}
        header = replace(header, columns=columns)
    used = [name for name in QUANTITIES if name in columns]
    places, titles = [columns[name].index for name in used], [columns[name].title for name in used]
    values = parsed_rows(path, numbered, header.separator, places, titles)
    is_imu = _imu_rows(numbered, header, values[:, : len(IMU)])
    if not is_imu.any():
        raise ReadError(path, "gx", "no row with IMU samples", "numbers in every IMU column")
    time, assumed = _seconds(path, numbered, header, int(np.argmax(is_imu)))
    return Rows(
        table={name: values[:, k] for k, name in enumerate(used)},
        time=time,
        is_imu=is_imu,
        line_numbers=[number for number, _ in numbered],
        assumed_unit=assumed,
    )


def _is_dated(row: str, header: Header) -> bool:
    """Return whether a row's time is a date or a time of day."""
    cell = row.split(header.separator)[header.columns["t"].index :][:1]
    return with_seconds(cell) != cell


def _imu_rows(numbered: list[NumberedLine], header: Header, values: FloatArray) -> BoolArray:
    """Return the mask of IMU samples: rows whose IMU cells are not all blank."""
    is_imu = np.ones(len(values), dtype=np.bool_)
    indices = [header.columns[name].index for name in IMU]
    for k in np.flatnonzero(np.isnan(values).all(axis=1)):
        cells = numbered[k][1].split(header.separator)
        is_imu[k] = not all(is_missing(cells[index]) for index in indices)
    return is_imu


def _seconds(
    path: Path, numbered: list[NumberedLine], header: Header, origin: int
) -> tuple[FloatArray, str]:
    """Return seconds since the row `origin`, exactly from the digits, and their assumed unit."""
    column = header.columns["t"]
    stamps = []
    for number, line in numbered:
        cell = line.split(header.separator, column.index + 1)[column.index].strip()
        try:
            stamps.append(Decimal(cell))
        except InvalidOperation:
            where = f"line {number}, {column.title}"
            raise ReadError(path, where, repr(cell), "a time") from None
    finite = np.array([float(stamp) for stamp in stamps if stamp.is_finite()])
    per_second, assumed = _per_second(path, column, finite)
    start = next((stamp for stamp in stamps[origin:] if stamp.is_finite()), Decimal(0))
    return np.array([float((stamp - start) / per_second) for stamp in stamps]), assumed


def _per_second(path: Path, column: Column, time: FloatArray) -> tuple[int, str]:
    """Return the units per second and the unit assumed if the header names none, by the rate."""
    if not column.unit:
        refuse_counts_and_dates(path, column.title, time)
        try:
            per_second = time_unit(path, time)
            return per_second, assumed_unit(per_second, float(time[0]))
        except ReadError:
            if len(time) and abs(float(time[0])) > LATEST_S:
                raise
    return unit_factor(path, column, TIME_UNITS), ""
