"""Numbers by their names: columns of a CSV with a header, fields of a JSON file."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import finite_rows, magnetometer, rotations
from stario.sequences.readers.lines import first_line, read_json, read_lines
from stario.sequences.readers.text import RowFormat, read_table, seconds
from stario.sequences.sequence import FloatArray, Magnetometer


def header_names(path: Path) -> list[str]:
    """Return the cells of a file's first line, [""] for a file that is not text; never raises."""
    return [cell.strip().strip('"') for cell in (first_line(path) or "").split(",")]


class NamedColumns:
    """Columns of a CSV with a header: its rows without a cell that is not finite.

    Args:
        path: the file.
        names: the columns to read.
        magnetic: stems, the first one present of which is the magnetic field; it may be NaN.

    Raises:
        ReadError: the file or a column is missing, a row is cut short, a cell is not a number, or
            most rows have one that is not finite.
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
        self._table = read_table(path, self._columns, RowFormat(skip=1))
        values = self._table.values[:, : len(names)]
        damaged = np.flatnonzero(~np.isfinite(values).all(axis=0))
        self._rows = finite_rows(path, ", ".join(read[k] for k in damaged), values)

    def stack(self, stem: str, axes: str = "xyz") -> FloatArray:
        """Return the columns `stem_x`, `stem_y`, ... side by side (N, K)."""
        return self._all_rows(stem, axes)[self._rows]

    def rotations(self, stem: str) -> Rotation:
        """Return the N rotations in the columns `stem_w`, ..., `stem_z`."""
        quat_wxyz = self._all_rows(stem, "wxyz")
        first = self._table.line_numbers[0]
        return rotations(self._table.path, stem, quat_wxyz, first_row=first, rows=self._rows)

    def seconds(self, name: str, unit_ns: int = 1) -> FloatArray:
        """Return a column of times (N,) as seconds since the first."""
        place = self._columns[self._places[name]]
        stamps = self._table.stamps_ns(place, unit_ns, self._rows)
        return seconds(stamps, stamps[0])

    def magnetometer(self, time: FloatArray) -> Magnetometer | None:
        """Return the magnetic field at the rows' times (N,), None if there is none."""
        return magnetometer(time, self.stack(self._magnetic)) if self._magnetic else None

    def _all_rows(self, stem: str, axes: str) -> FloatArray:
        return self._table.values[:, [self._places[name] for name in axes_of(stem, axes)]]


def axes_of(stem: str, axes: str = "xyz") -> list[str]:
    """Return the names `stem_x`, `stem_y`, ..."""
    return [f"{stem}_{axis}" for axis in axes]


class JsonFields:
    """The object in a JSON file.

    Raises:
        ReadError: the file does not exist or holds no JSON object.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.fields = path, read_json(path)
        if not isinstance(self.fields, dict):
            raise ReadError(path, "file", type(self.fields).__name__, "a JSON object")

    def get(self, name: str, default: Any = None) -> Any:
        """Return the value at a dotted name, `Gyroscope.Bias.Offset`, or the default."""
        value: Any = self.fields
        for part in name.split("."):
            if not isinstance(value, dict) or part not in value:
                return default
            value = value[part]
        return value

    def array(self, name: str, *shape: int) -> FloatArray:
        """Return the finite numbers of a field; a single number if no shape is given.

        Raises:
            ReadError: the field is missing or holds anything else.
        """
        return self.as_array(name, self.get(name), *shape)

    def as_array(self, name: str, value: Any, *shape: int) -> FloatArray:
        """Convert a field's value to finite numbers of a shape; errors as for `array`."""
        expected = f"{' x '.join(map(str, shape)) or 'a'} finite number{'s' if shape else ''}"
        if value is None:
            raise ReadError(self.path, name, "no such field", expected)
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.full(1, np.nan)
        if array.shape != shape or not np.isfinite(array).all():
            raise ReadError(self.path, name, repr(value)[:60], expected)
        return array
