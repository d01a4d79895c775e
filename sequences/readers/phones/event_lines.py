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
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stario.sequences.arrays import number_in
from stario.sequences.errors import ReadError
from stario.sequences.geodesy import east_north
from stario.sequences.readers.checked import barometer, finite_rows, satellites
from stario.sequences.readers.clocks import Samples, joined_sequence
from stario.sequences.readers.phones.attitude import agreeing_attitude, device_attitude
from stario.sequences.readers.text import head_lines, read_lines
from stario.sequences.sequence import ImuSequence, PositionTrack
from stario.sequences.time_order import increasing_mask

_log = logging.getLogger(__name__)

_TRACE = re.compile(r"\d{10,}\tTYPE_\w+")
_GLUED = re.compile(r"(?<=[^\n])(\d{13}\tTYPE_)")
_TYPES = {"accel": "TYPE_ACCELEROMETER", "gyro": "TYPE_GYROSCOPE", "mag": "TYPE_MAGNETIC_FIELD"}

_EVENT = re.compile(r"(ACCE|GYRO|MAGN);\s*-?\d")
_CODES = {"accel": "ACCE", "gyro": "GYRO", "mag": "MAGN"}
_RARE = {"pressure": ("PRES", slice(2, 3)), "satellites": ("GNSS", slice(2, 8))}
"""Codes of optional sensors, and what is used of their lines."""


@dataclass(frozen=True)
class _Events:
    """Cells of a file's events by kind, without that; the first one or two are times."""

    path: Path
    unit_ns: int
    rows: dict[str, list[list[str]]]

    def samples(self, kind: str, used: slice, clock: int = 0) -> Samples:
        """Return the events of a kind: their times in the column `clock` and the cells `used`."""
        stamps, values = [], []
        for number, row in enumerate(self.rows[kind], 1):
            where = f"{kind}, line {number} of its kind"
            if len(row) < used.stop:
                expected = f"time and {used.stop - used.start} values"
                raise ReadError(self.path, where, "a cut line", expected)
            try:
                stamps.append(_stamp_ns(row[clock], self.unit_ns))
                values.append([float(cell) for cell in row[used]])
            except ValueError:
                found = repr(" ".join([row[clock], *row[used]]))
                raise ReadError(self.path, where, found, "numbers") from None
        finite = finite_rows(self.path, kind, np.array(values))
        return Samples(np.array(stamps, dtype=np.int64)[finite], np.array(values)[finite])

    def optional(self, name: str, kind: str, used: slice, clock: int = 0) -> dict[str, Samples]:
        """Return events by their name; none, with a warning, if they cannot be read."""
        try:
            return {name: self.samples(kind, used, clock)} if kind in self.rows else {}
        except ReadError as error:
            _log.warning("%s skipped: %s", name, error)
            return {}


def read_event_lines(path: Path) -> ImuSequence:
    """Read a trace or a log file."""
    trace = any(_TRACE.match(line) for line in head_lines(path))
    sensors = _trace(path) if trace else _logfile(path)
    if not {"gyro", "accel"} <= set(sensors):
        found = ", ".join(sensors) or "no sensor"
        raise ReadError(path, "events", f"those of {found}", "those of gyro and accel")
    sequence, start_ns = joined_sequence(
        path, path.stem, sensors["gyro"], sensors["accel"], sensors.get("mag")
    )
    parts = dict[str, Any]()
    if vectors := sensors.get("vectors"):
        w = np.sqrt(np.clip(1.0 - np.sum(vectors.values**2, axis=1), 0.0, None))
        quat = np.column_stack([vectors.values, w])
        own = agreeing_attitude(vectors.stamps_ns, quat, sensors["gyro"])
        parts["device_attitude"] = device_attitude(own, start_ns)
    if pressure := sensors.get("pressure"):
        time, values = pressure.seconds(start_ns), pressure.values[:, 0]
        parts["barometer"] = barometer(path, "PRES", time, values)
    if reported := sensors.get("satellites"):
        names = ("altitude_m", "bearing_deg", "radius_m", "speed_m_s")
        rest = dict(zip(names, reported.values[:, 2:].T, strict=True))
        place = reported.values[:, :2]
        parts["satellites"] = satellites(reported.seconds(start_ns), place, rest)
    positions = _waypoints(sensors, start_ns)
    return replace(sequence, positions=positions, **parts)


def is_event_lines(path: Path) -> bool:
    """Return whether a text file's first lines hold a sensor event."""
    if not path.is_file() or path.suffix.lower() not in (".txt", ".csv", ".log"):
        return False
    return any(_TRACE.match(line) or _EVENT.match(line) for line in head_lines(path))


def _waypoints(sensors: dict[str, Samples], start_ns: np.int64) -> PositionTrack | None:
    """Return the "taps" (x, y), or else the "places" (latitude, longitude and perhaps floor)."""
    points = sensors.get("taps") or sensors.get("places")
    if points is None:
        return None
    order = np.argsort(points.stamps_ns, kind="stable")
    order = order[increasing_mask(points.seconds(start_ns)[order])]
    if not len(order):
        return None
    time, values = points.seconds(start_ns)[order], points.values[order]
    if "taps" in sensors:
        return PositionTrack(time, values, "waypoints")
    degrees, floor = values[:, :2], values[:, 2] if values.shape[1] > 2 else None
    return PositionTrack(time, east_north(degrees), "waypoints", latlon_deg=degrees, floor=floor)


def _cells(path: Path, separator: str) -> Iterator[list[str]]:
    """Yield the cells of all lines but a last one that is cut short as the app was killed."""
    lines = read_lines(path)
    if len(lines) > 1 and path.read_bytes()[-1:] not in (b"\n", b"\r"):
        last, *earlier = (line.split(separator) for line in lines[::-1])
        previous = next((cells for cells in earlier if _kind(cells) == _kind(last)), None)
        is_complete = previous is not None and len(last) >= len(previous)
        if not (is_complete and math.isfinite(number_in(last[-1]))):
            lines.pop()
    for line in _GLUED.sub(r"\n\1", "\n".join(lines)).splitlines():
        yield line.split(separator)


def _kind(cells: list[str]) -> str:
    """Return the type of an event: the first cell that starts with a letter."""
    return next((cell for cell in cells if cell[:1].isalpha()), "")


def _trace(path: Path) -> dict[str, Samples]:
    rows: dict[str, list[list[str]]] = {}
    for cells in _cells(path, "\t"):
        if len(cells) >= 4 and cells[1].startswith("TYPE_"):
            rows.setdefault(cells[1], []).append([cells[0], *cells[2:]])
    events, sensors = _Events(path, 10**6, rows), dict[str, Samples]()
    for name, kind in _TYPES.items():
        if kind in rows:
            sensors[name] = events.samples(kind, slice(1, 4))
        elif f"{kind}_UNCALIBRATED" in rows:
            raw = events.samples(f"{kind}_UNCALIBRATED", slice(1, 7))
            sensors[name] = replace(raw, values=raw.values[:, :3] - raw.values[:, 3:])
    if "TYPE_WAYPOINT" in rows:
        sensors["taps"] = events.samples("TYPE_WAYPOINT", slice(1, 3))
    return sensors | events.optional("vectors", "TYPE_ROTATION_VECTOR", slice(1, 4))


def _logfile(path: Path) -> dict[str, Samples]:
    rows: dict[str, list[list[str]]] = {}
    for code, *cells in _cells(path, ";"):
        rows.setdefault(code.strip(), []).append([cell.strip() for cell in cells])
    events = _Events(path, 10**9, rows)
    sensors = {
        name: events.samples(code, slice(2, 5), clock=1)
        for name, code in _CODES.items()
        if code in rows
    }
    if "accel" not in sensors:
        return sensors
    sensors |= events.optional("vectors", "AHRS", slice(5, 8), clock=1)
    # The app's clock, the first time of an event, differs from the sensors'.
    both = events.samples("ACCE", slice(1, 2))
    offset = round(float(np.median(both.stamps_ns * 1e-9 - both.values[:, 0])) * 1e9)
    by_app = {}
    if points := rows.get("POSI"):
        used = slice(2, max(4, min(5, *map(len, points))))
        by_app["places"] = events.samples("POSI", used)
    for name, (code, used) in _RARE.items():
        by_app |= events.optional(name, code, used)
    return sensors | {k: replace(v, stamps_ns=v.stamps_ns - offset) for k, v in by_app.items()}


def _stamp_ns(time: str, unit_ns: int) -> int:
    """Return a time in nanoseconds; `ValueError` if it is no number, or too large for a clock."""
    stamp = round(float(time) * unit_ns) if "." in time else int(time) * unit_ns
    if abs(stamp) >= 2**63:
        raise ValueError
    return stamp
