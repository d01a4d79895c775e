"""Selection of samples where times repeat, run backward or jump ahead.

The front end of streams (`fusion.imu.front_end`) applies the same rules and thresholds as samples
arrive; here the whole recording is available.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stario.sequences.arrays import BoolArray, FloatArray

MAX_IMU_GAP = 0.1
"""Longest step [s] between IMU samples that is no gap. In use, steps up to twice as long are
bridged as well, with more noise (`fusion.imu.front_end`)."""

FAR_AHEAD = 10.0
"""A jump ahead by more than this [s] is far, and needs more samples to be confirmed."""

CONFIRMED, CONFIRMED_FAR = 2, 20
"""Samples that confirm a jump ahead in time, and a far jump or one without earlier samples."""


_OUT_OF_ORDER = 0.05
"""Share of backward steps above which the rows are out of order."""


def increasing_mask(time: FloatArray) -> BoolArray:
    """Return which of the finite times (N,) [s] to keep, so that kept times strictly increase.

    A time that is not later than all kept ones before it is dropped. So are a few that jump ahead
    of those after them: otherwise all times after a single wrong one would be dropped.
    """
    steps = np.diff(time)
    if (steps > 0.0).all():
        return np.ones(len(time), dtype=np.bool_)
    breaks = np.flatnonzero((steps < 0.0) | (steps > MAX_IMU_GAP)) + 1
    parts: list[tuple[int, int]] = []  # [start, stop) of the runs kept so far
    for start, stop in pairwise([0, *breaks.tolist(), len(time)]):
        if start == stop:
            continue
        del parts[_first_refuted(time, parts, time[start:stop]) :]
        if parts:
            newest = time[parts[-1][1] - 1]
            start += int(np.searchsorted(time[start:stop], newest, side="right"))
        if start < stop:
            parts.append((start, stop))
    kept = np.zeros(len(time), dtype=np.bool_)
    for start, stop in parts:
        kept[start:stop] = np.diff(time[start:stop], prepend=-np.inf) > 0.0
    return kept


def ahead_mask(time: FloatArray, kept: BoolArray) -> BoolArray:
    """Return which of the times (N,) [s] that were not `kept` are ahead of those after them."""
    newest = np.maximum.accumulate(np.where(kept, time, -np.inf))
    return np.asarray(time > newest)


def _first_refuted(time: FloatArray, parts: list[tuple[int, int]], following: FloatArray) -> int:
    """Return the first part that later, ordered times `following` show to be too far ahead."""
    first, samples = len(parts), 0
    for k in reversed(range(len(parts))):
        start, stop = parts[k]
        samples += stop - start
        if samples >= CONFIRMED_FAR:
            break
        before = time[parts[k - 1][1] - 1] if k else -np.inf
        jump = time[start] - before
        few = samples < (CONFIRMED_FAR if jump > FAR_AHEAD else CONFIRMED)
        if few and jump > MAX_IMU_GAP:
            later = following[np.searchsorted(following, before, side="right") :]
            if len(later) and later[0] < time[start]:
                first = k
    return first


def disorder(time: FloatArray) -> str:
    """Return how many of the times (n,) [s] go back, in words; empty if few do."""
    back = int((np.diff(time[np.isfinite(time)]) < 0.0).sum())
    many = back > _OUT_OF_ORDER * len(time)
    return f"{back} of {len(time)} times earlier than the one above" if many else ""


def hour_advice(step: float) -> str:
    """Return what to do about a step [s] of an hour to a sample or two, empty for any other."""
    whole = abs(abs(step) - 3600.0) < MAX_IMU_GAP
    return "by an hour, as local time does for daylight saving: export UTC" if whole else ""
