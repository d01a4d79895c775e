"""Satellite positions that a phone logged alongside its IMU: `Location.csv`, `GPS.csv`, columns.

A header names latitude and longitude, and usually the accuracy: the radius that holds the true
position with a probability of 68 % on Android, and about that on iOS.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.clocks import unit_within
from stario.sequences.readers.columns import Column
from stario.sequences.readers.dates import with_seconds
from stario.sequences.readers.geodesy import east_north
from stario.sequences.readers.lines import head_lines
from stario.sequences.readers.phones.sensor_layout import clock_of
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.separators import cells_of, first_row, number_of
from stario.sequences.readers.text import read_table, seconds
from stario.sequences.sequence import PositionTrack
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import TIME_UNITS

_log = logging.getLogger(__name__)

_NAMES = {"location", "locations", "gps", "gnss"}
"""Words of which the name of a file of satellite positions has one."""

_PLACES = {"latitude": {"latitude", "lat"}, "longitude": {"longitude", "lon", "lng"}}
"""Words of which the title of a column of latitudes or longitudes has one."""

_RADIUS_PER_SIGMA = 1.51
"""Radius that holds 68 % of a Gaussian in the plane, in standard deviations per axis."""

_USUAL_RADIUS = 10.0
"""Radius [m] where a file states none."""

_HEAD_ROWS = 24
"""Rows that show which columns are clocks."""

_LARGEST_RADIUS = 30.0
"""Larger radii [m] are of positions from cells of the network or of rooms without reception."""


@dataclass(frozen=True)
class _Header:
    """Columns of a file of positions, and how to read its rows."""

    clock: Column
    latitude: int
    longitude: int
    radius: int | None
    skip: int
    delimiter: str | None
    decimal: str
    dated: bool = False


def satellite_positions(
    folder: Path, wide: Path, start_ns: np.int64, stop_ns: np.int64
) -> PositionTrack | None:
    """Return the horizontal positions, x east and y north of the first; None if there are none.

    Args:
        folder: the folder to search.
        wide: file that may have columns of positions next to those of its sensors.
        start_ns: time of the recording's first sample on the sensors' clock [ns].
        stop_ns: time of its last sample [ns].
    """
    named = [file for file in sorted(folder.iterdir()) if _NAMES & set(words_of(file.stem))]
    # `LocationGps.csv` holds satellite positions only, `Location.csv` those of all sources.
    named.sort(key=lambda file: (not {"gps", "gnss"} & set(words_of(file.stem)), len(file.stem)))
    for file in (*(f for f in named if f.suffix.lower() in (".csv", ".txt")), wide):
        header = _header(file)
        if header is None:
            continue
        try:
            track = _read(file, header, start_ns, stop_ns)
        except ReadError as error:  # positions are optional
            _log.warning("satellite positions skipped: %s", error)
            continue
        if track is not None:
            return track
    return None


def _header(file: Path) -> _Header | None:
    """Return how to read a file's positions; None if it names none or has no clock."""
    numbered = [(k, line) for k, line in enumerate(head_lines(file)) if line.strip()]
    header = _columns(numbered)
    if header is not None:
        return header
    lines = with_seconds(line for _, line in numbered)
    header = _columns([(k, line) for (k, _), line in zip(numbered, lines, strict=True)])
    if header is None:
        return None
    return replace(header, dated=True, clock=replace(header.clock, unit="s"))


def _columns(numbered: list[tuple[int, str]]) -> _Header | None:
    """Return the columns of positions, given the lines at a file's start with their numbers."""
    found = first_row(numbered, least=3)
    if found is None or not found[0]:
        return None
    first, delimiter, decimal = found
    titles = [title.strip(" #\"'\ufeff") for title in numbered[first - 1][1].split(delimiter)]
    places = [_place_of(title) for title in titles]
    if not {"latitude", "longitude"} <= set(places):
        return None
    rows = [cells_of(line, delimiter, decimal) for _, line in numbered[first:]]
    whole = [row for row in rows[:_HEAD_ROWS] if len(row) == len(titles)]
    head = np.array([[number_of(cell) for cell in row] for row in whole])
    clock = clock_of(titles, head) if len(whole) > 1 else None
    if clock is None:
        return None
    radius = places.index("radius") if "radius" in places else None
    latitude, longitude = places.index("latitude"), places.index("longitude")
    skip = numbered[first][0]
    return _Header(clock, latitude, longitude, radius, skip, delimiter, decimal)


def _place_of(title: str) -> str:
    """Return what a column holds: "latitude", "longitude", "radius" of accuracy, or nothing."""
    words = words_of(title)
    for place, names in _PLACES.items():
        if names & set(words):
            return place
    others = {"vertical", "speed", "bearing", "course", "heading", "altitude", "time", "magnetic"}
    return "radius" if "accuracy" in words and not others & set(words) else ""


def _read(
    file: Path, header: _Header, start_ns: np.int64, stop_ns: np.int64
) -> PositionTrack | None:
    used = [header.clock.index, header.latitude, header.longitude]
    used += [] if header.radius is None else [header.radius]
    table = read_table(
        file, used, header.skip, header.delimiter, header.decimal, killed=True, dated=header.dated
    )
    place = table.values[:, 1:3]
    known = np.asarray((np.abs(place) <= [90.0, 180.0]).all(axis=1))  # not where NaN
    known &= place.any(axis=1)  # some apps write zeros until there is a position
    known[1:] &= (np.diff(place, axis=0) != 0.0).any(axis=1)  # repeated until there is another
    rows = np.flatnonzero(known)
    if not len(rows):
        return None
    unit = TIME_UNITS.get(header.clock.unit)
    if unit is None:
        unit = unit_within(file, table.values[rows, 0], start_ns, stop_ns)
    time = seconds(table.stamps_ns(header.clock.index, unit, rows), start_ns)
    inside = (time >= 0.0) & (time <= float(stop_ns - start_ns) * 1e-9)
    inside &= increasing_mask(time)
    if len(time) > 1 and not inside.any():  # a single one may be the last known before the start
        found = f"times from {time[0]:.0f} to {time[-1]:.0f} s after the first sample"
        expected = f"times from 0 to {float(stop_ns - start_ns) * 1e-9:.0f} s"
        fix = "write both in one clock and time zone"
        raise ReadError(file, "time", found, expected, fix)
    if inside.sum() < 2:
        return None
    rows, time = rows[inside], time[inside]
    radius = table.values[rows, 3] if header.radius is not None else np.full(len(rows), np.nan)
    radius = np.where(np.isfinite(radius), radius, _USUAL_RADIUS)
    valid = (radius > 0.0) & (radius <= _LARGEST_RADIUS)  # iOS: negative where there is none
    if valid.sum() < 2:
        found = f"{valid.sum()} of {len(valid)} positions known to {_LARGEST_RADIUS:g} m"
        raise ReadError(file, "accuracy", found, "at least two")
    origin = int(np.argmax(valid))
    degrees = np.vstack([table.values[rows[origin], 1:3], table.values[rows, 1:3]])
    xy = east_north(degrees)[1:]
    return PositionTrack(time, xy, "positions", valid, radius / _RADIUS_PER_SIGMA)
