"""Arrays by name, as data sets store them: columns of a CSV, of HDF5 or npy, fields of JSON."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import finite_rows, rotations
from stario.sequences.readers.text import (
    Column,
    RowFormat,
    first_line,
    read_json,
    read_lines,
    read_table,
    seconds,
)
from stario.sequences.sequence import FloatArray

MAGNETIC = "magnetic"


class Fields(dict[str, FloatArray]):
    """Arrays (N,) or (N, K) of a file by name, without rows with a value that is not finite.

    Those that are optional may be missing, or hold NaN; errors count rows from `first_row`.
    """

    def __init__(
        self,
        path: Path,
        arrays: Mapping[str, FloatArray],
        optional: Collection[str] = (),
        first_row: int = 0,
    ) -> None:
        needed = {name: values for name, values in arrays.items() if name not in optional}
        damaged = ", ".join(name for name, one in needed.items() if not np.isfinite(one).all())
        self.rows = finite_rows(path, damaged, np.column_stack(list(needed.values())))
        self._path, self._numbers = path, self.rows + first_row
        super().__init__((name, values[self.rows]) for name, values in arrays.items())

    def rotations(self, name: str, order: str = "wxyz", count: int | None = None) -> Rotation:
        """Return the rotations of unit quaternions (N, 4), or of the first few."""
        return rotations(self._path, name, self[name][:count], order, self._numbers)


def file_in(path: Path, *names: str) -> Path | None:
    """Return the first of some files in a folder, or the path itself if it is one of them."""
    if path.is_dir():
        return next((path / name for name in names if (path / name).is_file()), None)
    return path if path.is_file() and path.name in names else None


def header_names(path: Path) -> list[str]:
    """Return the cells of a file's first line, [""] for a file that is not text; never raises."""
    return [cell.strip().strip('"') for cell in first_line(path).split(",")]


def read_columns(
    path: Path,
    clock: tuple[str, int],
    stems: Mapping[str, str],
    magnetic: Collection[str] = ("magnet",),
) -> tuple[FloatArray, Fields]:
    """Return the times since the first row [s] and the columns of a CSV with a header.

    The `clock` is the name and the unit [ns] of the times. Columns are named by a stem and axes:
    those of `{"acce": "xyz"}` are `acce_x`, ... The first of the `magnetic` stems that is present
    becomes the optional `MAGNETIC`.
    """
    header = header_names(path)
    if header == [""]:
        read_lines(path)  # raises if the file itself is missing or empty
    names = {stem: [f"{stem}_{axis}" for axis in axes] for stem, axes in stems.items()}
    wanted = [clock[0], *(name for some in names.values() for name in some)]
    if missing := [name for name in wanted if name not in header]:
        raise ReadError(path, "header", f"no {', '.join(missing)}", "columns of these names")
    for some in ([f"{stem}_{axis}" for axis in "xyz"] for stem in magnetic):
        if MAGNETIC not in names and set(some) <= set(header):
            names[MAGNETIC] = some
    used = [clock[0], *(name for some in names.values() for name in some)]
    places = [Column(header.index(name), name) for name in used]
    table = read_table(path, places, RowFormat(skip=1))
    columns = dict(zip(used, table.values.T, strict=True))
    arrays = {stem: np.column_stack([columns[n] for n in some]) for stem, some in names.items()}
    arrays[clock[0]] = columns[clock[0]]
    fields = Fields(path, arrays, [MAGNETIC], table.line_numbers[0])
    stamps = table.stamps_ns(clock[1], fields.rows)
    return seconds(stamps, stamps[0]), fields


class JsonFields:
    """The object in a JSON file."""

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

    def array(self, name: str, *shape: int, value: Any = None) -> FloatArray:
        """Return the finite numbers of a field, or of a value; a single one without a shape."""
        expected = f"{' x '.join(map(str, shape)) or 'a'} finite number{'s' if shape else ''}"
        value = self.get(name) if value is None else value
        if value is None:
            raise ReadError(self.path, name, "no such field", expected)
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.full(1, np.nan)
        if array.shape != shape or not np.isfinite(array).all():
            raise ReadError(self.path, name, repr(value)[:60], expected)
        return array

    def rotation(self, name: str, value: Any = None) -> Rotation:
        """Return the rotation of a unit quaternion w, x, y, z; errors as for `array`."""
        return rotations(self.path, name, self.array(name, 4, value=value)[None])[0]
