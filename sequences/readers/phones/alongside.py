"""Rare rows beside a phone's IMU: pressure and satellite positions.

They are in columns next to those of the sensors, where apps repeat the last one in every row, or in
a file of the same folder with its own clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.clocks import unit_within
from stario.sequences.readers.columns import Column
from stario.sequences.readers.phones.files import SUFFIXES
from stario.sequences.readers.phones.sensor_layout import clock_of
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.table_head import TableHead, table_heads
from stario.sequences.readers.text import IntArray, Table, seconds
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import TIME_UNITS


@dataclass(frozen=True)
class Recording:
    """What other files of a phone's recording must fit.

    Attributes:
        sensors: the gyroscope's file.
        key: the words that the names of all files of the recording share.
        start_ns: time of the first sample on the sensors' clock [ns].
        stop_ns: time of the last sample [ns].
    """

    sensors: Path
    key: str
    start_ns: np.int64
    stop_ns: np.int64


@dataclass(frozen=True)
class Columns:
    """Columns of a table by quantity, and its clock; `held` if rows repeat the last values."""

    head: TableHead
    clock: Column
    places: dict[str, Column]
    held: bool

    def read(self) -> Table:
        """Read the clock and the columns, in their order.

        Raises:
            ReadError: a row is malformed.
        """
        return self.head.read([self.clock.index, *(p.index for p in self.places.values())])

    def within(
        self, table: Table, known: BoolArray, recording: Recording
    ) -> tuple[IntArray, FloatArray]:
        """Return the rows (N,) that hold something new within a recording, and their times [s].

        Args:
            table: the rows, as `read` returns them.
            known: whether each row holds anything.
            recording: the recording.

        Raises:
            ReadError: all of several rows are at other times.
        """
        if self.held:
            values = table.values[:, 1:]
            same = (values[1:] == values[:-1]) | np.isnan(values[1:]) & np.isnan(values[:-1])
            known = known & np.append(True, ~same.all(axis=1))
        rows = np.flatnonzero(known)
        if not len(rows):
            return rows, np.zeros(0)
        start_ns, stop_ns = recording.start_ns, recording.stop_ns
        unit = TIME_UNITS.get(self.clock.unit)
        if unit is None and len(rows) > 1:
            unit = unit_within(table.path, table.values[rows, 0], start_ns, stop_ns)
        time = seconds(table.stamps_ns(self.clock.index, unit or 10**9, rows), start_ns)
        stop = float(stop_ns - start_ns) * 1e-9
        inside = (time >= 0.0) & (time <= stop)
        if (
            not inside.any() and len(rows) > 1
        ):  # a single one may be the last known before the start
            found = f"times from {time[0]:.0f} to {time[-1]:.0f} s after the first sample"
            fix = "write both in one clock and time zone"
            raise ReadError(table.path, "time", found, f"times from 0 to {stop:.0f} s", fix)
        inside &= increasing_mask(time)
        return rows[inside], time[inside]


def tables_alongside(
    recording: Recording,
    names: set[str],
    least: int,
    places_in: Callable[[TableHead, bool], dict[str, Column]],
) -> Iterator[Columns]:
    """Yield the tables that hold some quantities, the sensors' own first; never raises.

    Args:
        recording: the recording.
        names: words of which the name of a file of theirs has one.
        least: fewest numbers in a row.
        places_in: function that returns the quantities' columns in a table, given also whether it
            is the sensors'; none if it does not hold them.
    """
    for file in (recording.sensors, *files_named(recording, names)):
        own = file == recording.sensors
        for head in table_heads(file, least):
            if len(head.rows) < 2 or not (places := places_in(head, own)):
                continue
            if clock := clock_of(head.titles, head.rows) or _first_column(head, places):
                yield Columns(head, head.clock(clock), places, held=own)
                break


def _first_column(head: TableHead, places: dict[str, Column]) -> Column | None:
    """Return the first column of a table whose titles name no clock, if it grows."""
    if any(place.index == 0 for place in places.values()):
        return None
    return clock_of(["time"], head.rows[:, :1])


def files_named(recording: Recording, names: set[str]) -> list[Path]:
    """Return the files in a recording's folder whose names have one of some words, the best first.

    Not those of another recording: `two_gps.csv` next to `one_gyr.csv`.
    """
    key, found = set(recording.key.split()), []
    for file in sorted(recording.sensors.parent.iterdir()):
        words = set(words_of(file.stem))
        mine = key <= words or words - names <= key
        if file.suffix.lower() in SUFFIXES and names & words and mine:
            # `LocationGps.csv` holds satellite positions only, `Location.csv` those of all sources.
            found.append((not {"gps", "gnss"} & words, len(file.stem), file))
    return [file for *_, file in sorted(found)]
