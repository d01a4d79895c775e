"""Positions next to a phone's IMU: from satellites (`Location.csv`, `GPS.csv`, columns), or points.

A header names latitude and longitude, and usually the accuracy: the radius that holds the true
position with a probability of 68 % on Android, and about that on iOS. Reference points are places
that the user passed at known times.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.geodesy import east_north
from stario.sequences.readers.clocks import unit_within
from stario.sequences.readers.columns import Column
from stario.sequences.readers.phones.sensor_layout import clock_of
from stario.sequences.readers.phones.sensor_words import sensor_of, unit_of, words_of
from stario.sequences.readers.table_head import TableHead, table_heads
from stario.sequences.readers.text import IntArray, Table, seconds
from stario.sequences.sequence import FloatArray, PositionTrack
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import TIME_UNITS

_log = logging.getLogger(__name__)

_POINT_NAMES = {
    "ref",
    "reference",
    "references",
    "waypoints",
    "waypoint",
    "checkpoints",
    "landmarks",
}
"""Words of which the name of a file of reference points has one."""

_NAMES = {"location", "locations", "gps", "gnss"}
"""Words of which the name of a file of satellite positions has one."""

_TITLES = {"latitude": {"latitude", "lat"}, "longitude": {"longitude", "lon", "long", "lng"}}
"""Words of which a column's title has one; next to a sensor's name they are directions."""

_LARGEST_DEGREES = 90.0, 180.0
"""Largest latitude and longitude."""

_RADIUS_PER_SIGMA = 1.51
"""Radius that holds 68 % of a Gaussian in the plane, in standard deviations per axis."""

_USUAL_RADIUS = 10.0
"""Radius [m] where a file states none."""

_LARGEST_RADIUS = 30.0
"""Larger radii [m] are of positions from cells of the network or of rooms without reception."""


@dataclass(frozen=True)
class _Columns:
    """Columns of a file of positions: clock, latitude, longitude and, if stated, radius."""

    head: TableHead
    clock: Column
    used: list[int]


def satellite_positions(
    sensors: Path, key: str, start_ns: np.int64, stop_ns: np.int64
) -> PositionTrack | None:
    """Return the horizontal positions, x east and y north of the first; None if there are none.

    They are in columns next to those of the sensors, or else in a file of the same folder.

    Args:
        sensors: the gyroscope's file.
        key: the words that the names of all files of the recording share.
        start_ns: time of the recording's first sample on the sensors' clock [ns].
        stop_ns: time of its last sample [ns].
    """
    for file in (sensors, *_named(sensors.parent, set(key.split()))):
        columns = _positions_in(file)
        if columns is None:
            continue
        try:
            track = _read(columns, start_ns, stop_ns)
        except ReadError as error:  # positions are optional
            _log.warning("satellite positions skipped: %s", error)
            continue
        if track is not None:
            return track
    return None


def _named(folder: Path, key: set[str]) -> list[Path]:
    """Return the files whose names say that they hold positions, the best first.

    Not those of another recording: `two_gps.csv` next to `one_gyr.csv`.
    """
    found = []
    for file in sorted(folder.iterdir()):
        words = set(words_of(file.stem))
        mine = key <= words or words - _NAMES <= key
        if file.suffix.lower() in (".csv", ".txt") and _NAMES & words and mine:
            # `LocationGps.csv` holds satellite positions only, `Location.csv` those of all sources.
            found.append((not {"gps", "gnss"} & words, len(file.stem), file))
    return [file for *_, file in sorted(found)]


def _positions_in(file: Path) -> _Columns | None:
    """Return how to read a file's positions; None if it names none or has no clock."""
    for head in table_heads(file, least=3):
        places = [_place_of(title) for title in head.titles]
        if len(head.rows) < 2 or not {"latitude", "longitude"} <= set(places):
            continue
        if clock := clock_of(head.titles, head.rows):
            used = [clock.index, places.index("latitude"), places.index("longitude")]
            used += [places.index("radius")] if "radius" in places else []
            return _Columns(head, head.clock(clock), used)
    return None


def _place_of(title: str) -> str:
    """Return what a column holds: "latitude", "longitude", "radius" of accuracy, or nothing."""
    words = set(words_of(title))
    for place, names in _TITLES.items():
        if names & words and sensor_of(words) is None:
            return place
    others = {"vertical", "speed", "bearing", "course", "heading", "altitude", "time", "magnetic"}
    stated = "accuracy" in words or {"h", "acc"} <= words or "hacc" in words
    return "radius" if stated and not others & words else ""


def _read(columns: _Columns, start_ns: np.int64, stop_ns: np.int64) -> PositionTrack | None:
    table = columns.head.read(columns.used)
    _check_degrees(table, [columns.head.titles[place] for place in columns.used[1:3]])
    rows, time = _within(table, columns.clock, start_ns, stop_ns)
    if len(rows) < 2:
        return None
    stated = len(columns.used) > 3
    radius = table.values[rows, 3] if stated else np.full(len(rows), np.nan)
    radius = np.where(np.isfinite(radius), radius, _USUAL_RADIUS)
    valid = (radius > 0.0) & (radius <= _LARGEST_RADIUS)  # iOS: negative where there is none
    if valid.sum() < 2:
        found = f"{valid.sum()} of {len(valid)} positions known to {_LARGEST_RADIUS:g} m"
        raise ReadError(table.path, "accuracy", found, "at least two")
    origin = int(np.argmax(valid))
    degrees = np.vstack([table.values[rows[origin], 1:3], table.values[rows, 1:3]])
    xy = east_north(degrees)[1:]
    return PositionTrack(time, xy, "positions", valid, radius / _RADIUS_PER_SIGMA)


def _check_degrees(table: Table, titles: list[str]) -> None:
    """Check that latitude and longitude are in degrees; a few cells may hold anything else.

    Raises:
        ReadError: their titles name another unit, or no row can be in degrees.
    """
    place = table.values[:, 1:3]
    present = place[np.isfinite(place).all(axis=1) & place.any(axis=1)]
    found = next((title for title in titles if unit_of(title).startswith("rad")), "")
    if not found and len(present) > 1 and (np.abs(present) > _LARGEST_DEGREES).any(axis=1).all():
        found = f"{present[0, 0]:.10g} and {present[0, 1]:.10g}"
    if found:
        raise ReadError(
            table.path, "latitude, longitude", found, "degrees, as in 48.137 and 11.575"
        )


def _within(
    table: Table, clock: Column, start_ns: np.int64, stop_ns: np.int64
) -> tuple[IntArray, FloatArray]:
    """Return the rows (N,) with a new position within the recording, and their times [s].

    Raises:
        ReadError: all of several positions are at other times.
    """
    place = table.values[:, 1:3]
    known = np.asarray((np.abs(place) <= _LARGEST_DEGREES).all(axis=1))  # not where NaN
    known &= place.any(axis=1)  # some apps write zeros until there is a position
    known[1:] &= (np.diff(place, axis=0) != 0.0).any(axis=1)  # repeated until there is another
    rows = np.flatnonzero(known)
    if len(rows) < 2:  # a single one may be the last known before the start
        return rows[:0], np.zeros(0)
    unit = TIME_UNITS.get(clock.unit)
    if unit is None:
        unit = unit_within(table.path, table.values[rows, 0], start_ns, stop_ns)
    time = seconds(table.stamps_ns(clock.index, unit, rows), start_ns)
    stop = float(stop_ns - start_ns) * 1e-9
    inside = (time >= 0.0) & (time <= stop)
    if not inside.any():
        found = f"times from {time[0]:.0f} to {time[-1]:.0f} s after the first sample"
        fix = "write both in one clock and time zone"
        raise ReadError(table.path, "time", found, f"times from 0 to {stop:.0f} s", fix)
    inside &= increasing_mask(time)
    return rows[inside], time[inside]


def reference_points(
    folder: Path, key: str, start_ns: np.int64, stop_ns: np.int64
) -> PositionTrack | None:
    """Return the waypoints of a file such as `*_ref.csv` (time, x, y [m]), or None without one.

    Args:
        folder: the folder to search.
        key: the words that the names of all files of the recording share.
        start_ns: time of the recording's first sample on the sensors' clock [ns].
        stop_ns: time of its last sample [ns].

    Raises:
        ReadError: a row is malformed.
    """
    for file in sorted(folder.iterdir()):
        words = set(words_of(file.stem))
        if file.suffix.lower() not in (".csv", ".txt") or not _POINT_NAMES & words:
            continue
        head = next(table_heads(file, least=3), None)
        if head is None or not set(key.split()) <= words:
            continue
        table = head.read(3)
        unit = unit_within(file, table.values[:, 0], start_ns, stop_ns)
        time = seconds(table.stamps_ns(0, unit), start_ns)
        kept = increasing_mask(time)
        return PositionTrack(time[kept], table.values[kept, 1:3], "waypoints")
    return None
