"""Columns of clocks and sensor axes in a text file, found by its titles or else by its rows.

With a header, columns are found by their names (`sensor_words`), in any order, among any others.
Without one, a row is time and three values, or three values and time; a second clock between them
is skipped. The same holds if the titles name no known clock; axes are then those they name.

A phone offers a sensor raw and calibrated, or its force with and without gravity: words say which
is the better one. Any other words name a place or a number (`acc_left_x`, `imu2_gx`) and tell
devices apart, whose sensors must not be mixed.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.clocks import Samples, clock_unit
from stario.sequences.readers.columns import unit_of_axes
from stario.sequences.readers.phones.sensor_words import (
    SENSORS,
    Sensor,
    axis_of,
    bias_axis_of,
    is_sensor_word,
    is_time,
    is_uncalibrated,
    quaternion_of,
    sensor_of,
    time_unit_of,
    unit_of,
)
from stario.sequences.readers.table_head import TableHead, refuse_several_devices, table_heads
from stario.sequences.readers.text import Column, IntArray
from stario.sequences.sequence import BoolArray, FloatArray

_log = logging.getLogger(__name__)

Axes = tuple[Column, Column, Column]

_CLOCK_FROM = 1e6
"""A second column that grows and exceeds this is another clock."""

_MOSTLY = 0.8
"""Share of a clock's steps that do not go back; loggers with a thread per sensor swap some rows."""

_SAME_PACE = 0.02
"""Relative tolerance within which a column as fast as the time, in any unit, is another clock."""

_WILD = 100.0
"""Factor beyond a sensor's limit at which one sample would spoil integrals and interpolation."""

_IN_VARIANTS = {
    *("velocity", "speed", "motion", "body", "raw", "uncomp", "cal", "ln", "wr"),
    *("value", "values", "data", "sensor", "reading", "android", "axis"),
}
"""Words of variants of a sensor and words that say nothing, besides `is_sensor_word`."""

_OF_UNIT: dict[str, Sensor] = {"rad/s": "gyro", "deg/s": "gyro", "m/s^2": "accel", "g": "accel"}


@dataclass(frozen=True, kw_only=True)
class SensorTable:
    """How to read a file's rows, and what its columns hold.

    Attributes:
        head: head of the file's table.
        clock: column with the sensor's time.
        axes: x, y and z of each sensor; key "" if the file names no sensor.
        quaternion: x, y, z and w of an attitude, if any.
        biases: columns to subtract from an uncalibrated sensor's values, if any.
        clocks: a sensor's own clock, by the key of its axes, if one precedes them.
        unused: titles of the first columns of other IMUs, which are not read.
        conflict: names of IMUs of which none can be chosen, empty if one can.
    """

    head: TableHead
    clock: Column
    axes: dict[str, Axes]
    quaternion: tuple[Column, ...] = ()
    biases: tuple[Column, ...] = ()
    clocks: dict[str, Column] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    conflict: str = ""

    @property
    def file(self) -> Path:
        """The file."""
        return self.head.file


def sensor_table(file: Path) -> SensorTable | None:
    """Return how to read a file's rows, or None if that cannot be determined; never raises."""
    for head in table_heads(file):
        if len(head.rows) > 1 and (table := _by_header(head) or _by_rows(head)):
            return table
    return None


def _by_header(head: TableHead) -> SensorTable | None:
    """Return the layout that titles describe; None if they name no clock or no sensor."""
    groups: dict[tuple[str, ...], dict[str, Column]] = {}
    quaternion: dict[str, Column] = {}
    biases: dict[str, Column] = {}
    for k, title in enumerate(head.titles):
        part, axis, bias = quaternion_of(title), axis_of(title), bias_axis_of(title)
        if part is not None:
            quaternion.setdefault(part, Column(k, title))
        elif axis is not None and not is_time(title):
            place = Column(k, title, unit_of(title))
            groups.setdefault(axis[1], {}).setdefault(axis[0], place)
        elif bias is not None:
            biases.setdefault(bias, Column(k, title))
    axes, unused, conflict = _choice(_groups(groups))
    attitude = tuple(quaternion[part] for part in "xyzw") if len(quaternion) == 4 else ()
    clocks = _clocks(head.titles, head.rows)
    if not clocks or not (axes or attitude):
        return None
    before = {key: _run_before(clocks, places[0].index) for key, places in axes.items()}
    raw = len(axes) == 1 and set(biases) == set("xyz")  # an uncalibrated sensor's file
    return SensorTable(
        head=head,
        clock=head.clock(_finest(clocks, head.rows)),
        axes=axes,
        quaternion=attitude,
        biases=tuple(biases[axis] for axis in "xyz") if raw else (),
        clocks={key: head.clock(_finest(run, head.rows)) for key, run in before.items() if run},
        unused=unused,
        conflict=conflict,
    )


@dataclass(frozen=True)
class _Group:
    """The three axes that share all other words of their titles, and the sensor they belong to."""

    words: tuple[str, ...]
    axes: Axes
    sensor: Sensor | None

    @property
    def device(self) -> tuple[str, ...]:
        """The words that tell devices apart; none for most files."""
        kept = (word for word in self.words if word not in _IN_VARIANTS)
        return tuple(word for word in kept if not is_sensor_word(word))

    @property
    def rank(self) -> tuple[bool, bool, bool, int]:
        """Sort key: calibrated first, then total force, low noise (Shimmer), and fewer words."""
        total = bool({"gf", "total"} & set(self.words))
        return is_uncalibrated(self.words), not total, "wr" in self.words, len(self.words)


def _groups(columns: dict[tuple[str, ...], dict[str, Column]]) -> list[_Group]:
    """Return the groups of columns, by their words and axes, that have all three axes.

    A unit tells the sensor where no name does: `AsX(°/s)`.
    """
    named = []
    for words, by_axis in columns.items():
        if len(by_axis) == 3:
            x, y, z = (by_axis[axis] for axis in "xyz")
            x = replace(x, unit="g") if "gf" in words and not x.unit else x
            named.append(_Group(words, (x, y, z), sensor_of(words)))
    known = {group.sensor for group in named}
    groups = []
    for group in named:
        by_unit = _OF_UNIT.get(next((place.unit for place in group.axes if place.unit), ""))
        guessed = group.sensor is None and bool(group.words) and by_unit not in known
        groups.append(replace(group, sensor=by_unit) if guessed else group)
    return [group for group in groups if group.sensor != "attitude"]


def _choice(groups: list[_Group]) -> tuple[dict[str, Axes], tuple[str, ...], str]:
    """Return the best group of each sensor, all of the first device that has both sensors.

    Titles of the first columns of other devices, which are not read, and of devices of which none
    can be chosen follow.
    """
    by_column = sorted(groups, key=lambda group: min(place.index for place in group.axes))
    gyros = [group for group in by_column if group.sensor == "gyro"]
    forces = [group for group in by_column if group.sensor in ("accel", "linear")]
    with_force = {group.device for group in forces}
    whole = dict.fromkeys(group.device for group in gyros if group.device in with_force)
    several = len({group.device for group in gyros}) > 1 or len(with_force) > 1
    if not several:
        return _best(groups), (), ""
    if not whole:
        clashing = _clashing(gyros) or _clashing([g for g in forces if g.sensor == "accel"])
        return _best(groups), (), " and ".join(clashing)
    device = next(iter(whole))
    mine = {group.sensor for group in groups if group.device == device}
    used = [group for group in groups if group.device == device or group.sensor not in mine]
    others = [group for group in (*gyros, *forces) if group.device in set(whole) - {device}]
    return _best(used), tuple(group.axes[0].title for group in others), ""


def _best(groups: list[_Group]) -> dict[str, Axes]:
    axes: dict[str, Axes] = {}
    for group in sorted(groups, key=lambda group: group.rank):
        axes.setdefault(group.sensor or "", group.axes)
    return axes


def _clashing(groups: list[_Group]) -> list[str]:
    """Return the titles of groups of several devices none of which is better than the others."""
    first = min((group.rank for group in groups), default=None)
    best = [group for group in groups if group.rank == first]
    return [group.axes[0].title for group in best] if len({g.device for g in best}) > 1 else []


def clock_of(titles: list[str], head: FloatArray) -> Column | None:
    """Return the clock of a table's rows (N, K) by its titles; None if there is none."""
    clocks = _clocks(titles, head)
    return _finest(clocks, head) if clocks else None


def _clocks(titles: list[str], head: FloatArray) -> list[Column]:
    return [
        Column(k, title, time_unit_of(title))
        for k, title in enumerate(titles)
        if is_time(title) and _grows(head[:, k])
    ]


def _run_before(clocks: list[Column], column: int) -> list[Column]:
    """Return the adjacent clocks that most closely precede a column."""
    run: list[Column] = []
    for clock in reversed(clocks):
        if clock.index < (run[-1].index if run else column):
            if run and clock.index < run[-1].index - 1:
                break
            run.append(clock)
    return run[::-1]


def _finest(clocks: list[Column], head: FloatArray) -> Column:
    """Return the best clock: a sensor's own rather than the app's, then the finer unit."""
    order = {"ns": 0, "us": 1, "": 2, "s": 3, "ms": 4}

    def rank(place: Column) -> tuple[bool, int]:
        own = "sensor" in place.title.lower()
        large = not place.unit and head[0, place.index] > 1e15
        return not own, 0 if large else order.get(place.unit, 2)

    return min(clocks, key=rank)


def _grows(column: FloatArray) -> bool:
    return bool(np.isfinite(column).all() and _order(column) > _MOSTLY and column[-1] > column[0])


def _order(column: FloatArray) -> float:
    """Return the share of a column's steps that do not go back."""
    return float((np.diff(column) >= 0).mean())


def _by_rows(head: TableHead) -> SensorTable | None:
    """Return the layout of rows whose titles name no clock: time is first or fourth, and grows."""
    rows, named = head.rows, _named_axes(head.titles)
    width = rows.shape[1]
    places = [(time, start) for time, start in ((0, 1), (3, 0)) if time < width]
    for time, start in sorted(places, key=lambda place: -_order(rows[:, place[0]])):
        if not _grows(rows[:, time]):
            continue
        while start and start < width and _is_clock(rows[:, start], rows[:, time]):
            start += 1
        if start + 3 > width or not np.isfinite(rows[:, start : start + 3]).all():
            continue
        code = rows[0, start]  # of a sensor, the same in every row: ADVIO's `imu-gyro.csv`
        coded = code != 0.0 and code.is_integer() and not np.ptp(rows[:, start])
        if width > 4 and named is None and coded:
            continue
        rest = width - start
        raw = rest == 6 and start and not np.ptp(rows[:, start + 3 :], axis=0).any()
        clock = start - 1 if start > 1 and rows[0, start - 1] <= _CLOCK_FROM else time
        return SensorTable(
            head=head,
            clock=head.clock(Column(clock)),
            axes={"": named or (Column(start), Column(start + 1), Column(start + 2))},
            quaternion=tuple(Column(start + k) for k in range(4)) if start and rest >= 4 else (),
            biases=tuple(Column(start + 3 + k) for k in range(3)) if raw else (),
        )
    return None


def _named_axes(titles: list[str]) -> Axes | None:
    """Return the first columns whose titles name x, y and z; None if one is missing."""
    named: dict[str, Column] = {}
    for k, title in enumerate(titles):
        if (axis := axis_of(title)) is not None:
            named.setdefault(axis[0], Column(k, title, unit_of(title)))
    return (named["x"], named["y"], named["z"]) if len(named) == 3 else None


def _is_clock(column: FloatArray, time: FloatArray) -> bool:
    """Return whether a column next to the time is another clock: large, or as fast as the time."""
    if _order(column) <= _MOSTLY:
        return False
    if abs(column[0]) > _CLOCK_FROM:
        return True
    pace = (column[-1] - column[0]) / (time[-1] - time[0])
    units = 1000.0 ** np.arange(-3, 4)
    return len(column) > 4 and bool(np.abs(pace / units - 1.0).min() < _SAME_PACE)


def read_samples(table: SensorTable, sensor: Sensor) -> Samples:
    """Read a sensor's samples, in rad/s, m/s^2 or uT if the file names a unit."""
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
    unit, factor = unit_of_axes(table.file, places, SENSORS[sensor].units)
    values = factor * values
    sound = _sound_samples(table.file, sensor, titles, values)
    kept, time, values = kept[sound], time[sound], values[sound]
    unit_ns, assumed = clock_unit(table.file, clock, time)
    return Samples(rows.stamps_ns(unit_ns, kept), values, unit, assumed)


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
