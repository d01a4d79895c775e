"""Android logger folders: accelerometer and gyroscope in files of their own, at their own clocks.

Written by many apps, each in its way, so what a file holds is told by its content. Its name has
`acc` or `gyr` in it; the rest of the name is the same for both sensors of a recording, unless there
is one file of each. With a header, columns are found by their names (`time`, `timestamp`,
`seconds_elapsed`, and names that end in x, y, z, in any order) and units by what stands in brackets
behind them; without one a row is time and three values, or three values and time. Time without a
unit is in the one that makes 10 to 1200 samples a second of it. Values without a unit are rad/s and
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
    head_lines,
    numbers_in,
    read_table,
    seconds,
)
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.units import ACCEL_UNITS, GYRO_UNITS, unit_named

_log = logging.getLogger(__name__)

_SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".dat")
_LOOKED_AT = 20
_SENSORS = ("acc", "gyr", "grav")
_OTHER = ("lin", "user", "meta", "bias")
"""Parts of names of files that hold something else than the raw sensor."""

_SENSOR_WORD = re.compile(
    r"acc(el(erometers?|eration|ero)?|e)?|gyr(o(scopes?|meters?)?)?|grav(ity)?"
    r"|total|uncal(ib(rated)?)?"
)
_BESIDES = re.compile(r"[\W_]+")

_GRAVITY_REMOVED = 5.0
"""A median force below this [m/s^2] has lost gravity."""

_TIME = re.compile(r"(t|times?|time ?stamps?|seconds|seconds_elapsed|elapsed)([ _-].*)?$")
_AXIS = re.compile(r"(.*[^a-z]|a|g|w|acc[a-z]*|gyr[a-z]*)?[xyz]$")
_UNIT = re.compile(r"[\[(]([^\])]*)[\])]")


def read_android(path: Path) -> ImuSequence:
    """Read a logger's folder.

    Raises:
        ReadError: a file is missing or malformed, the folder holds more than one recording, or the
            two sensors have no stretch in common.
    """
    if not path.is_dir():
        raise ReadError(path, "path", "a file", "a logger's folder")
    accel_file, gyro_file, gravity_file = _files(path)
    gyro_ns, gyro = _samples(gyro_file, GYRO_UNITS)
    accel_ns, accel = _samples(accel_file, ACCEL_UNITS)
    if gravity_file and float(np.median(np.linalg.norm(accel, axis=1))) < _GRAVITY_REMOVED:
        _log.info("%s: gravity added from %s", accel_file, gravity_file.name)
        gravity = _samples(gravity_file, ACCEL_UNITS)
        accel_ns, accel, gravity_B = on_one_clock(path, accel_ns, accel, *gravity)
        accel = accel + gravity_B
    stamps, gyro, accel = on_one_clock(path, gyro_ns, gyro, accel_ns, accel)
    factors = {"gyro": _factor(gyro_file, GYRO_UNITS), "accel": _factor(accel_file, ACCEL_UNITS)}
    return ImuSequence(
        name=path.resolve().name,
        time=seconds(stamps, stamps[0]),
        gyro=gyro,
        accel=accel,
        converted=frozenset(sensor for sensor, factor in factors.items() if factor != 1.0),
    )


def is_android(path: Path) -> bool:
    """Whether a folder holds a file for each of both sensors, with rows that can be told."""
    if not path.is_dir():
        return False
    files = [_sensor_files(path, sensor).values() for sensor in ("acc", "gyr")]
    return all(any(_layout(file) is not None for file in named) for named in files)


def _files(folder: Path) -> tuple[Path, Path, Path | None]:
    """Files of accelerometer, gyroscope and perhaps gravity of the folder's one recording."""
    accel, gyro, gravity = (_sensor_files(folder, sensor) for sensor in _SENSORS)
    for name, named in (("accelerometer", accel), ("gyroscope", gyro)):
        if not named:
            found = ", ".join(sorted(p.name for p in folder.glob("*"))[:6]) or "nothing"
            raise ReadError(folder, name, found, "a file with `acc` and one with `gyr` in its name")
    if len(accel) == len(gyro) == 1:
        one = next(iter(accel.values())), next(iter(gyro.values()))
        return *one, next(iter(gravity.values()), None)
    pairs = sorted(accel.keys() & gyro.keys())
    if len(pairs) != 1:
        names = sorted(file.name for file in (*accel.values(), *gyro.values()))
        found = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        raise ReadError(
            folder, "files", found, "an accelerometer's and a gyroscope's of one name",
            "put each recording into a folder of its own",
        )  # fmt: skip
    return accel[pairs[0]], gyro[pairs[0]], gravity.get(pairs[0])


def _sensor_files(folder: Path, sensor: str) -> dict[str, Path]:
    """A sensor's file of each recording, by what its name says besides the sensor.

    One of the total force comes before others, uncalibrated ones last. A file named after both
    sensors holds both, and is no logger's.
    """
    named: dict[str, Path] = {}
    for file in sorted(folder.iterdir(), key=_rank):
        name = file.name.lower()
        sensors = [part for part in _SENSORS if part in name]
        other = any(part in name for part in _OTHER) or file.suffix.lower() not in _SUFFIXES
        if sensors == [sensor] and not other:
            named.setdefault(_recording(file), file)
    return named


def _rank(file: Path) -> tuple[bool, bool, Path]:
    name = file.name.lower()
    return "total" not in name, "uncal" in name, file


def _recording(file: Path) -> str:
    """What a file's name says besides its sensor."""
    return " ".join(_BESIDES.split(_SENSOR_WORD.sub(" ", file.stem.lower()))).strip()


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
    lines = [(k, line) for k, line in enumerate(head_lines(file)) if line.strip()][:_LOOKED_AT]
    if len(lines) < 2:
        return None
    delimiter = next((mark for mark in (",", ";", "\t") if mark in lines[-1][1]), None)
    rows = [numbers_in(line, delimiter) for _, line in lines[:-1]]  # the last may be cut
    first = next((k for k, row in enumerate(rows) if len(row) >= 4), None)
    if first is None:
        return None
    skip = lines[first][0]
    layout = _layout_of_header(lines[first - 1][1], delimiter, skip) if first else None
    return layout or _layout_of_rows([row for row in rows[first:] if row], delimiter, skip)


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
    layout = _told_layout(file)
    used = [layout.time, *layout.values]
    table = read_table(file, max(used) + 1, layout.skip, layout.delimiter, used)
    values = checked(file, "values", table.values[:, 1:], table.first_row)
    per_second = time_unit(file, table.values[:, 0], unit_named(layout.time_unit))
    return table.stamps_ns(layout.time, per_second), values * _factor(file, known_units)


def _factor(file: Path, known_units: dict[str, float]) -> float:
    """What brings a file's values to rad/s or m/s^2, by the unit in its header."""
    named = _told_layout(file).value_unit
    unit = unit_named(named) or next(iter(known_units))
    if unit not in known_units:
        raise ReadError(file, "header", f"unit {named!r}", ", ".join(known_units))
    return known_units[unit]


def _told_layout(file: Path) -> _Layout:
    layout = _layout(file)
    if layout is None:
        expected = "rows of time and x, y, z with or without a header that says so"
        raise ReadError(file, "header", repr((first_lines(file, 1) or [""])[0][:60]), expected)
    return layout
