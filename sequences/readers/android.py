"""Android logger folders: accelerometer and gyroscope in files of their own, at their own clocks.

Written by many apps, each in its way, so what a file holds is told by its content. Its name has
`acc` or `gyr` in it. With a header, columns are found by their names (`time`, `timestamp`,
`seconds_elapsed`, and names that end in x, y, z, in any order) and units by what stands in brackets
behind them; without one a row is time and three values, or three values and time. Time without a
unit is in the one that makes 10 to 1000 samples a second of it. Values without a unit are rad/s and
m/s^2, with gravity.

Both sensors are brought onto the gyroscope's times of their common stretch. Where an app removes
gravity from the accelerometer's file but writes it to one of its own (`Gravity.csv`), it is added.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import checked
from stario.sequences.readers.clocks import on_one_clock, time_unit
from stario.sequences.readers.text import (
    IntArray,
    first_lines,
    numbers_in,
    read_table,
    seconds,
)
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.units import ACCEL_UNITS, GYRO_UNITS, unit_named

_log = logging.getLogger(__name__)

_SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".dat")
_SENSORS = ("acc", "gyr", "grav")
_OTHER = ("lin", "user", "meta", "bias")
"""Parts of names of files that hold something else than the raw sensor."""

_GRAVITY_REMOVED = 5.0
"""A median force below this [m/s^2] has lost gravity."""

_TIME = re.compile(r"(t|times?|time ?stamps?|seconds|seconds_elapsed|elapsed)([ _-].*)?$")
_AXIS = re.compile(r"(.*[^a-z]|a|g|w|acc[a-z]*|gyr[a-z]*)?[xyz]$")
_UNIT = re.compile(r"[\[(]([^\])]*)[\])]")


def read_android(path: Path) -> ImuSequence:
    """Read a logger's folder.

    Raises:
        ReadError: a file is missing or malformed, or the two have no stretch in common.
    """
    if not path.is_dir():
        raise ReadError(path, "path", "a file", "a logger's folder")
    accel_file, gyro_file = _sensor_file(path, "acc"), _sensor_file(path, "gyr")
    for name, file in (("accelerometer", accel_file), ("gyroscope", gyro_file)):
        if file is None:
            found = ", ".join(sorted(p.name for p in path.glob("*"))[:6]) or "nothing"
            raise ReadError(path, name, found, "a file with `acc` and one with `gyr` in its name")
    assert accel_file is not None
    assert gyro_file is not None
    gyro_ns, gyro = _samples(gyro_file, GYRO_UNITS)
    accel_ns, accel = _samples(accel_file, ACCEL_UNITS)
    gravity_file = _sensor_file(path, "grav")
    if gravity_file and float(np.median(np.linalg.norm(accel, axis=1))) < _GRAVITY_REMOVED:
        _log.info("%s: gravity added from %s", accel_file, gravity_file.name)
        gravity = _samples(gravity_file, ACCEL_UNITS)
        accel_ns, accel, gravity_B = on_one_clock(path, accel_ns, accel, *gravity)
        accel = accel + gravity_B
    stamps, gyro, accel = on_one_clock(path, gyro_ns, gyro, accel_ns, accel)
    return ImuSequence(
        name=path.resolve().name, time=seconds(stamps, stamps[0]), gyro=gyro, accel=accel
    )


def is_android(path: Path) -> bool:
    """Whether a folder holds a file for each of both sensors, with rows that can be told."""
    if not path.is_dir():
        return False
    files = [_sensor_file(path, sensor) for sensor in ("acc", "gyr")]
    return all(file is not None and _layout(file) is not None for file in files)


def _sensor_file(folder: Path, sensor: str) -> Path | None:
    """The sensor's file: one of the total force before others, uncalibrated ones last.

    A file named after both sensors holds both, and is no logger's.
    """
    named = []
    for file in sorted(folder.iterdir()):
        name = file.name.lower()
        sensors = [part for part in _SENSORS if part in name]
        other = any(part in name for part in _OTHER) or file.suffix.lower() not in _SUFFIXES
        if sensors == [sensor] and not other:
            named.append(file)
    return min(
        named,
        key=lambda file: ("total" not in file.name.lower(), "uncal" in file.name.lower()),
        default=None,
    )


@dataclass(frozen=True)
class _Layout:
    """Where time and the three values stand in a row, with the words for their units."""

    time: int
    values: tuple[int, ...]
    delimiter: str | None
    skip: int
    time_unit: str = ""
    value_unit: str = ""


def _layout(file: Path) -> _Layout | None:
    """How a file's rows are to be read, or None if that cannot be told."""
    lines = first_lines(file, 20, comments=True)
    if len(lines) < 2:
        return None
    delimiter = next((mark for mark in (",", ";", "\t") if mark in lines[-1]), None)
    rows = [numbers_in(line, delimiter) for line in lines[:-1]]  # the last may be cut by the head
    skip = next((k for k, row in enumerate(rows) if len(row) >= 4), None)
    if skip is None:
        return None
    layout = _layout_of_header(lines[skip - 1], delimiter, skip) if skip else None
    return layout or _layout_of_rows([row for row in rows[skip:] if row], delimiter, skip)


def _layout_of_header(header: str, delimiter: str | None, skip: int) -> _Layout | None:
    cells = [cell.strip(" #\"'") for cell in header.split(delimiter)]
    names = [_UNIT.sub("", cell).strip().lower() for cell in cells]
    units = [match[1] if (match := _UNIT.search(cell)) else "" for cell in cells]
    time = next((k for k, name in enumerate(names) if _TIME.match(name)), None)
    axes = {name[-1]: k for k, name in reversed(list(enumerate(names))) if _AXIS.match(name)}
    if time is None or set(axes) != set("xyz"):
        return None
    values = tuple(axes[axis] for axis in "xyz")
    return _Layout(time, values, delimiter, skip, units[time], units[values[0]])


def _layout_of_rows(rows: list[list[float]], delimiter: str | None, skip: int) -> _Layout | None:
    """Time is the first or the fourth column, whichever grows."""
    table = np.array([row[:4] for row in rows if len(row) >= 4])
    for time, values in ((0, (1, 2, 3)), (3, (0, 1, 2))):
        if (np.diff(table[:, time]) >= 0).all() and table[-1, time] > table[0, time]:
            return _Layout(time, values, delimiter, skip)
    return None


def _samples(file: Path, known_units: dict[str, float]) -> tuple[IntArray, FloatArray]:
    """Time stamps (N,) [ns] and values (N, 3) in rad/s or m/s^2."""
    layout = _layout(file)
    if layout is None:
        expected = "rows of time and x, y, z with or without a header that says so"
        raise ReadError(file, "header", repr((first_lines(file, 1) or [""])[0][:60]), expected)
    used = [layout.time, *layout.values]
    table = read_table(file, max(used) + 1, layout.skip, layout.delimiter, used)
    values = checked(file, "values", table.values[:, 1:], table.first_row)
    unit = unit_named(layout.value_unit) or next(iter(known_units))
    if unit not in known_units:
        raise ReadError(file, "header", f"unit {layout.value_unit!r}", ", ".join(known_units))
    per_second = time_unit(file, table.values[:, 0], unit_named(layout.time_unit))
    return table.stamps_ns(layout.time, per_second), values * known_units[unit]
