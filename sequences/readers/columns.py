"""Header of a generic CSV: the quantity and unit of each column."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import DEGREES, OPTIONAL, UNITS
from stario.sequences.readers.phones.sensor_words import (
    axis_of,
    is_time,
    is_uncalibrated,
    quaternion_of,
    sensor_of,
    time_unit_of,
    unit_of,
)
from stario.sequences.readers.text import Column, first_lines
from stario.sequences.units import (
    ACCEL_UNITS,
    GYRO_UNITS,
    MAGNETIC_UNITS,
    PRESSURE_UNITS,
    TIME_UNITS,
    unit_named,
)

HEADER = "t [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
"""The required columns of a header, as they are written."""

TRUTH_HEADER = "px [m],py [m],pz [m],qx,qy,qz,qw"
"""Optional ground truth: poses, or positions without attitude (px and py at least)."""

SIGMA_HEADER = "sp [m]"
"""Optional standard deviation per axis of positions without attitude."""

MAGNETIC_HEADER = "mx [uT],my [uT],mz [uT]"
"""Optional magnetometer columns."""

PRESSURE_HEADER = "p [hPa]"
"""Optional pressure of the air."""

_log = logging.getLogger(__name__)

IMU = ("gx", "gy", "gz", "ax", "ay", "az")
POSITION, QUAT = ("px", "py", "pz"), ("qx", "qy", "qz", "qw")
TRUTH = POSITION + QUAT
SIGMA = "sp"
MAGNETIC = ("mx", "my", "mz")
PRESSURE = "p"

RARE_UNITS: dict[str, Mapping[str, float]] = {
    PRESSURE: PRESSURE_UNITS | {"": math.nan},
    **dict.fromkeys(("lat", "lon"), DEGREES),
    **{name: UNITS[attribute] for name, attribute in OPTIONAL.items()},
}
"""Factors of the units of what some rows hold; a column in another unit is not read. The unit of a
pressure without one is told from its size."""

SATELLITE_HEADER = {
    name: f"{name} [{next(iter(units))}]" for name, units in RARE_UNITS.items() if name != PRESSURE
}
"""Optional columns of a satellite receiver by canonical name; all but the first two may lack."""

RARE = tuple(RARE_UNITS)
QUANTITIES = (*IMU, *MAGNETIC, *TRUTH, SIGMA, *RARE)

_STEMS = {
    "g": ("gyro", "gyr", "gyroscope", "w", "omega", "angular_velocity", "w_rs_s"),
    "a": ("acc", "acce", "accel", "accelerometer", "a_rs_s"),
    "m": ("mag", "magn", "magnet", "magnetometer", "magnetic_field"),
    "p": ("pos", "position"),
    "q": ("quat", "quaternion", "ori", "orientation"),
}
_ALIASES = (
    dict.fromkeys(("t", "time", "times", "timestamp", "datetime"), "t")
    | {name: name for name in (SIGMA, *RARE)}
    | {"pressure": "p", "latitude": "lat", "longitude": "lon", "altitude": "alt"}
    | {
        stem + joint + axis: letter + axis
        for letter, stems in _STEMS.items()
        for stem in (letter, *stems)
        for joint in ("", "_")
        for axis in ("xyzw" if letter == "q" else "xyz")
    }
)
_LIKE_TRUTH = re.compile(
    r"gt|truth|pos|quat|(ori|orientation)_?[wxyz]$|[ptq]?_?[xyz]$|q_?[w0-3]$", flags=re.IGNORECASE
)
_UNITS = {*ACCEL_UNITS, *GYRO_UNITS, *MAGNETIC_UNITS, *TIME_UNITS}
_QUOTES = " \"'"

_HEAD_LINES = 200
"""Number of lines within which the header must be for a file to be recognised, and of the rows that
show which of several clocks is the finest."""

_FEWEST_UNITS = 3
"""Number of cells that make a row of units: those of one sensor."""

_CELL = re.compile(r"\s*[\"']?\s*(?P<name>[^\[\(\"']*?)\s*(?:[\[\(](?P<unit>[^\]\)]*)[\]\)])?\W*$")


@dataclass(frozen=True)
class Header:
    """Lines up to the header's end, cell separator, titles, columns by canonical name."""

    lines: int
    separator: str
    titles: list[str]
    columns: dict[str, Column]


def read_header(path: Path, lines: list[str]) -> Header:
    """Return the header found in a file's lines."""
    index = _header_index(lines)
    if index is None:
        raise ReadError(path, "header", "only comments", HEADER)
    line, number = lines[index], index + 1
    if not _names_columns(line):
        found = f"{line.strip()[:60]!r}, which names no axis of a sensor"
        fix = "write titles above the rows; if it is in another format, omit `--format csv`"
        raise ReadError(path, f"line {number}", found, f"titles, {HEADER}", fix)
    titles, below = _titles(line), lines[number] if number < len(lines) else ""
    with_units = with_units_below(titles, below.split(_separator(line)))
    start = number + (with_units is not None)
    rows = [row.split(_separator(line)) for row in lines[start : start + _HEAD_LINES]]
    columns = _columns(path, number, with_units or titles, rows)
    return Header(start, _separator(line), titles, columns)


def _header_index(lines: list[str]) -> int | None:
    """Return the index of the first line that is no comment, or is a comment that names columns."""
    for index, line in enumerate(lines):
        if line.strip().lower().startswith("sep="):  # for spreadsheets
            continue
        if line.strip() and (not line.lstrip().startswith("#") or _names_columns(line)):
            return index
    return None


def named_columns(path: Path) -> set[str]:
    """Return the canonical names of the columns that a file's header names, empty without one."""
    lines = first_lines(path, _HEAD_LINES, comments=True)
    index = _header_index(lines)
    return set() if index is None else {*canonical_names(lines[index])} - {""}


def canonical_names(header: str) -> list[str]:
    """Return the canonical name of each column that a header names, empty for unknown ones."""
    return _names(_titles(header))


def with_units_below(titles: list[str], below: list[str]) -> list[str] | None:
    """Return a header's titles with the units in the line below it, None if it holds none."""
    units = [re.sub(r"[\s\"'\[\]()]", "", cell) for cell in below]
    if sum(unit_named(unit) in _UNITS for unit in units) < _FEWEST_UNITS:
        return None
    units += [""] * (len(titles) - len(units))
    pairs = zip(titles, units, strict=False)
    return [f"{title.strip(_QUOTES)} [{unit}]" if unit else title for title, unit in pairs]


def _columns(
    path: Path, number: int, titles: list[str], rows: list[list[str]]
) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    ignored, names = [], _names(titles)
    clocks = [k for k, name in enumerate(names) if name == "t"]  # `t` and `timestamp`
    values = {k: {cell for row in rows for cell in row[k : k + 1]} for k in clocks}
    coarse = sorted(clocks, key=lambda k: -len(values[k]))[1:]  # these repeat more
    for index, (text, name) in enumerate(zip(titles, names, strict=True)):
        title, unit = _cell(text)
        unit = unit_named(unit) or (time_unit_of(title) if name == "t" else unit_of(title))
        if not name or (name in RARE and name in columns) or index in coarse:
            ignored.append(title)
        elif name in RARE and unit not in RARE_UNITS[name]:
            known = ", ".join(filter(None, RARE_UNITS[name]))
            _log.warning("%s: %s is not read: found unit %r, expected %s", path, title, unit, known)
        elif name in columns:
            found = f"both {title} and {columns[name].title}"
            fix = "rename or remove the other"
            raise ReadError(path, f"line {number}, {name}", found, "one column", fix)
        else:
            columns[name] = Column(index, title, unit)
    placed, posed = (bool(set(names) & set(columns)) for names in (POSITION, QUAT))
    useless = [] if {"lat", "lon"} <= set(columns) else [*SATELLITE_HEADER]
    useless += [] if placed else QUAT  # attitude alone is not a track
    useless += [] if placed and not posed else [SIGMA]
    ignored += [columns.pop(name).title for name in useless if name in columns]
    truth = [name for name in TRUTH if name in columns]
    needed = ["t", *IMU, *((TRUTH if posed else POSITION[:2]) if placed else ())]
    needed += MAGNETIC if set(MAGNETIC) & set(columns) else ()
    missing = [name for name in needed if name not in columns]
    if missing:
        fix = "or remove the truth columns" if truth and not set(missing) & {"t", *IMU} else ""
        if missing == ["t"]:
            fix = "or pass the samples per second: `--rate 100`"
        expected = f"{HEADER},{TRUTH_HEADER}" if truth else HEADER
        expected += f",{MAGNETIC_HEADER}" if set(MAGNETIC) & set(missing) else ""
        raise ReadError(path, f"line {number}, header", f"no {', '.join(missing)}", expected, fix)
    if ignored:
        _log_ignored(path, ignored, bool(truth))
    for name in (*truth, *([SIGMA] if SIGMA in columns else [])):
        unit_factor(path, columns[name], {"": 1.0} if name in QUAT else {"m": 1.0, "": 1.0})
    return columns


def _log_ignored(path: Path, ignored: list[str], has_truth: bool) -> None:
    _log.info("%s: columns ignored: %s", path, ", ".join(ignored))
    others = [title for title in ignored if _spelled(title) in IMU]
    if others:
        _log.warning("%s: columns of another IMU are not read: %s", path, ", ".join(others))
    truth_like = ", ".join(title for title in ignored if _LIKE_TRUTH.match(title))
    if truth_like and not has_truth:
        message = "%s: no ground truth is read from %s: it must have %s"
        _log.warning(message, path, truth_like, TRUTH_HEADER)


def unit_factor(path: Path, column: Column, known: Mapping[str, float]) -> float:
    """Return the factor of a column's unit; the first of `known` if the header names none."""
    unit = column.unit or next(iter(known))
    if unit not in known:
        names = ", ".join(filter(None, known)) or "no unit"
        raise ReadError(path, f"header, {column.title}", f"unit {column.unit!r}", names)
    return known[unit]


def unit_of_axes(
    path: Path, axes: Sequence[Column], known: Mapping[str, float]
) -> tuple[str, float]:
    """Return the unit that any of a sensor's axes names, which holds for all, and its factor."""
    named = [column for column in axes if column.unit] or axes[:1]
    if len({unit_factor(path, column, known) for column in named}) > 1:
        found = ", ".join(f"{column.title} in {column.unit}" for column in named)
        raise ReadError(path, "header", found, "one unit for all axes of a sensor")
    return named[0].unit, unit_factor(path, named[0], known)


def _names_columns(line: str) -> bool:
    """Return whether a line names any IMU column of this format."""
    return bool(set(canonical_names(line)) & set(IMU))


def _names(titles: list[str]) -> list[str]:
    """Return the canonical name of each title, empty for one of no interest."""
    plain = [_cell(text)[0] for text in titles]
    clocks = [k for k, title in enumerate(plain) if is_time(title)]
    if len(clocks) > 1:  # `T` next to a clock is a temperature, as in ArduPilot's
        plain = ["" if title == "T" else title for title in plain]
        clocks = [k for k in clocks if plain[k]]
    names = [_name(title.lower()) for title in plain]
    if clocks and "t" not in names:  # `time_ms`, `seconds_elapsed`
        names[clocks[0]] = "t"
    if set(POSITION[:2]) <= set(names):  # truth, however the other titles are spelled
        for k, title in enumerate(plain):
            if not names[k] and (spelled := _spelled(title)) not in names:
                names[k] = spelled
    return names


def _name(title: str) -> str:
    """Return the canonical name of a title; positions and magnetometers may be spelled freely.

    With freely spelled gyroscopes and accelerometers a file is a logger's, unless it has truth.
    """
    loose = _ALIASES.get(re.sub(r"[ .]", "_", re.sub(r"^imu\(\d+\):", "", title)), "")
    return _ALIASES.get(title) or (loose if loose in (*MAGNETIC, *POSITION) else "")


def _spelled(title: str) -> str:
    """Return the canonical name that the words of a title tell, `gx` for `Gyroscope X`."""
    if part := quaternion_of(title):
        return f"q{part}"
    axis, words = axis_of(title) or ("", ())
    letter = {"gyro": "g", "accel": "a"}.get(sensor_of(words) or "", "")
    return letter + axis if letter and not is_uncalibrated(words) else ""


def _titles(line: str) -> list[str]:
    return line.lstrip(" #").split(_separator(line))


def _separator(header: str) -> str:
    return max(",;\t", key=header.count)


def _cell(text: str) -> tuple[str, str]:
    """Return the name and unit of a header's cell, `gx [deg/s]` or `gx (deg/s)`."""
    match = _CELL.match(text)
    return (match["name"], match["unit"] or "") if match else (text.strip(), "")
