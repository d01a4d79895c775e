"""Files with one line per event of any sensor: `TYPE_...` traces and GetSensorData.

Indoor Location's traces (tab-separated): time [ms since 1970], `TYPE_GYROSCOPE`,
`TYPE_ACCELEROMETER` or `TYPE_MAGNETIC_FIELD` and xyz, followed by the biases if uncalibrated;
`TYPE_WAYPOINT` and x, y [m] on a floor plan, tapped by a surveyor. Some lines lack the line break
before them. GetSensorData's log files (IPIN's competitions; semicolons, `%` comments): `ACCE`,
`GYRO` or `MAGN`, the app's and the sensor's time [s] and xyz; `PRES`, both times and the pressure
[mbar]; `GNSS`, the app's time and UTC [s], latitude, longitude [deg], altitude [m], bearing [deg],
accuracy [m] and speed [m/s]; `POSI`, the app's time, a count, latitude and longitude [deg] of a
reference point and its floor. Reference points are returned as waypoints, horizontal and in metres.
The device's own attitude is the rotation vector, `TYPE_ROTATION_VECTOR` or the last three values of
`AHRS`: x, y and z of a quaternion whose w is not negative.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import number_in
from stario.sequences.errors import ReadError
from stario.sequences.geodesy import east_north
from stario.sequences.readers.checked import barometer, finite_rows, magnetometer, satellites
from stario.sequences.readers.clocks import resample_to_gyro
from stario.sequences.readers.lines import head_lines, read_lines
from stario.sequences.readers.phones.attitude import agreeing_attitude, device_attitude
from stario.sequences.readers.phones.samples import Samples
from stario.sequences.readers.text import IntArray, seconds
from stario.sequences.sequence import (
    Barometer,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Satellites,
)
from stario.sequences.time_order import increasing_mask

_log = logging.getLogger(__name__)

_TRACE = re.compile(r"\d{10,}\tTYPE_\w+")
_GLUED = re.compile(r"(?<=[^\n])(\d{13}\tTYPE_)")
_TYPES = {"accel": "TYPE_ACCELEROMETER", "gyro": "TYPE_GYROSCOPE", "mag": "TYPE_MAGNETIC_FIELD"}
_WAYPOINT, _ROTATION = "TYPE_WAYPOINT", "TYPE_ROTATION_VECTOR"

_EVENT = re.compile(r"(ACCE|GYRO|MAGN);\s*-?\d")
_CODES = {"accel": "ACCE", "gyro": "GYRO", "mag": "MAGN"}
_POINT, _AHRS, _PRESSURE = "POSI", "AHRS", "PRES"
_RARE = ("pressure", _PRESSURE, slice(2, 3)), ("satellites", "GNSS", slice(2, 8))
"""Codes of optional sensors, and what is used of their lines."""

Rows = tuple[IntArray, FloatArray]
"""Time stamps (N,) [ns] and values (N, K) of one sensor's events."""

Events = tuple[dict[str, Rows], tuple[IntArray, Rotation] | None]
"""Rows of each sensor, of "taps" (x, y) and of "places" (latitude, longitude, perhaps floor), and
the device's own attitude."""


def read_event_lines(path: Path) -> ImuSequence:
    """Read a trace or a log file."""
    trace = any(_TRACE.match(line) for line in head_lines(path))
    sensors, attitude = _trace(path) if trace else _logfile(path)
    for name in ("gyro", "accel"):
        if name not in sensors:
            found = ", ".join(sensors) or "no sensor"
            raise ReadError(path, "events", f"those of {found}", "those of gyro and accel")
    stamps, gyro, accel = resample_to_gyro(path, *sensors["gyro"], *sensors["accel"])
    field = sensors.get("mag")
    return ImuSequence(
        name=path.stem,
        time=seconds(stamps, stamps[0]),
        gyro=gyro,
        accel=accel,
        magnetometer=field and magnetometer(seconds(field[0], stamps[0]), field[1]),
        device_attitude=device_attitude(attitude, stamps[0]),
        positions=_waypoints(sensors, stamps[0]),
        barometer=_barometer(path, sensors, stamps[0]),
        satellites=_satellites(sensors, stamps[0]),
    )


def is_event_lines(path: Path) -> bool:
    """Return whether a text file's first lines hold a sensor event."""
    if not path.is_file() or path.suffix.lower() not in (".txt", ".csv", ".log"):
        return False
    return any(_TRACE.match(line) or _EVENT.match(line) for line in head_lines(path))


def _attitude(
    path: Path, kind: str, rows: list[list[str]], unit_ns: int, used: slice, gyro: Rows | None
) -> tuple[IntArray, Rotation] | None:
    """Return the device's own attitude if it was logged and agrees with the gyroscope."""
    if not rows or gyro is None:
        return None
    try:
        stamps, xyz = _rows(path, kind, rows, unit_ns, used)
    except ReadError as error:  # attitude is optional
        _log.info("attitude skipped: %s", error)
        return None
    w = np.sqrt(np.clip(1.0 - np.sum(xyz**2, axis=1), 0.0, None))
    return agreeing_attitude(stamps, np.column_stack([xyz, w]), Samples(*gyro))


def _waypoints(sensors: dict[str, Rows], start_ns: np.int64) -> PositionTrack | None:
    kind = next((kind for kind in ("taps", "places") if kind in sensors), None)
    if kind is None:
        return None
    stamps, values = sensors[kind]
    order = np.argsort(stamps, kind="stable")
    time = seconds(stamps[order], start_ns)
    keep = increasing_mask(time)
    if not keep.any():
        return None
    time, values = time[keep], values[order][keep]
    if kind == "taps":
        return PositionTrack(time, values, "waypoints")
    degrees, floor = values[:, :2], values[:, 2] if values.shape[1] > 2 else None
    metres = east_north(degrees)
    return PositionTrack(time, metres, "waypoints", latlon_deg=degrees, floor=floor)


def _barometer(path: Path, sensors: dict[str, Rows], start_ns: np.int64) -> Barometer | None:
    if "pressure" not in sensors:
        return None
    stamps, values = sensors["pressure"]
    return barometer(path, _PRESSURE, seconds(stamps, start_ns), values[:, 0])


def _satellites(sensors: dict[str, Rows], start_ns: np.int64) -> Satellites | None:
    if "satellites" not in sensors:
        return None
    stamps, values = sensors["satellites"]
    names = ("altitude_m", "bearing_deg", "radius_m", "speed_m_s")
    rest = dict(zip(names, values[:, 2:].T, strict=True))
    return satellites(seconds(stamps, start_ns), values[:, :2], rest)


def _whole_lines(path: Path, separator: str) -> list[str]:
    """Return all lines but a last one that is cut short because the app was killed."""
    lines = read_lines(path)
    if len(lines) < 2 or path.read_bytes()[-1:] in (b"\n", b"\r"):
        return lines
    last = lines[-1].split(separator)
    earlier = (line.split(separator) for line in lines[-2::-1])
    previous = next((cells for cells in earlier if _kind(cells) == _kind(last)), None)
    is_complete = previous is not None and len(last) >= len(previous)
    return lines if is_complete and math.isfinite(number_in(last[-1])) else lines[:-1]


def _kind(cells: Sequence[str]) -> str:
    """Return the type of an event: the first cell that starts with a letter."""
    return next((cell for cell in cells if cell[:1].isalpha()), "")


def _trace(path: Path) -> Events:
    text = _GLUED.sub(r"\n\1", "\n".join(_whole_lines(path, "\t")))
    events: dict[str, list[list[str]]] = {}
    for line in text.splitlines():
        cells = line.split("\t")
        if len(cells) >= 4 and cells[1].startswith("TYPE_"):
            events.setdefault(cells[1], []).append([cells[0], *cells[2:]])
    sensors = {}
    for sensor, kind in _TYPES.items():
        raw = events.get(f"{kind}_UNCALIBRATED")
        if kind in events:
            sensors[sensor] = _rows(path, kind, events[kind], 10**6, slice(1, 4))
        elif raw is not None:
            stamps, values = _rows(path, kind, raw, 10**6, slice(1, 7))
            sensors[sensor] = stamps, values[:, :3] - values[:, 3:]
    vectors = events.get(_ROTATION, [])
    attitude = _attitude(path, _ROTATION, vectors, 10**6, slice(1, 4), sensors.get("gyro"))
    if _WAYPOINT in events:
        sensors["taps"] = _rows(path, _WAYPOINT, events[_WAYPOINT], 10**6, slice(1, 3))
    return sensors, attitude


def _logfile(path: Path) -> Events:
    events: dict[str, list[list[str]]] = {}
    for line in _whole_lines(path, ";"):
        cells = line.strip().split(";")
        if cells[0] in (*_CODES.values(), _POINT, _AHRS, *(code for _, code, _ in _RARE)):
            events.setdefault(cells[0], []).append(cells[1:])
    sensors = {
        sensor: _rows(path, code, [row[1:] for row in events[code]], 10**9, slice(1, 4))
        for sensor, code in _CODES.items()
        if code in events
    }
    vectors = [row[1:] for row in events.get(_AHRS, [])]
    attitude = _attitude(path, _AHRS, vectors, 10**9, slice(4, 7), sensors.get("gyro"))
    if "ACCE" not in events:
        return sensors, attitude
    # The app's clock, the first time of an event, differs from the sensors'.
    app, sensor = _rows(path, _CODES["accel"], events[_CODES["accel"]], 10**9, slice(1, 2))
    offset = round(float(np.median(app * 1e-9 - sensor[:, 0])) * 1e9)
    if points := events.get(_POINT):
        stamps, values = _rows(
            path, _POINT, points, 10**9, slice(2, max(4, min(5, *map(len, points))))
        )
        sensors["places"] = stamps - offset, values
    for kind, code, used in _RARE:
        try:
            if code in events:
                stamps, values = _rows(path, code, events[code], 10**9, used)
                sensors[kind] = stamps - offset, values
        except ReadError as error:  # these are optional
            _log.warning("%s skipped: %s", kind, error)
    return sensors, attitude


def _rows(path: Path, kind: str, rows: Iterable[list[str]], unit_ns: int, used: slice) -> Rows:
    """Return the stamps and values of events whose first cell is the time."""
    stamps, values = [], []
    for number, row in enumerate(rows, 1):
        if len(row) < used.stop:
            expected = f"time and {used.stop - used.start} values"
            raise ReadError(path, f"{kind}, line {number} of its kind", "a cut line", expected)
        try:
            stamps.append(_stamp_ns(row[0], unit_ns))
            values.append([float(cell) for cell in row[used]])
        except ValueError:
            found = repr(" ".join([row[0], *row[used]]))
            raise ReadError(path, f"{kind}, line {number} of its kind", found, "numbers") from None
    finite = finite_rows(path, kind, np.array(values))
    return np.array(stamps, dtype=np.int64)[finite], np.array(values)[finite]


def _stamp_ns(time: str, unit_ns: int) -> int:
    """Return a time in nanoseconds; `ValueError` if it is no number, or too large for a clock."""
    stamp = round(float(time) * unit_ns) if "." in time else int(time) * unit_ns
    if abs(stamp) >= 2**63:
        raise ValueError
    return stamp
