"""Measurements of a stream beside its samples, which wait for them in order of time."""

from __future__ import annotations

import math
from collections import deque
from typing import Generic, TypeVar

import numpy as np

from stario.sequences.sequence import MAX_SENSOR_VALUE, FloatArray

_MAX_WAITING = 1000
"""Maximum number that wait for their samples: ten seconds of a fast sensor."""

_MAX_AHEAD = 1.0
"""One further than this ahead of the newest sample [s] is dropped once an earlier one comes."""

_MAX_DELAY = 0.1
"""One older than the end of the last interval by more than this [s] is dropped as late."""

_MAX_FIELD_AGE = 0.11
"""Maximum age of the field used at an interval's end [s]; slow sensors measure ten per second."""

_MAX_REPEATED = 0.5
"""Maximum time for which a field may repeat itself [s]: slow sensors are logged several times, but
one that repeats its value for longer has stopped."""

_CALIBRATED, _SUDDEN, _MAX_PERIOD = 30.0, 4.0, 0.2
"""A field that changes by more than the first [uT] from one sample to the next, and by this factor
more than before and after, belongs to a device that has calibrated its magnetometer anew: no place
or magnet does so within a sample. The change is three sigmas of the hard iron that a calibration
leaves; there were 57 and 121 uT as people shook their phones for it (IPIN 2023, Trial01_1, 01_3).
Samples further apart than the last [s] do not tell."""

Value = TypeVar("Value")


class TimedBuffer(Generic[Value]):
    """The newest measurements of one sensor, with their times."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[float, Value]] = deque(maxlen=_MAX_WAITING)
        self._last_query = -math.inf

    def fits(self, time: float, now: float) -> bool:
        """Return whether a measurement of a time [s] may follow those that wait.

        Args:
            time: its time [s].
            now: time of the newest sample [s]. A measurement far ahead of it is kept only until an
                earlier one comes, so that one wild timestamp does not make later ones look late.
        """
        waiting = self._waiting
        while waiting and time <= (last := waiting[-1][0]) and -math.inf < now < last - _MAX_AHEAD:
            waiting.pop()
        newest = waiting[-1][0] if waiting else -math.inf
        return math.isfinite(time) and time > max(newest, self._last_query - _MAX_DELAY)

    def keep(self, time: float, value: Value) -> bool:
        """Keep a measurement; return False if too many wait, so that the first is dropped."""
        room = len(self._waiting) < _MAX_WAITING
        self._waiting.append((time, value))
        return room


class FieldBuffer(TimedBuffer[FloatArray]):
    """The newest magnetic fields of a stream."""

    def __init__(self) -> None:
        super().__init__()
        self._value: tuple[float, ...] = ()
        self._since = self._calibrated_at = -math.inf
        self._changes = math.inf, math.inf

    def add(self, time: float, field_B: FloatArray, now: float) -> bool:
        """Add a field (3,) in B [uT]; return False if it, its time or its sensor cannot be right.

        So it does if too many wait; `now` is as for `fits`.
        """
        value = tuple(field_B.tolist())
        if not (self.fits(time, now) and sum(map(abs, value)) < MAX_SENSOR_VALUE):
            return False
        if value != self._value:
            change = math.dist(value, self._value) if time - self._since < _MAX_PERIOD else math.inf
            before, last = self._changes
            if math.inf > last > max(_CALIBRATED, _SUDDEN * before, _SUDDEN * change):
                self._calibrated_at = self._since
            self._changes = last, change
            self._value, self._since = value, time
        return time - self._since <= _MAX_REPEATED and self.keep(time, field_B)

    @property
    def waiting(self) -> FloatArray:
        """The fields (N, 3) that are held."""
        return np.reshape([field for _, field in self._waiting], (-1, 3))

    def at(self, time: float) -> FloatArray | None:
        """Return the newest field (3,) up to a time [s], None if it is too old; later ones wait."""
        self._last_query = time
        while self._waiting and self._waiting[0][0] < time - _MAX_FIELD_AGE:
            self._waiting.popleft()
        return next((m_B for t, m_B in reversed(self._waiting) if t <= time), None)

    def calibrated(self, time: float) -> bool:
        """Return whether the device has calibrated its sensor anew, up to a time [s], once."""
        calibrated = -math.inf < self._calibrated_at <= time
        if calibrated:
            self._calibrated_at = -math.inf
        return calibrated
