"""Rows of a generic CSV below its header: times, numbers, and which rows are IMU samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from stario.sequences.readers.text import Layout, Table, is_missing, read_table
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.units import TIME_UNITS


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
    separator, columns, clock = header.separator, header.columns, header.columns["t"]
    decimal = decimal_mark(lines[header.lines :], separator)
    cells = _first_cells(path, lines, header, decimal)
    dated = with_seconds(cells[clock.index : clock.index + 1])
    layout = Layout(header.lines, separator, decimal, dated != cells[clock.index :][:1])
    names = ["t", *(name for name in QUANTITIES if name in columns)]
    used, titles = [columns[n].index for n in names], [columns[n].title for n in names]
    table = read_table(path, used, layout, titles, killed=ends_within_a_row(path, separator))
    is_imu = _imu_rows(table, [names.index(name) for name in IMU])
    if not is_imu.any():
        raise ReadError(path, "gx", "no row with IMU samples", "numbers in every IMU column")
    finite = table.values[np.isfinite(table.values[:, 0]), 0]
    unit_ns, assumed = (10**9, "") if layout.dated else _unit_ns(path, clock, finite)
    time = table.seconds(clock.index, clock.title, unit_ns, int(np.argmax(is_imu)))
    values = dict(zip(names[1:], table.values[:, 1:].T, strict=True))
    return Rows(values, time, is_imu, table.line_numbers, assumed)


def _first_cells(path: Path, lines: list[str], header: Header, decimal: str) -> list[str]:
    """Return the cells of the first row, checked to be no more than there are titles."""
    numbered = enumerate(lines[header.lines :], header.lines + 1)
    number, first = next(((k, line) for k, line in numbered if is_row(line)), (0, ""))
    cells = unquoted(first, header.separator, decimal).rstrip(f"{header.separator} ")
    count = cells.count(header.separator) + 1
    if count > len(header.titles):
        found, expected = f"{count} values", f"{len(header.titles)} as in the header"
        fix = "name every column, and write decimal points"
        raise ReadError(path, f"line {number}", found, expected, fix)
    return cells.split(header.separator)


def _imu_rows(table: Table, imu: list[int]) -> BoolArray:
    """Return the mask (N,) of IMU samples: rows whose IMU cells are not all blank."""
    is_imu = np.ones(len(table.values), dtype=np.bool_)
    if len(empty := np.flatnonzero(np.isnan(table.values[:, imu]).all(axis=1))):
        texts = [table.cells(table.columns[k]) for k in imu]
        is_imu[empty] = [not all(is_missing(text[k]) for text in texts) for k in empty.tolist()]
    return is_imu


def _unit_ns(path: Path, column: Column, time: FloatArray) -> tuple[int, str]:
    """Return the unit of times [ns], and the one assumed by the rate if the header names none."""
    if not column.unit:
        refuse_counts_and_dates(path, column.title, time)
        try:
            unit_ns = time_unit(path, time)
            return unit_ns, assumed_unit(unit_ns, float(time[0]))
        except ReadError:
            if len(time) and abs(float(time[0])) > LATEST_S:
                raise
    return unit_factor(path, column, TIME_UNITS), ""
