"""A text file of sensor samples: where its clock and its sensors' axes stand, in which units.

With a header, columns are found by their names (`stario.sequences.readers.sensor_words`), in any
order, among any others; without one a row is time and three values, or three values and time, a
second clock between them is left out. Cells stand between commas, semicolons, tabs or blanks; with
the latter three numbers may be written with a decimal comma.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import checked
from stario.sequences.readers.clocks import time_unit
from stario.sequences.readers.sensor_words import (
    axis_of,
    is_time,
    is_uncalibrated,
    quaternion_of,
    sensor_of,
    time_unit_of,
    unit_of,
)
from stario.sequences.readers.text import IntArray, Table, head_lines, read_table
from stario.sequences.sequence import FloatArray
from stario.sequences.units import ACCEL_UNITS, GYRO_UNITS, MAGNETIC_UNITS

_LOOKED_AT = 24
_CLOCK_FROM = 1e6
"""A second column that grows and is larger than this is another clock."""

UNITS = {
    "accel": ACCEL_UNITS,
    "linear": ACCEL_UNITS,
    "gravity": ACCEL_UNITS,
    "gyro": GYRO_UNITS,
    "mag": MAGNETIC_UNITS,
}
_LIMITS = {"accel": 2e3, "linear": 2e3, "gravity": 2e3, "gyro": 1e4, "mag": 1e5}
"""No sensor gives more, in m/s^2, deg/s and uT."""


@dataclass(frozen=True)
class Place:
    """A column: where it stands, what its header says, and the unit named there."""

    index: int
    title: str = ""
    unit: str = ""


@dataclass(frozen=True)
class SensorTable:
    """How a file's rows are to be read.

    Attributes:
        file: the file.
        clock: the column with the sensor's time.
        axes: x, y and z of each sensor; under "" those of a file that names none.
        quaternion: x, y, z and w of an attitude, where the header names one.
        biases: columns of what an uncalibrated sensor's values are too large by, if any.
        delimiter: between cells; None for blanks.
        decimal: point or comma.
        skip: lines before the first row.
    """

    file: Path
    clock: Place
    axes: dict[str, tuple[Place, Place, Place]]
    quaternion: tuple[Place, ...] = ()
    biases: tuple[Place, ...] = ()
    delimiter: str | None = ","
    decimal: str = "."
    skip: int = 0


@dataclass(frozen=True)
class Samples:
    """A sensor's samples: time stamps (N,) [ns], values (N, 3), the unit that was named or none."""

    stamps_ns: IntArray
    values: FloatArray
    unit: str = ""


def sensor_table(file: Path) -> SensorTable | None:
    """How a file's rows are to be read, or None if that cannot be told; never raises."""
    numbered = [(k, line) for k, line in enumerate(head_lines(file)) if line.strip()]
    numbered = numbered[: 4 * _LOOKED_AT]
    if len(numbered) < 2:
        return None
    found = first_row(numbered[:-1])  # the last line may be cut
    if found is None:
        return None
    first, delimiter, decimal = found
    skip = numbered[first][0]
    rows = [_cells(line, delimiter, decimal) for _, line in numbered[first:-1]][:_LOOKED_AT]
    width = max(set(map(len, rows)), key=list(map(len, rows)).count)
    rows = [row for row in rows if len(row) == width]
    if len(rows) < 2:
        return None
    head = np.array([[_number(cell) for cell in row] for row in rows])
    layout = None
    if first:
        titles = [c.strip(" #\"'\ufeff") for c in numbered[first - 1][1].split(delimiter)]
        if len(titles) == width or delimiter is not None:
            layout = _by_header(titles[:width], head)
    layout = layout or _by_rows(head)
    if layout is None:
        return None
    clock, axes, quaternion, biases = layout
    return SensorTable(file, clock, axes, quaternion, biases, delimiter, decimal, skip)


def read_samples(
    table: SensorTable, sensor: str, axes: str = "", per_second: int | None = None
) -> Samples:
    """A sensor's samples, in rad/s, m/s^2 or uT where the file names a unit.

    Args:
        table: the file's layout.
        sensor: which one, a key of `UNITS`.
        axes: the key of its columns in `table.axes`.
        per_second: how many of the clock's units make a second where its header does not say.

    Raises:
        ReadError: a row is malformed, a unit is unknown, or a value is none that a sensor gives.
    """
    places = table.axes[axes]
    rows = _rows(table, [table.clock, *places, *table.biases])
    kept = np.asarray(np.isfinite(rows.values[:, 1:4]).any(axis=1))  # wide files leave cells empty
    titles = ", ".join(p.title or f"column {p.index + 1}" for p in places)
    values = rows.values[:, 1:4]
    if table.biases:
        values = values - rows.values[:, 4:7]
    unit = next((place.unit for place in places if place.unit), "")
    known = UNITS[sensor]
    if unit and unit not in known:
        raise ReadError(table.file, "header", f"unit {unit!r}", ", ".join(known))
    values = values * (known[unit] if unit else 1.0)
    _check_size(table.file, titles, sensor, values[kept])
    if per_second is None or table.clock.unit:
        per_second = time_unit(table.file, rows.values[kept, 0], table.clock.unit)
    stamps = rows.stamps_ns(table.clock.index, per_second)
    if sensor != "mag":
        checked(table.file, titles, np.where(kept.reshape(-1, 1), values, 0.0), rows.first_row)
    return Samples(stamps[kept], values[kept], unit)


def _rows(table: SensorTable, used: Sequence[Place]) -> Table:
    """The columns asked for; what a killed recorder left of a last row is left out."""
    indices = [place.index for place in used]
    columns = max(indices) + 1
    return read_table(
        table.file, columns, table.skip, table.delimiter, indices, table.decimal, killed=True
    )


def _check_size(file: Path, titles: str, sensor: str, values: FloatArray) -> None:
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if largest > _LIMITS[sensor]:
        unit = next(iter(UNITS[sensor]))
        raise ReadError(
            file, titles, f"{largest:.3g}", f"what a sensor can give, in {unit}",
            "is another column meant, or a clock among them?",
        )  # fmt: skip


def read_quaternion(
    table: SensorTable, per_second: int | None = None
) -> tuple[IntArray, FloatArray]:
    """Time stamps (N,) [ns] and the four numbers of an attitude (N, 4), in the table's order.

    Raises:
        ReadError: a row is malformed.
    """
    rows = _rows(table, [table.clock, *table.quaternion])
    if per_second is None or table.clock.unit:
        per_second = time_unit(table.file, rows.values[:, 0], table.clock.unit)
    return rows.stamps_ns(table.clock.index, per_second), rows.values[:, 1:]


def first_row(
    numbered: list[tuple[int, str]], least: int = 4
) -> tuple[int, str | None, str] | None:
    """Which line is the first row of numbers, what separates its cells, and its decimal mark.

    Args:
        numbered: lines of a file with their numbers, blank ones left out.
        least: numbers that a row must hold.
    """
    for k, (_, line) in enumerate(numbered):
        if line.lstrip().startswith("#"):
            continue
        for delimiter, decimal in ((";", "."), (";", ","), ("\t", "."), ("\t", ","), (",", "."),
                                   (None, "."), (None, ",")):  # fmt: skip
            cells = _cells(line, delimiter, decimal)
            numbers = sum(np.isfinite(_number(cell)) for cell in cells)
            if numbers >= least and 2 * numbers >= sum(bool(cell.strip()) for cell in cells):
                return k, delimiter, decimal
    return None


def _cells(line: str, delimiter: str | None, decimal: str) -> list[str]:
    return (line.replace(",", ".") if decimal == "," else line).split(delimiter)


def _number(cell: str) -> float:
    try:
        return float(cell.strip(" \"'"))
    except ValueError:
        return float("nan")


_Layout = tuple[Place, dict[str, tuple[Place, Place, Place]], tuple[Place, ...], tuple[Place, ...]]


def _by_header(titles: list[str], head: FloatArray) -> _Layout | None:
    clock = _clock(titles, head)
    groups: dict[tuple[str, ...], dict[str, Place]] = {}
    quaternion: dict[str, Place] = {}
    for k, title in enumerate(titles):
        part = quaternion_of(title)
        if part is not None:
            quaternion.setdefault(part, Place(k, title))
            continue
        axis = axis_of(title)
        if axis is not None and not is_time(title):
            place = Place(k, title, unit_of(title))
            groups.setdefault(axis[1], {}).setdefault(axis[0], place)
    axes: dict[str, tuple[Place, Place, Place]] = {}
    for words in sorted(groups, key=_preference):
        sensor = sensor_of(words)
        if set(groups[words]) == set("xyz") and sensor != "attitude":
            x, y, z = (groups[words][axis] for axis in "xyz")
            if "gf" in words and not x.unit:
                x = Place(x.index, x.title, "g")
            axes.setdefault(sensor or "", (x, y, z))
    attitude = tuple(quaternion[part] for part in "xyzw") if len(quaternion) == 4 else ()
    if clock is None or not (axes or attitude):
        return None
    return clock, axes, attitude, ()


def _preference(words: tuple[str, ...]) -> tuple[bool, bool, int]:
    """What is calibrated comes first, then a total force, then what is said in fewer words."""
    return is_uncalibrated(words), not {"gf", "total"} & set(words), len(words)


def _clock(titles: list[str], head: FloatArray) -> Place | None:
    """The finest of the clocks: a sensor's own rather than the app's."""
    places = [
        Place(k, title, time_unit_of(title))
        for k, title in enumerate(titles)
        if is_time(title) and _grows(head[:, k])
    ]
    order = {"ns": 0, "us": 1, "": 2, "s": 3, "ms": 4}

    def rank(place: Place) -> tuple[bool, int]:
        own = "sensor" in place.title.lower()
        large = not place.unit and head[0, place.index] > 1e15
        return not own, 0 if large else order.get(place.unit, 2)

    return min(places, key=rank, default=None)


def _grows(column: FloatArray) -> bool:
    steps = np.diff(column)
    return bool(np.isfinite(column).all() and (steps >= 0).mean() > 0.8 and column[-1] > column[0])


def _by_rows(head: FloatArray) -> _Layout | None:
    """Time is the first or the fourth column, whichever grows."""
    if len(head) < 2:
        return None
    width = head.shape[1]
    for time, start in ((0, 1), (3, 0)):
        if time >= width or not (np.diff(head[:, time]) >= 0).all():
            continue
        if not head[-1, time] > head[0, time]:
            continue
        while start and start < width and _is_clock(head[:, start]):
            start += 1
        if start + 3 > width or not np.isfinite(head[:, start : start + 3]).all():
            continue
        x, y, z = (Place(start + k) for k in range(3))
        quaternion = tuple(Place(1 + k) for k in range(4)) if start == 1 and width >= 5 else ()
        biases: tuple[Place, ...] = ()
        if width == 7 and start == 1 and not np.ptp(head[:, 4:7], axis=0).any():
            biases = tuple(Place(4 + k) for k in range(3))
        return Place(time), {"": (x, y, z)}, quaternion, biases
    return None


def _is_clock(column: FloatArray) -> bool:
    return bool(np.abs(column[0]) > _CLOCK_FROM and (np.diff(column) >= 0).all())
