"""Magnetic fields on their way to the intervals that they belong to."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stario.sequences.sequence import ABSURD, FloatArray

_FIELDS = 64
"""Fields that are kept: more than come between two intervals."""

_AHEAD = 1.0
"""A field that is this much ahead of the newest sample [s] is refuted by one that is not."""

_FIELD_SECONDS = 0.11
"""How old the field at an interval's end may be [s]: slow sensors give ten in a second."""


_LATE = 0.1
"""A field older than the interval that was cut last by this [s] belongs to none that comes."""


class FieldBuffer:
    """The newest magnetic fields of a stream."""

    def __init__(self) -> None:
        self._fields: deque[tuple[float, FloatArray]] = deque(maxlen=_FIELDS)
        self._asked = -math.inf

    def add(self, time: float, field_B: FloatArray, now: float) -> bool:
        """Take in a field (3,) [uT] in B; False where its value or its time cannot be right.

        Args:
            time: its own [s].
            field_B: (3,) [uT].
            now: time of the newest sample [s]. One wild time must not make all that follow look
                late, so a field far ahead of it counts only until an earlier one comes.
        """
        while (
            self._fields
            and time <= (last := self._fields[-1][0])
            and -math.inf < now < last - _AHEAD
        ):
            self._fields.pop()
        newest = self._fields[-1][0] if self._fields else -math.inf
        newest = max(newest, self._asked - _LATE)
        right = math.isfinite(time) and time > newest and float(np.abs(field_B).sum()) < ABSURD
        if right:
            self._fields.append((time, field_B))
        return right

    def at(self, time: float) -> FloatArray | None:
        """The newest one at a time [s]; fields from ahead of it wait."""
        self._asked = time
        return next(
            (m_B for t, m_B in reversed(self._fields) if time - _FIELD_SECONDS <= t <= time), None
        )
