"""Samples of a sensor, read in known units from the columns that `sensor_layout` found."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.clocks import Samples, inferred_unit, time_unit
from stario.sequences.readers.columns import unit_factor
from stario.sequences.readers.phones.sensor_layout import SensorTable
from stario.sequences.readers.phones.sensor_words import SENSORS, Sensor
from stario.sequences.readers.table_head import refuse_several_devices
from stario.sequences.readers.text import IntArray
from stario.sequences.sequence import BoolArray, FloatArray

_log = logging.getLogger(__name__)

_WILD = 100.0
"""Factor beyond a sensor's limit at which one sample would spoil integrals and interpolation."""


def read_samples(table: SensorTable, sensor: Sensor) -> Samples:
    """Read a sensor's samples in the columns that name it, or in those of a file that names none.

    They are in rad/s, m/s^2 or uT if the file names a unit.
    """
    if table.conflict:
        fix = "keep the columns of one"
        raise ReadError(table.file, "header", f"several IMUs ({table.conflict})", "one", fix)
    axes = next((key for key in (sensor, "") if key in table.axes), next(iter(table.axes), None))
    if axes is None:
        raise ReadError(table.file, "header", "no x, y and z", f"the axes of the {sensor}")
    places, clock = table.axes[axes], table.clocks.get(axes, table.clock)
    titles = ", ".join(place.name for place in places)
    rows = table.head.read([clock, *places, *table.biases])
    refuse_several_devices(rows, table.head.titles, places[0].index)
    kept = _complete_rows(table.file, sensor, titles, rows.values[:, 1:])
    time, values = rows.values[kept, 0], rows.values[kept, 1:4]
    if table.biases:
        values = values - rows.values[kept, 4:7]
    named = next((place for place in places if place.unit), places[0])
    values = unit_factor(table.file, named, SENSORS[sensor].units) * values
    sound = _sound_samples(table.file, sensor, titles, values)
    kept, time, values = kept[sound], time[sound], values[sound]
    if clock.unit:
        unit_ns, assumed = time_unit(table.file, time, clock.unit), ""
    else:
        unit_ns, assumed = inferred_unit(table.file, clock.title or "time", time)
    return Samples(rows.stamps_ns(unit_ns, kept), values, named.unit, assumed)


def _complete_rows(file: Path, sensor: Sensor, titles: str, values: FloatArray) -> IntArray:
    """Return the rows without a blank cell, and warn of those that have some values.

    Rows without any are those of other sensors in a wide file.
    """
    blank = np.isnan(values)
    if partly := int((blank.any(axis=1) & ~blank.all(axis=1)).sum()):
        _log.warning("%s: dropped %d samples of the %s with a blank cell", file, partly, sensor)
    kept = np.flatnonzero(~blank.any(axis=1))
    if not len(kept):
        raise ReadError(file, titles, "no row with all three", "samples of three axes")
    return kept


def _sound_samples(file: Path, sensor: Sensor, titles: str, values: FloatArray) -> BoolArray:
    """Return which samples (N,) are not wild, such as infinite, and warn of those that are."""
    size = np.abs(values).max(axis=1)
    typical = float(np.median(size))
    if typical > SENSORS[sensor].limit:
        unit = next(iter(SENSORS[sensor].units))
        raise ReadError(
            file, titles, f"{typical:.3g} on average", f"a plausible value in {unit}",
            "is one of these columns a clock or of another sensor?",
        )  # fmt: skip
    sound = size <= _WILD * SENSORS[sensor].limit
    if not sound.all():
        _log.warning("%s: dropped %d wild samples of the %s", file, (~sound).sum(), sensor)
    return np.asarray(sound)
