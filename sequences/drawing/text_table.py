"""Tables of numbers as plain text and Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

_GAP = 3


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return one line per row of cells: the first column left-aligned, the others right-aligned."""
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [
        f"{name:<{first}}"
        + "".join(f"{cell:>{_GAP + width}}" for cell, width in zip(cells, others, strict=True))
        for name, *cells in rows
    ]


def markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table without columns of no value; first come the titles."""
    columns = [c for c in zip(*rows, strict=True) if any(cell != "-" for cell in c[1:])]
    head, *body = (f"| {' | '.join(cells)} |" for cells in zip(*columns, strict=True))
    return [head, f"|{'---|' * len(columns)}", *body]


def figure(value: float | None, form: str = ".3f") -> str:
    """Format a number for a table; "-" if there is none."""
    return "-" if value is None or math.isnan(value) else format(value, form)
