"""Pressure next to a phone's IMU: `Barometer.csv`, `Pressure.csv`, `pressure.txt`, or a column."""

from __future__ import annotations

import logging
import re

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.columns import Column
from stario.sequences.readers.phones.alongside import Recording, tables_alongside
from stario.sequences.readers.phones.sensor_words import is_time, sensor_of, words_of
from stario.sequences.readers.pressure import barometer
from stario.sequences.readers.table_head import TableHead
from stario.sequences.sequence import Barometer
from stario.sequences.units import unit_named

_log = logging.getLogger(__name__)

_NAMES = {"barometer", "barometers", "baro", "bar", "pressure", "pres"}
"""Words of which the name of a file of pressures has one."""

_PRESSURE = ("press", "baro", "pres", "druck", "luftdruck", "presion", "presión", "pression")
_NO_PRESSURE = {"accuracy", "temperature", "temp", "relative", "sea", "altitude", "height", "alt"}
_ALTITUDE = {"altitude", "height", "alt", "relative"}

_UNIT = re.compile(
    r"[\[(\s_.,-](hpa|mbars?|millibars?|kpa|pa|in_?hg|mmhg|torr|psi|atm|m)(?=[\])\s_.,-]|$)",
    flags=re.IGNORECASE,
)
"""A unit in brackets or as a word of a title: `Pressure (hPa)`, `baro_pa`."""


def recorded_pressure(recording: Recording) -> Barometer | None:
    """Return the pressure next to a recording's sensors; None if there is none that can be used."""
    for columns in tables_alongside(recording, _NAMES, least=2, places_in=_column):
        place = columns.places["pressure"]
        try:
            table = columns.read()
            rows, time = columns.within(table, np.isfinite(table.values[:, 1]), recording)
            title = place.title or f"column {place.index + 1}"
            found = barometer(table.path, title, time, table.values[rows, 1], place.unit)
        except ReadError as error:  # the barometer is optional
            _log.warning("pressure skipped: %s", error)
            continue
        if found is not None:
            return found
    return None


def _column(head: TableHead, is_sensors: bool) -> dict[str, Column]:
    """Return the column whose title names pressure or else, if the file does, its first value."""
    for index, title in enumerate(head.titles):
        words = set(words_of(title))
        if any(word.startswith(_PRESSURE) for word in words) and not words & _NO_PRESSURE:
            return {"pressure": Column(index, title, _unit_of(title))}
    if is_sensors or sensor_of(words_of(head.file.stem)) is not None:  # `bar_gyr.csv`: of a bar
        return {}
    titles = head.titles or ["time", *[""] * (head.rows.shape[1] - 1)]
    for index, title in enumerate(titles):
        if not is_time(title):
            altitude = bool(_ALTITUDE & set(words_of(title)))
            return {"pressure": Column(index, title, "m" if altitude else _unit_of(title))}
    return {}


def _unit_of(title: str) -> str:
    match = _UNIT.search(title)
    return unit_named(match[1].replace("_", "")) if match else ""
