"""One table for all sensors, with a column that names the sensor of each row.

    time,sensor,x,y,z
    0.000,gyroscope,0.01,-0.02,0.03
    0.002,accelerometer,0.1,0.2,9.8

The rows are sorted into a file for each sensor, to be read as the folder of a phone's logger.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stario.sequences.arrays import number_in
from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import head_lines, is_row, read_lines, unquoted
from stario.sequences.readers.phones.files import SUFFIXES
from stario.sequences.readers.phones.sensor_words import sensor_of, words_of

_MIN_CELLS = 5
"""Number of cells of a row: the sensor, a time and three values."""

_HEAD_ROWS = 50
_MIN_SHARE = 0.5
"""Share of the first rows that must name a known sensor; others are of other sensors."""


@dataclass(frozen=True)
class _Layout:
    """Separator of the cells, index of the column of sensors, and whether there are titles."""

    delimiter: str
    column: int
    has_titles: bool


def is_long_form(path: Path) -> bool:
    """Return whether a file's rows name their sensors; never raises."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    return _layout(head_lines(path)[:-1]) is not None


@contextmanager
def unpack_long_form(path: Path) -> Iterator[Path]:
    """Write a file for each sensor into a temporary folder, which is deleted after the block.

    Raises:
        ReadError: the file cannot be read or has another form.
    """
    lines = [line for line in read_lines(path) if is_row(line)]
    layout = _layout(lines[:_HEAD_ROWS])
    if layout is None:
        raise ReadError(path, "rows", "none that name a sensor", "a column of sensors' names")
    rows = [unquoted(line, layout.delimiter).split(layout.delimiter) for line in lines]
    titles = [rows.pop(0)] if layout.has_titles else []
    sensors: dict[str, list[list[str]]] = {}
    for row in rows:
        sensors.setdefault("".join(row[layout.column : layout.column + 1]).strip(), []).append(row)
    with tempfile.TemporaryDirectory(prefix="stario-") as folder:
        for name, own in sensors.items():
            kept = ([cell for k, cell in enumerate(row) if k != layout.column]
                    for row in [*titles, *own])  # fmt: skip
            text = "".join(layout.delimiter.join(row) + "\n" for row in kept)
            stem = re.sub(r"\W+", "_", name) or "unnamed"
            (Path(folder) / f"{stem}.csv").write_text(text, encoding="utf-8")
        yield Path(folder)


def _layout(lines: list[str]) -> _Layout | None:
    """Return how the first lines are written, None if they are not of this form."""
    lines = [line for line in lines if is_row(line)][:_HEAD_ROWS]
    if len(lines) < 3:
        return None
    delimiter = max(",;\t", key=lines[1].count)
    rows = [[cell.strip() for cell in unquoted(x, delimiter).split(delimiter)] for x in lines]
    width = len(rows[1])
    rows = [row for row in rows if len(row) == width]
    if width < _MIN_CELLS or len(rows) < 3:
        return None
    has_titles = sum(math.isfinite(number_in(cell)) for cell in rows[0]) < 3
    for column, cells in enumerate(zip(*rows[has_titles:], strict=True)):
        if sum(map(_names_sensor, cells)) >= _MIN_SHARE * len(cells):
            return _Layout(delimiter, column, has_titles)
    return None


def _names_sensor(cell: str) -> bool:
    """Return whether a cell names a sensor by more than a letter or two: not `n/a`."""
    return sensor_of(word for word in words_of(cell) if len(word) > 2) is not None
