"""Columns of a CSV, selected by their names in the header."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import checked, magnetometer, rotations
from stario.sequences.readers.text import first_line, read_lines, read_table, seconds
from stario.sequences.sequence import FloatArray, Magnetometer


def header_names(path: Path) -> list[str]:
    """Return the cells of a file's first line, [""] for a file that is not text; never raises."""
    return [cell.strip().strip('"') for cell in (first_line(path) or "").split(",")]


class NamedColumns:
    """Columns of a CSV with a header, all finite.

    Args:
        path: the file.
        names: the columns to read.
        magnetic: stems, the first one present of which is the magnetic field; it may be NaN.

    Raises:
        ReadError: the file or a column is missing, a row is cut short, or a cell is not a
            finite number.
    """

    def __init__(self, path: Path, names: Collection[str], magnetic: Collection[str]) -> None:
        header = header_names(path)
        if header == [""]:
            read_lines(path)  # raises if the file itself is missing or empty
        missing = [name for name in names if name not in header]
        if missing:
            raise ReadError(path, "header", f"no {', '.join(missing)}", "columns of these names")
        present = (stem for stem in magnetic if set(axes_of(stem)) <= set(header))
        self._magnetic = next(present, None)
        read = [*names, *(axes_of(self._magnetic) if self._magnetic else [])]
        self._places = {name: k for k, name in enumerate(read)}
        self._columns = [header.index(name) for name in read]
        self._table = read_table(path, max(self._columns) + 1, skip=1, used=self._columns)
        for k, name in enumerate(names):
            checked(path, name, self._table.values[:, k], self._table.first_row)

    def stack(self, stem: str, axes: str = "xyz") -> FloatArray:
        """Return the columns `stem_x`, `stem_y`, ... side by side (N, K)."""
        return self._table.values[:, [self._places[name] for name in axes_of(stem, axes)]]

    def rotations(self, stem: str) -> Rotation:
        """Return the N rotations in the columns `stem_w`, ..., `stem_z`."""
        quat_wxyz = self.stack(stem, "wxyz")
        return rotations(self._table.path, stem, quat_wxyz, first_row=self._table.first_row)

    def seconds(self, name: str, per_second: int = 10**9) -> FloatArray:
        """Return a column of times (N,) as seconds since the first."""
        stamps = self._table.stamps_ns(self._columns[self._places[name]], per_second)
        return seconds(stamps, stamps[0])

    def magnetometer(self, time: FloatArray) -> Magnetometer | None:
        """Return the magnetic field at the rows' times (N,), None if there is none."""
        return magnetometer(time, self.stack(self._magnetic)) if self._magnetic else None


def axes_of(stem: str, axes: str = "xyz") -> list[str]:
    """Return the names `stem_x`, `stem_y`, ..."""
    return [f"{stem}_{axis}" for axis in axes]
