"""Split IMU intervals at the times of fixes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stario.fusion.changed import changed
from stario.fusion.fixes import Fix
from stario.fusion.imu.intervals import ImuInterval

_SAME_TIME = 1e-6
"""A fix within this time of an interval's start or end [s] counts as at it."""


def split_at_fixes(
    interval: ImuInterval, fixes: Sequence[Fix]
) -> list[tuple[ImuInterval | None, list[Fix]]]:
    """Split an interval at the times of its fixes; return each piece with the fixes at its end.

    Fixes at the start of the interval come first, with None as their piece.

    Args:
        interval: the interval.
        fixes: fixes with start <= time <= stop, in order.
    """
    pieces: list[tuple[ImuInterval | None, list[Fix]]] = []
    rest = interval
    for fix in fixes:
        if fix.time <= rest.start + _SAME_TIME:
            if not pieces:
                pieces.append((None, []))
        elif fix.time < rest.stop - _SAME_TIME:
            before, rest = split_at(rest, fix.time)
            pieces.append((before, []))
        else:
            break
        pieces[-1][1].append(fix)
    count = sum(len(due) for _, due in pieces)
    return [*pieces, (rest, list(fixes[count:]))]


def split_at(interval: ImuInterval, time: float) -> tuple[ImuInterval, ImuInterval]:
    """Split an interval at a time [s] inside it; the second part keeps window and update."""
    k = int(np.searchsorted(interval.time, time))
    weight = (time - interval.time[k - 1]) / (interval.time[k] - interval.time[k - 1])
    first: dict[str, Any] = {"time": np.append(interval.time[:k], time)}
    second: dict[str, Any] = {"time": np.append(time, interval.time[k:])}
    if second["time"][1] - time < 1e-9:
        second["time"] = np.append(time, interval.time[k + 1 :])
    for name in ("gyro", "accel"):
        values = getattr(interval, name)
        boundary = (1.0 - weight) * values[k - 1] + weight * values[k]
        first[name] = np.vstack([values[:k], boundary])
        second[name] = np.vstack([boundary, values[len(values) - len(second["time"]) + 1 :]])
    return changed(interval, **first, update=False, window=None, R_NB_window=None), changed(
        interval, **second
    )
