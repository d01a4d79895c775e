"""Rare rows beside a phone's IMU: pressure, satellite positions and reference points.

They are in columns next to those of the sensors, where apps repeat the last one in every row, or in
a file of the same folder with its own clock: `Barometer.csv`, `pressure.txt`, `Location.csv`,
`GPS.csv`. A header names latitude and longitude, and usually the accuracy: the radius that holds
the true position with a probability of 68 % on Android, and about that on iOS. Reference points
(`*_ref.csv`) are places that the user passed at known times.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.geodesy import east_north
from stario.sequences.readers import checked
from stario.sequences.readers.clocks import unit_within
from stario.sequences.readers.phones.files import text_files
from stario.sequences.readers.phones.sensor_layout import clock_of
from stario.sequences.readers.phones.sensor_words import is_time, sensor_of, unit_of, words_of
from stario.sequences.readers.table_head import TableHead, table_heads
from stario.sequences.readers.text import Column, IntArray, Table, seconds
from stario.sequences.sequence import Barometer, BoolArray, FloatArray, PositionTrack, Satellites
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import TIME_UNITS, unit_named

_log = logging.getLogger(__name__)

Kind = TypeVar("Kind")

_PRESSURE_FILES = {"barometer", "barometers", "baro", "bar", "pressure", "pres"}
_SATELLITE_FILES = {"location", "locations", "gps", "gnss"}
_POINT_FILES = {
    *("ref", "reference", "references", "waypoints", "waypoint", "checkpoints", "landmarks")
}
"""Words of which the name of such a file has one."""

_PRESSURE = ("press", "baro", "pres", "druck", "luftdruck", "presion", "presión", "pression")
_NO_PRESSURE = {"accuracy", "temperature", "temp", "relative", "sea", "altitude", "height", "alt"}
_ALTITUDE = {"altitude", "height", "alt", "relative"}
_PRESSURE_UNIT = re.compile(
    r"[\[(\s_.,-](hpa|mbars?|millibars?|kpa|pa|in_?hg|mmhg|torr|psi|atm|m)(?=[\])\s_.,-]|$)",
    flags=re.IGNORECASE,
)
"""A unit in brackets or as a word of a title: `Pressure (hPa)`, `baro_pa`."""

_TITLES = {
    "latitude": {"latitude", "lat"},
    "longitude": {"longitude", "lon", "long", "lng"},
    "altitude_m": {"altitude", "alt", "height"},
    "speed_m_s": {"speed", "velocity"},
    "bearing_deg": {"bearing", "course", "direction"},
}
"""Words of which a column's title has one; next to a sensor's name they are directions."""

_OTHERS = {"vertical", "heading", "time", "timestamp", "magnetic"}
"""Words of columns that hold something else."""

_ADVIO = "platform-locations.csv"
_OF_ADVIO = ["time", "latitude", "longitude", "accuracy", "altitude", "vertical accuracy"]
"""Columns of a file of ADVIO, which names none."""


@dataclass(frozen=True)
class Recording:
    """What other files of a phone's recording must fit.

    These are the gyroscope's file, the words `key` that the names of all files share, and the
    times of first and last sample on the sensors' clock [ns].
    """

    sensors: Path
    key: str
    start_ns: np.int64
    stop_ns: np.int64

    def within(self, table: Table, known: BoolArray) -> tuple[IntArray, FloatArray]:
        """Return which `known` rows hold something new while it lasts, and their times [s].

        Rows beside those of the sensors repeat the last values.
        """
        if table.path == self.sensors:
            values = table.values[:, 1:]
            same = (values[1:] == values[:-1]) | np.isnan(values[1:]) & np.isnan(values[:-1])
            known = known & np.append(True, ~same.all(axis=1))
        rows = np.flatnonzero(known)
        if not len(rows):
            return rows, np.zeros(0)
        start_ns, stop_ns = self.start_ns, self.stop_ns
        unit = TIME_UNITS.get(table.columns[0].unit)
        if unit is None and len(rows) > 1:
            unit = unit_within(table.path, table.values[rows, 0], start_ns, stop_ns)
        time = seconds(table.stamps_ns(unit or 10**9, rows), start_ns)
        stop = float(stop_ns - start_ns) * 1e-9
        inside = (time >= 0.0) & (time <= stop)
        # A single one may be the last known before the start.
        if not inside.any() and len(rows) > 1:
            found = f"times from {time[0]:.0f} to {time[-1]:.0f} s after the first sample"
            fix = "write both in one clock and time zone"
            raise ReadError(table.path, "time", found, f"times from 0 to {stop:.0f} s", fix)
        inside &= increasing_mask(time)
        return rows[inside], time[inside]


def _read_alongside(
    recording: Recording,
    words: str,
    names: set[str],
    places_in: Callable[[TableHead, bool], dict[str, Column]],
    read: Callable[[Recording, Table, dict[str, Column]], Kind | None],
) -> Iterator[Kind]:
    """Yield what is read from a recording's tables, its own first; none is worth the recording.

    Other files' names have one of the words `names`. `places_in` returns a table's columns, given
    also whether it is the sensors'; none if it lacks them.
    """
    for file in (recording.sensors, *_files_named(recording, names)):
        own = file == recording.sensors
        for head in table_heads(file, least=2):
            if len(head.rows) < 2 or not (places := places_in(head, own)):
                continue
            clock = clock_of(head.titles, head.rows)
            if clock is None and all(place.index for place in places.values()):
                clock = clock_of(["time"], head.rows[:, :1])  # the first column, if it grows
            if clock is None:
                continue
            try:
                table = head.read([head.clock(clock), *places.values()])
                found = read(recording, table, places)
            except ReadError as error:
                _log.warning("%s skipped: %s", words, error)
                break
            if found is not None:
                yield found
            break


def _files_named(recording: Recording, names: set[str]) -> list[Path]:
    """Return the files in a recording's folder whose names have one of some words, the best first.

    Not those of another recording: `two_gps.csv` next to `one_gyr.csv`.
    """
    key, found = set(recording.key.split()), []
    for file, listed in text_files(recording.sensors.parent):
        words = set(listed)
        if names & words and (key <= words or words - names <= key):
            # `LocationGps.csv` holds satellite positions only, `Location.csv` those of all sources.
            found.append((not {"gps", "gnss"} & words, len(file.stem), file))
    return [file for *_, file in sorted(found)]


def recorded_pressure(recording: Recording) -> Barometer | None:
    """Return the pressure next to a recording's sensors; None if there is none that can be used."""
    found = _read_alongside(recording, "pressure", _PRESSURE_FILES, _pressure_in, _pressure)
    return next(found, None)


def _pressure(recording: Recording, table: Table, places: dict[str, Column]) -> Barometer | None:
    place = places["pressure"]
    rows, time = recording.within(table, np.isfinite(table.values[:, 1]))
    return checked.barometer(table.path, place.name, time, table.values[rows, 1], place.unit)


def _pressure_in(head: TableHead, is_sensors: bool) -> dict[str, Column]:
    """Return the column whose title names pressure or else, if the file does, its first value."""
    for index, title in enumerate(head.titles):
        words = set(words_of(title))
        if any(word.startswith(_PRESSURE) for word in words) and not words & _NO_PRESSURE:
            return {"pressure": Column(index, title, _pressure_unit(title))}
    if is_sensors or sensor_of(words_of(head.file.stem)) is not None:  # `bar_gyr.csv`: of a bar
        return {}
    titles = head.titles or ["time", *[""] * (head.rows.shape[1] - 1)]
    for index, title in enumerate(titles):
        if not is_time(title):
            unit = "m" if _ALTITUDE & set(words_of(title)) else _pressure_unit(title)
            return {"pressure": Column(index, title, unit)}
    return {}


def _pressure_unit(title: str) -> str:
    match = _PRESSURE_UNIT.search(title)
    return unit_named(match[1].replace("_", "")) if match else ""


def reported_positions(recording: Recording) -> Iterator[Satellites]:
    """Yield the satellite positions next to a recording's sensors, the best file's first."""
    words = "satellite positions"
    return _read_alongside(recording, words, _SATELLITE_FILES, _satellites_in, _satellites)


def _satellites_in(head: TableHead, is_sensors: bool) -> dict[str, Column]:
    """Return the columns of a position and what is reported with it; none without a position.

    Next to a sensor's columns, those belong to it whose titles begin as that of its latitude does:
    `LOCATION Speed` to `LOCATION Latitude`.
    """
    named = head.titles or (_OF_ADVIO if head.file.name == _ADVIO else [])
    titles = {index: (set(words_of(title)), title) for index, title in enumerate(named)}
    latitudes = (words for words, _ in titles.values() if _place_of(words) == "latitude")
    own = next(latitudes, set()) - _TITLES["latitude"] if is_sensors else set[str]()
    places: dict[str, Column] = {}
    for index, (words, title) in titles.items():
        if own <= words and (place := _place_of(words)):
            places.setdefault(place, Column(index, title, unit_of(title)))
    if not {"latitude", "longitude"} <= set(places):
        return {}
    return {place: places[place] for place in (*_TITLES, "radius_m") if place in places}


def _place_of(words: set[str]) -> str:
    """Return the quantity of a receiver in a column with these words, empty for others."""
    if "accuracy" in words or {"h", "acc"} <= words or "hacc" in words:
        others = _OTHERS.union(*_TITLES.values())
        return "" if others & words else "radius_m"
    if sensor_of(words) is not None or words & _OTHERS:
        return ""
    return next((place for place, names in _TITLES.items() if names & words), "")


def _satellites(recording: Recording, table: Table, places: dict[str, Column]) -> Satellites | None:
    for title in (places["latitude"].title, places["longitude"].title):
        if unit_of(title).startswith("rad"):
            raise ReadError(table.path, "latitude, longitude", title, "degrees")
    values = table.values[:, 1:]
    latlon_deg = checked.in_degrees(table.path, values[:, :2])
    rows, time = recording.within(table, checked.known_places(latlon_deg))
    rest = {
        name: checked.UNITS[name][place.unit] * values[rows, k]
        for k, (name, place) in enumerate(places.items())
        if place.unit in checked.UNITS.get(name, ())
    }
    return checked.satellites(time, latlon_deg[rows], rest)


def as_known_positions(reported: Satellites) -> PositionTrack | None:
    """Return a receiver's positions to compare a track with, x east and y north of the first.

    Repeated ones count once, those known no better than a room not at all; None if fewer than two
    are left.
    """
    new = np.append(True, np.diff(reported.latlon_deg, axis=0).any(axis=1))
    reported = reported.select(new)
    radius = np.full(len(reported), checked.USUAL_RADIUS)
    if reported.radius_m is not None:
        radius = np.where(np.isfinite(reported.radius_m), reported.radius_m, checked.USUAL_RADIUS)
    valid = radius <= checked.LARGEST_RADIUS
    if valid.sum() < 2:
        if len(valid) > 1:
            _log.warning(
                "satellite positions skipped: found %d of %d positions known to %g m, expected at "
                "least two", valid.sum(), len(valid), checked.LARGEST_RADIUS,
            )  # fmt: skip
        return None
    origin = int(np.argmax(valid))
    degrees = np.vstack([reported.latlon_deg[origin], reported.latlon_deg])
    return PositionTrack(
        reported.time,
        east_north(degrees)[1:],
        "positions",
        valid,
        radius / checked.RADIUS_PER_SIGMA,
        latlon_deg=reported.latlon_deg,
    )


def reference_points(recording: Recording) -> PositionTrack | None:
    """Return the waypoints of a file such as `*_ref.csv` (time, x, y [m]), or None without one."""
    for file, words in text_files(recording.sensors.parent):
        named = _POINT_FILES & set(words) and set(recording.key.split()) <= set(words)
        head = next(table_heads(file, least=3), None) if named else None
        if head is None:
            continue
        table = head.read(3)
        unit = unit_within(file, table.values[:, 0], recording.start_ns, recording.stop_ns)
        time = seconds(table.stamps_ns(unit), recording.start_ns)
        kept = increasing_mask(time)
        return PositionTrack(time[kept], table.values[kept, 1:3], "waypoints")
    return None
