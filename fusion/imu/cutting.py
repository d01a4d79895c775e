"""IMU intervals cut in pieces at the times of fixes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stario.fusion.changed import changed
from stario.fusion.fixes import Fix
from stario.fusion.imu.intervals import ImuInterval

_SAME_TIME = 1e-6
"""Fixes this close [s] to an interval's end are taken to be at it."""


def parts(
    interval: ImuInterval, fixes: Sequence[Fix]
) -> list[tuple[ImuInterval | None, list[Fix]]]:
    """An interval cut at its fixes' times: each piece, and the fixes at that piece's end.

    Fixes at the interval's very start come first, with no piece before them.

    Args:
        interval: the interval.
        fixes: with start <= time <= stop, in order.
    """
    pieces: list[tuple[ImuInterval | None, list[Fix]]] = []
    rest = interval
    for fix in fixes:
        if fix.time <= rest.start + _SAME_TIME:
            if not pieces:
                pieces.append((None, []))
        elif fix.time < rest.stop - _SAME_TIME:
            before, rest = cut(rest, fix.time)
            pieces.append((before, []))
        else:
            break
        pieces[-1][1].append(fix)
    taken = sum(len(due) for _, due in pieces)
    return [*pieces, (rest, list(fixes[taken:]))]


def cut(interval: ImuInterval, time: float) -> tuple[ImuInterval, ImuInterval]:
    """An interval before and after a time [s] inside it; window and update stay behind it."""
    k = int(np.searchsorted(interval.time, time))
    weight = (time - interval.time[k - 1]) / (interval.time[k] - interval.time[k - 1])
    first: dict[str, Any] = {"time": np.append(interval.time[:k], time)}
    second: dict[str, Any] = {"time": np.append(time, interval.time[k:])}
    if second["time"][1] - time < 1e-9:
        second["time"] = np.append(time, interval.time[k + 1 :])
    for name in ("gyro", "accel"):
        values = getattr(interval, name)
        at = (1.0 - weight) * values[k - 1] + weight * values[k]
        first[name] = np.vstack([values[:k], at])
        second[name] = np.vstack([at, values[len(values) - len(second["time"]) + 1 :]])
    return changed(interval, **first, update=False, window=None, R_NB_window=None), changed(
        interval, **second
    )
