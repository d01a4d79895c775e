"""Columns of clocks and sensor axes in a text file, found by its titles or else by its rows.

With a header, columns are found by their names (`sensor_words`), in any order, among any others.
Without one, a row is time and three values, or three values and time; a second clock between them
is skipped. The same holds if the titles name no known clock; axes are then those they name.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stario.sequences.readers.columns import Column
from stario.sequences.readers.phones.sensor_words import (
    axis_of,
    bias_axis_of,
    is_time,
    quaternion_of,
    time_unit_of,
    unit_of,
)
from stario.sequences.readers.phones.which_imu import Axes, choose
from stario.sequences.sequence import FloatArray

_CLOCK_FROM = 1e6
"""A second column that grows and exceeds this is another clock."""

_MOSTLY = 0.8
"""Share of a clock's steps that do not go back; loggers with a thread per sensor swap some rows."""

_SAME_PACE = 0.02
"""Relative tolerance within which a column as fast as the time, in any unit, is another clock."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Content of the columns.

    Attributes:
        clock: column with the sensor's time.
        axes: x, y and z of each sensor; key "" if the file names no sensor.
        quaternion: x, y, z and w of an attitude, if any.
        biases: columns to subtract from an uncalibrated sensor's values, if any.
        clocks: a sensor's own clock, by the key of its axes, if one precedes them.
        unused: titles of the first columns of other IMUs, which are not read.
        conflict: names of IMUs of which none can be chosen, empty if one can.
    """

    clock: Column
    axes: dict[str, Axes]
    quaternion: tuple[Column, ...] = ()
    biases: tuple[Column, ...] = ()
    clocks: dict[str, Column] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    conflict: str = ""


def by_header(titles: list[str], head: FloatArray) -> Layout | None:
    """Return the layout that titles describe; None if they name no clock or no sensor.

    `head` has the first rows (N, K), NaN where a cell is not a number.
    """
    groups: dict[tuple[str, ...], dict[str, Column]] = {}
    quaternion: dict[str, Column] = {}
    biases: dict[str, Column] = {}
    for k, title in enumerate(titles):
        part, axis, bias = quaternion_of(title), axis_of(title), bias_axis_of(title)
        if part is not None:
            quaternion.setdefault(part, Column(k, title))
        elif axis is not None and not is_time(title):
            place = Column(k, title, unit_of(title))
            groups.setdefault(axis[1], {}).setdefault(axis[0], place)
        elif bias is not None:
            biases.setdefault(bias, Column(k, title))
    choice = choose(_complete(groups))
    axes = choice.axes
    attitude = tuple(quaternion[part] for part in "xyzw") if len(quaternion) == 4 else ()
    clocks = _clocks(titles, head)
    if not clocks or not (axes or attitude):
        return None
    before = {key: _run_before(clocks, places[0].index) for key, places in axes.items()}
    raw = len(axes) == 1 and set(biases) == set("xyz")  # an uncalibrated sensor's file
    return Layout(
        clock=_finest(clocks, head),
        axes=axes,
        quaternion=attitude,
        biases=tuple(biases[axis] for axis in "xyz") if raw else (),
        clocks={key: _finest(run, head) for key, run in before.items() if run},
        unused=choice.unused,
        conflict=choice.conflict,
    )


def clock_of(titles: list[str], head: FloatArray) -> Column | None:
    """Return the clock that `by_header` would choose for all sensors; None if there is none."""
    clocks = _clocks(titles, head)
    return _finest(clocks, head) if clocks else None


def _complete(
    columns: dict[tuple[str, ...], dict[str, Column]],
) -> dict[tuple[str, ...], Axes]:
    """Return the groups of columns that have all three axes."""
    groups: dict[tuple[str, ...], Axes] = {}
    for words, by_axis in columns.items():
        if set(by_axis) == set("xyz"):
            x, y, z = (by_axis[axis] for axis in "xyz")
            x = replace(x, unit="g") if "gf" in words and not x.unit else x
            groups[words] = x, y, z
    return groups


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


def by_rows(titles: list[str], head: FloatArray) -> Layout | None:
    """Return the layout of rows (N, K) without titles, or whose titles name no clock.

    Time is first or fourth, and grows.
    """
    width, named = head.shape[1], _named_axes(titles)
    places = [(time, start) for time, start in ((0, 1), (3, 0)) if time < width]
    for time, start in sorted(places, key=lambda place: -_order(head[:, place[0]])):
        if not _grows(head[:, time]):
            continue
        while start and start < width and _is_clock(head[:, start], head[:, time]):
            start += 1
        if start + 3 > width or not np.isfinite(head[:, start : start + 3]).all():
            continue
        if width > 4 and named is None and _is_code(head[:, start]):  # as in ADVIO's `imu-gyro.csv`
            continue
        axes = named or (Column(start), Column(start + 1), Column(start + 2))
        rest = width - start
        quaternion = tuple(Column(start + k) for k in range(4)) if start and rest >= 4 else ()
        biases: tuple[Column, ...] = ()
        if rest == 6 and start and not np.ptp(head[:, start + 3 :], axis=0).any():
            biases = tuple(Column(start + 3 + k) for k in range(3))
        clock = (
            Column(start - 1) if start > 1 and head[0, start - 1] <= _CLOCK_FROM else Column(time)
        )
        return Layout(clock=clock, axes={"": axes}, quaternion=quaternion, biases=biases)
    return None


def _named_axes(titles: list[str]) -> Axes | None:
    """Return the first columns whose titles name x, y and z; None if one is missing."""
    named: dict[str, Column] = {}
    for k, title in enumerate(titles):
        if (axis := axis_of(title)) is not None:
            named.setdefault(axis[0], Column(k, title, unit_of(title)))
    return (named["x"], named["y"], named["z"]) if len(named) == 3 else None


def _is_code(column: FloatArray) -> bool:
    """Return whether a column holds the number of a sensor, the same in every row."""
    code = float(column[0])
    return code != 0.0 and code.is_integer() and not np.ptp(column)


def _is_clock(column: FloatArray, time: FloatArray) -> bool:
    """Return whether a column next to the time is another clock: large, or as fast as the time."""
    if _order(column) <= _MOSTLY:
        return False
    if abs(column[0]) > _CLOCK_FROM:
        return True
    pace = (column[-1] - column[0]) / (time[-1] - time[0])
    units = 1000.0 ** np.arange(-3, 4)
    return len(column) > 4 and bool(np.abs(pace / units - 1.0).min() < _SAME_PACE)
