"""Columns of a CSV, selected by their names in the header."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import checked
from stario.sequences.readers.text import Table, first_line, read_lines, read_table
from stario.sequences.sequence import FloatArray


def header_names(path: Path) -> list[str]:
    """Return the cells of a file's first line, [""] for a file that is not text; never raises."""
    return [cell.strip().strip('"') for cell in (first_line(path) or "").split(",")]


class NamedColumns:
    """Columns of a CSV with a header, all finite.

    Args:
        path: the file.
        names: the columns to read.
        optional: stems whose x, y and z are read if present; they need not be finite.

    Raises:
        ReadError: the file or a column is missing, a row is cut short, or a cell is not a
            finite number.
    """

    def __init__(self, path: Path, names: Collection[str], optional: Collection[str] = ()) -> None:
        header = header_names(path)
        if header == [""]:
            read_lines(path)  # raises if the file itself is missing or empty
        missing = [name for name in names if name not in header]
        if missing:
            raise ReadError(path, "header", f"no {', '.join(missing)}", "columns of these names")
        self._stems = [stem for stem in optional if set(axes_of(stem)) <= set(header)]
        read = [*names, *(name for stem in self._stems for name in axes_of(stem))]
        self._places = {name: k for k, name in enumerate(read)}
        self._columns = [header.index(name) for name in read]
        self.table: Table = read_table(path, max(self._columns) + 1, skip=1, used=self._columns)
        if not np.isfinite(self.table.values[:, : len(names)]).all():
            for name in names:
                checked(path, name, self[name], self.table.first_row)

    def __getitem__(self, name: str) -> FloatArray:
        """Return a column (N,)."""
        return self.table.values[:, self._places[name]]

    def stack(self, stem: str, axes: str = "xyz") -> FloatArray:
        """Return the columns `stem_x`, `stem_y`, ... side by side (N, K)."""
        return self.table.values[:, [self._places[f"{stem}_{axis}"] for axis in axes]]

    def optional(self) -> FloatArray | None:
        """Return the columns (N, 3) of the first optional stem present, None if none is."""
        return self.stack(self._stems[0]) if self._stems else None

    def file_column(self, name: str) -> int:
        """Return the index of a column in the file."""
        return self._columns[self._places[name]]


def axes_of(stem: str, axes: str = "xyz") -> list[str]:
    """Return the names `stem_x`, `stem_y`, ..."""
    return [f"{stem}_{axis}" for axis in axes]
