"""Positions next to a phone's IMU: from satellites (`Location.csv`, `GPS.csv`, columns), or points.

A header names latitude and longitude, and usually the accuracy: the radius that holds the true
position with a probability of 68 % on Android, and about that on iOS. Reference points are places
that the user passed at known times.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.geodesy import east_north
from stario.sequences.readers.clocks import unit_within
from stario.sequences.readers.columns import Column
from stario.sequences.readers.phones.alongside import Columns, Recording, tables_alongside
from stario.sequences.readers.phones.sensor_words import sensor_of, unit_of, words_of
from stario.sequences.readers.satellites import (
    LARGEST_RADIUS,
    RADIUS_PER_SIGMA,
    USUAL_RADIUS,
    in_degrees,
    known_places,
    satellites,
)
from stario.sequences.readers.table_head import TableHead, table_heads
from stario.sequences.readers.text import seconds
from stario.sequences.sequence import PositionTrack, Satellites
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import SPEED_UNITS

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

_METRES = {"m": 1.0, "ft": 0.3048}
_UNITS: dict[str, dict[str, float]] = {
    "altitude_m": _METRES,
    "radius_m": _METRES,
    "speed_m_s": SPEED_UNITS,
    "bearing_deg": {"deg": 1.0, "°": 1.0},
}
"""Factors of the units, the usual one first."""

_ADVIO = "platform-locations.csv"
_OF_ADVIO = ["time", "latitude", "longitude", "accuracy", "altitude", "vertical accuracy"]
"""Columns of a file of ADVIO, which names none."""


def reported_positions(recording: Recording) -> Iterator[Satellites]:
    """Yield the positions next to a recording's sensors, those of the best file first."""
    for columns in tables_alongside(recording, _NAMES, least=3, places_in=_places_in):
        try:
            found = _read(columns, recording)
        except ReadError as error:  # positions are optional
            _log.warning("satellite positions skipped: %s", error)
            continue
        if found is not None:
            yield found


def as_known_positions(reported: Satellites) -> PositionTrack | None:
    """Return a receiver's positions to compare a track with, x east and y north of the first.

    Repeated ones count once, those known no better than a room not at all; None if fewer than two
    are left.
    """
    new = np.append(True, np.diff(reported.latlon_deg, axis=0).any(axis=1))
    reported = reported.select(new)
    radius = np.full(len(reported), USUAL_RADIUS)
    if reported.radius_m is not None:
        radius = np.where(np.isfinite(reported.radius_m), reported.radius_m, USUAL_RADIUS)
    valid = radius <= LARGEST_RADIUS
    if valid.sum() < 2:
        if len(valid) > 1:
            _log.warning(
                "satellite positions skipped: found %d of %d positions known to %g m, expected at "
                "least two", valid.sum(), len(valid), LARGEST_RADIUS,
            )  # fmt: skip
        return None
    origin = int(np.argmax(valid))
    degrees = np.vstack([reported.latlon_deg[origin], reported.latlon_deg])
    return PositionTrack(
        reported.time,
        east_north(degrees)[1:],
        "positions",
        valid,
        radius / RADIUS_PER_SIGMA,
        latlon_deg=reported.latlon_deg,
    )


def _places_in(head: TableHead, is_sensors: bool) -> dict[str, Column]:
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


def _read(columns: Columns, recording: Recording) -> Satellites | None:
    table, places = columns.read(), columns.places
    for title in (places["latitude"].title, places["longitude"].title):
        if unit_of(title).startswith("rad"):
            raise ReadError(table.path, "latitude, longitude", title, "degrees")
    values = table.values[:, 1:]
    latlon_deg = in_degrees(table.path, values[:, :2])
    rows, time = columns.within(table, known_places(latlon_deg), recording)
    rest = {
        name: factor * values[rows, k]
        for k, name in enumerate(places)
        if (factor := _factor(name, places[name].unit))
    }
    return satellites(time, latlon_deg[rows], rest)


def _factor(name: str, unit: str) -> float:
    """Return the factor to m, m/s or degrees; 0 for an unknown unit, and for the place itself."""
    known = _UNITS.get(name, {})
    return known.get(unit, 0.0) if unit else next(iter(known.values()), 0.0)


def reference_points(recording: Recording) -> PositionTrack | None:
    """Return the waypoints of a file such as `*_ref.csv` (time, x, y [m]), or None without one.

    Raises:
        ReadError: a row is malformed.
    """
    for file in sorted(recording.sensors.parent.iterdir()):
        words = set(words_of(file.stem))
        if file.suffix.lower() not in (".csv", ".txt") or not _POINT_NAMES & words:
            continue
        head = next(table_heads(file, least=3), None)
        if head is None or not set(recording.key.split()) <= words:
            continue
        table = head.read(3)
        unit = unit_within(file, table.values[:, 0], recording.start_ns, recording.stop_ns)
        time = seconds(table.stamps_ns(0, unit), recording.start_ns)
        kept = increasing_mask(time)
        return PositionTrack(time[kept], table.values[kept, 1:3], "waypoints")
    return None
