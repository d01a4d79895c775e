"""Every table of scores as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from stario.sequences.drawing.text_table import aligned

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.evaluation.scores import Column


def rows_of(
    parts: Iterable[tuple[str, pd.DataFrame]], columns: Sequence[Column], corner: str = ""
) -> list[list[str]]:
    """Return the cells of a table, its titles first: a row for each part of the scores."""
    head = [corner, *(column.title for column in columns)]
    return [head, *([name, *(c.text(part) for c in columns)] for name, part in parts)]


def table(
    parts: Iterable[tuple[str, pd.DataFrame]],
    columns: Sequence[Column],
    corner: str = "",
    notes: Sequence[str] = (),
) -> str:
    """Return a table with a row for each part of the scores, and notes below it."""
    return "\n".join([*aligned(rows_of(parts, columns, corner)), *notes])
