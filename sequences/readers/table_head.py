"""Separator of the cells and decimal mark of a text file, determined by its first row of numbers.

Cells are separated by commas, semicolons, tabs or blanks; with any of the latter three, numbers may
have a decimal comma.
"""

from __future__ import annotations

import math

from stario.sequences.arrays import number_in

_FORMS: tuple[tuple[str | None, str], ...] = (
    *((";", "."), (";", ","), ("\t", "."), ("\t", ","), (",", "."), (None, "."), (None, ",")),
)
"""Separators (None for blanks) and decimal marks in the order in which they are tried."""

_MARK_ROWS = 5
"""Number of rows that determine the decimal mark."""


def first_row(
    numbered: list[tuple[int, str]], least: int = 4
) -> tuple[int, str | None, str] | None:
    """Return the index of the first row of `least` numbers, its delimiter and its decimal mark.

    The lines have their numbers in the file; there are no blank ones among them.
    """
    for k, (_, line) in enumerate(numbered):
        if line.lstrip().startswith("#"):
            continue
        for delimiter, decimal in _FORMS:
            cells = cells_of(line, delimiter, decimal)
            numbers = _count_numbers(cells)
            if numbers >= least and 2 * numbers >= sum(bool(cell.strip()) for cell in cells):
                return k, delimiter, _decimal_mark(numbered[k : k + _MARK_ROWS], delimiter, decimal)
    return None


def cells_of(line: str, delimiter: str | None, decimal: str) -> list[str]:
    """Return a line's cells, with decimal points."""
    return (line.replace(",", ".") if decimal == "," else line).split(delimiter)


def number_of(cell: str) -> float:
    """Return the number in a cell, perhaps quoted; NaN if it holds none."""
    return number_in(cell.strip(" \"'"))


def _count_numbers(cells: list[str]) -> int:
    return sum(math.isfinite(number_of(cell)) for cell in cells)


def _decimal_mark(rows: list[tuple[int, str]], delimiter: str | None, first: str) -> str:
    """Return the mark that gives the most numbers: a row of integers (0;0;0;0) fits either."""
    if delimiter == ",":
        return first

    def numbers(decimal: str) -> int:
        return sum(_count_numbers(cells_of(line, delimiter, decimal)) for _, line in rows)

    return max((first, "." if first == "," else ","), key=numbers)
