"""Columns of a CSV by the names in its header."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import checked
from stario.sequences.readers.text import Table, first_line, read_lines, read_table
from stario.sequences.sequence import FloatArray


def header_names(path: Path) -> list[str]:
    """The cells of a file's first line, empty for a file that is no text; never raises."""
    return [cell.strip().strip('"') for cell in (first_line(path) or "").split(",")]


class NamedColumns:
    """Columns of a CSV with a header, all finite.

    Args:
        path: the file.
        names: the columns to read.
        optional: stems whose x, y and z are read where they are; they need not be finite.

    Raises:
        ReadError: the file or a column is missing, a row is cut short, or a cell is no finite
            number.
    """

    def __init__(self, path: Path, names: Collection[str], optional: Collection[str] = ()) -> None:
        header = header_names(path)
        if header == [""]:
            read_lines(path)  # a missing or empty file is told from a missing column
        missing = [name for name in names if name not in header]
        if missing:
            raise ReadError(path, "header", f"no {', '.join(missing)}", "one column of that name")
        self._stems = [stem for stem in optional if set(axes_of(stem)) <= set(header)]
        read = [*names, *(name for stem in self._stems for name in axes_of(stem))]
        self._places = {name: k for k, name in enumerate(read)}
        self._columns = [header.index(name) for name in read]
        self.table: Table = read_table(path, max(self._columns) + 1, skip=1, used=self._columns)
        if not np.isfinite(self.table.values[:, : len(names)]).all():
            for name in names:
                checked(path, name, self[name], self.table.first_row)

    def __getitem__(self, name: str) -> FloatArray:
        """A column (N,)."""
        return self.table.values[:, self._places[name]]

    def stack(self, stem: str, axes: str = "xyz") -> FloatArray:
        """The columns `stem_x`, `stem_y`, ... side by side (N, K)."""
        return self.table.values[:, [self._places[f"{stem}_{axis}"] for axis in axes]]

    def optional(self) -> FloatArray | None:
        """The first of the optional stems' columns that there is (N, 3)."""
        return self.stack(self._stems[0]) if self._stems else None

    def file_column(self, name: str) -> int:
        """Where a column stands in the file."""
        return self._columns[self._places[name]]


def axes_of(stem: str, axes: str = "xyz") -> list[str]:
    """The names `stem_x`, `stem_y`, ..."""
    return [f"{stem}_{axis}" for axis in axes]
