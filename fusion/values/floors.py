"""Floors of a building, found from the heights of a track.

Where the height changes for seconds, one takes stairs or a lift; between, one is on a floor, or on
a landing. Floors are as far apart as fits all changes best, 2.5 to 5 m; they count from that of the
start. Only changes count, so that a height that drifts with the weather over an hour does no harm.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from stario.sequences.sequence import FloatArray

How = Literal["stairs", "lift"]

_RATE = 0.12
"""Vertical speed [m/s], over `_OVER` seconds, from which the height changes."""

_OVER = 4
"""Time over which the vertical speed is taken [s]."""

_LEAST = 0.8
"""Least change of height [m]: a few steps."""

_LANDING_SECONDS = 4.0
"""A shorter stay between two changes of one direction is a landing [s]; longer ones are landings if
their height fits no floor."""

_LEVEL_SECONDS = 8
"""Time over which the height before and after a change is taken [s]."""

_SPACINGS = np.arange(2.5, 5.01, 0.05)
"""Possible distances of floors [m]."""

_USUAL_SPACING, _LOWER, _HIGHER = 3.0, 0.2, 0.5
"""Usual distance of floors, and its sigmas downward (a room has 2.4 m at least) and upward [m]."""

_HEIGHT_ERROR = 0.4
"""Scale of errors of a change [m], with heavy tails: doors."""

_OFF_FLOOR = 0.3
"""Share of the floors' distance by which a change may differ from a whole number of them."""

_STANDING = 0.3
"""Horizontal speed [m/s] below which a change of floor is by lift."""


class FloorChange(NamedTuple):
    """A way from one floor to another; floors count from that of the start.

    Attributes:
        start: time at which it begins [s].
        stop: time at which it ends [s].
        before: floor before.
        after: floor after.
        climb: change of height [m].
        how: by stairs, or by lift, in which one stands.
    """

    start: float
    stop: float
    before: int
    after: int
    climb: float
    how: How

    def __str__(self) -> str:
        floors = f"floor {self.before} to {self.after}"
        return f"{floors} by {self.how}, {self.start:.0f} to {self.stop:.0f} s"


class _Change(NamedTuple):
    """A change of height between the seconds `start` and `stop`, by `climb` [m]."""

    start: int
    stop: int
    climb: float


def floor_changes(
    time: FloatArray, height: FloatArray, speed: FloatArray
) -> tuple[list[FloorChange], float]:
    """Return the changes of floor of a track, and the distance of the floors [m].

    Args:
        time: (N,) [s].
        height: (N,) [m].
        speed: (N,) horizontal speed [m/s].

    Returns:
        No changes, and a distance of zero, if the track stays on its floor.
    """
    seconds = np.arange(time[0], time[-1], 1.0)
    h, v = (np.interp(seconds, time, values) for values in (height, speed))
    changes = _changes(h)
    spacing = _spacing(changes)
    # A landing is no floor: join what it separates, beginning with the one that fits worst.
    while len(changes) > 1 and (worst := _worst(changes, spacing)) is not None:
        changes = _joined(changes, worst, h)
        spacing = _spacing(changes)
    found: list[FloorChange] = []
    floor = 0
    for change in changes:
        by = round(change.climb / spacing)
        if by:
            start, stop = float(seconds[change.start]), float(seconds[change.stop])
            how: How = "lift" if _stands(change, h, v) else "stairs"
            found.append(FloorChange(start, stop, floor, floor + by, change.climb, how))
            floor += by
    return found, spacing if found else 0.0


def floor_at(changes: Sequence[FloorChange], time: float) -> int | None:
    """Return the floor at a time [s]; None between floors."""
    floor = 0
    for change in changes:
        if time < change.start:
            break
        if time <= change.stop:
            return None
        floor = change.after
    return floor


def _changes(h: FloatArray) -> list[_Change]:
    """Return the changes of heights (N,), one per second, that are more than a few steps."""
    if len(h) <= _OVER:
        return []
    half = _OVER // 2
    rate = (h[_OVER:] - h[:-_OVER]) / _OVER
    sign = np.concatenate([np.zeros(half), np.where(np.abs(rate) > _RATE, np.sign(rate), 0.0)])
    runs: list[_Change] = []
    for start in np.flatnonzero(np.diff(sign, prepend=0.0) * (sign != 0.0)).tolist():
        stop = start
        while stop < len(sign) and sign[stop] == sign[start]:
            stop += 1
        if runs and start - runs[-1].stop < _LANDING_SECONDS and runs[-1].climb * sign[start] > 0.0:
            start = runs.pop().start
        runs.append(_change(start, min(stop, len(h) - 1), h))
    return [run for run in runs if abs(run.climb) > _LEAST]


def _change(start: int, stop: int, h: FloatArray) -> _Change:
    before, after = h[max(0, start - _LEVEL_SECONDS) : start + 1], h[stop : stop + _LEVEL_SECONDS]
    return _Change(start, stop, float(np.median(after) - np.median(before)))


def _joined(changes: list[_Change], k: int, h: FloatArray) -> list[_Change]:
    """Return the changes with the k-th and its nearest neighbour as one."""
    gaps = {
        n: changes[n + 1].start - changes[n].stop for n in (k - 1, k) if 0 <= n < len(changes) - 1
    }
    n = min(gaps, key=gaps.__getitem__)
    joined = _change(changes[n].start, changes[n + 1].stop, h)
    return [*changes[:n], joined, *changes[n + 2 :]]


def _spacing(changes: Sequence[_Change]) -> float:
    """Return the distance of floors that fits the changes best [m]."""
    climbs = np.array([change.climb for change in changes])
    off = climbs[:, None] - np.round(climbs[:, None] / _SPACINGS) * _SPACINGS
    cost = 2.0 * np.log1p(np.square(off / _HEIGHT_ERROR)).sum(axis=0)
    unusual = _SPACINGS - _USUAL_SPACING
    cost += np.square(unusual / np.where(unusual < 0.0, _LOWER, _HIGHER))
    return float(_SPACINGS[np.argmin(cost)])


def _worst(changes: Sequence[_Change], spacing: float) -> int | None:
    """Return which part of a way from floor to floor fits worst; None if there is none."""
    floors = np.array([change.climb for change in changes]) / spacing
    off = np.where(np.abs(floors) < 1.0, np.abs(floors - np.round(floors)), 0.0)
    worst = int(np.argmax(off))
    return worst if off[worst] > _OFF_FLOOR else None


def _stands(change: _Change, h: FloatArray, v: FloatArray) -> bool:
    """Return whether one stands while the height changes."""
    rows = slice(change.start, change.stop + 1)
    climbing = np.abs(np.gradient(h[rows])) > _RATE
    return bool(np.median(v[rows][climbing] if climbing.any() else v[rows]) < _STANDING)
