"""Choice among several groups of columns for one sensor: variants of it, or several devices.

A phone offers a sensor raw and calibrated, or its force with and without gravity: words say which
is the better one. Any other words name a place or a number (`acc_left_x`, `imu2_gx`) and tell
devices apart, whose sensors must not be mixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from stario.sequences.readers.columns import Column
from stario.sequences.readers.phones.sensor_words import (
    Sensor,
    is_sensor_word,
    is_uncalibrated,
    sensor_of,
)

Axes = tuple[Column, Column, Column]

_IN_VARIANTS = {
    *("velocity", "speed", "motion", "body", "raw", "uncomp", "cal", "ln", "wr"),
    *("value", "values", "data", "sensor", "reading", "android", "axis"),
}
"""Words of variants of a sensor and words that say nothing, besides `is_sensor_word`."""


_OF_UNIT: dict[str, Sensor] = {"rad/s": "gyro", "deg/s": "gyro", "m/s^2": "accel", "g": "accel"}


@dataclass(frozen=True)
class Group:
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


@dataclass(frozen=True)
class Choice:
    """The groups to read.

    Attributes:
        axes: columns of each sensor; key "" if the file names no sensor.
        unused: titles of the first columns of other devices, which are not read.
        conflict: why no choice can be made, empty if it can.
    """

    axes: dict[str, Axes]
    unused: tuple[str, ...] = ()
    conflict: str = ""


def choose(columns: Mapping[tuple[str, ...], Axes]) -> Choice:
    """Return the best group of each sensor, all of the first device that has both sensors.

    `columns` has the axes of each group by the other words of their titles.
    """
    groups = [group for group in _groups(columns) if group.sensor != "attitude"]
    by_column = sorted(groups, key=lambda group: min(place.index for place in group.axes))
    gyros = [group for group in by_column if group.sensor == "gyro"]
    forces = [group for group in by_column if group.sensor in ("accel", "linear")]
    with_force = {group.device for group in forces}
    whole = dict.fromkeys(group.device for group in gyros if group.device in with_force)
    several = len({group.device for group in gyros}) > 1 or len(with_force) > 1
    if not several:
        return Choice(_best(groups))
    if not whole:
        clashing = _clashing(gyros) or _clashing([g for g in forces if g.sensor == "accel"])
        return Choice(_best(groups), conflict=" and ".join(clashing))
    device = next(iter(whole))
    mine = {group.sensor for group in groups if group.device == device}
    used = [group for group in groups if group.device == device or group.sensor not in mine]
    others = [group for group in (*gyros, *forces) if group.device in set(whole) - {device}]
    return Choice(_best(used), tuple(group.axes[0].title for group in others))


def _groups(columns: Mapping[tuple[str, ...], Axes]) -> list[Group]:
    """Return the groups; a unit tells the sensor where no name does: `AsX(°/s)`."""
    named = [Group(words, axes, sensor_of(words)) for words, axes in columns.items()]
    known = {group.sensor for group in named}
    groups = []
    for group in named:
        by_unit = _OF_UNIT.get(next((place.unit for place in group.axes if place.unit), ""))
        guessed = group.sensor is None and bool(group.words) and by_unit not in known
        groups.append(replace(group, sensor=by_unit) if guessed else group)
    return groups


def _best(groups: list[Group]) -> dict[str, Axes]:
    axes: dict[str, Axes] = {}
    for group in sorted(groups, key=lambda group: group.rank):
        axes.setdefault(group.sensor or "", group.axes)
    return axes


def _clashing(groups: list[Group]) -> list[str]:
    """Return the titles of groups of several devices none of which is better than the others."""
    first = min((group.rank for group in groups), default=None)
    best = [group for group in groups if group.rank == first]
    return [group.axes[0].title for group in best] if len({g.device for g in best}) > 1 else []
