"""Heights from the air's pressure, averaged twice a second, and what their last seconds look like.

README.md, "Barometer". Whether one climbs shows in a line through the last seconds: stairs and
lifts change the height over seconds, a door at once. What has just changed by much is held back
until it is known which of both it was.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stario.fusion.imu.buffers import TimedBuffer
from stario.sequences.sequence import FloatArray

PRESSURE_RANGE = (300.0, 1100.0)
"""Pressures at which people walk [hPa]: 9 km above the sea, and the Dead Sea's shore."""

HEIGHT_SECONDS = 0.5
"""Time over which heights are averaged [s]."""

MIN_CLIMB_RATE = 0.15
"""Vertical speed from which a line through the last seconds means stairs or a lift [m/s]: stairs
have 0.2 to 0.4, and a phone's pressure on a level floor exceeds it in 1 % of the time (28 walks of
IPIN 2023)."""

_SPAN = 4.0
"""Length of that line [s]."""

_MIN_POINTS = 4
"""Number of heights that a line needs."""

_CLIMB_SIGMAS = 3.0
"""Sigmas of the line's slope from which it means a climb."""

_SUDDEN = 0.45
"""Change [m] against the median of the heights of `_SPAN` that is not used before it is known what
it was."""

_LONGEST_DOUBT = 3.0
"""Time [s] after which such a change without a climb is one of the air: a door, a ventilator."""

_FIRST_SCATTER, _MIN_SCATTER = 0.1, 0.02
"""Scatter of averaged heights about their line [m]: assumed at first, and the least."""

_SCATTER_COUNT = 60
"""Number of heights over which the scatter is averaged: those of half a minute."""

_CORRELATION = 4.0
"""Variance of a height's noise relative to its scatter about the line: that of phones is correlated
over a second."""


class HeightSample(NamedTuple):
    """An averaged height above the first one, by the pressure.

    Attributes:
        time: mean time of the averaged samples [s].
        height: [m].
        sigma: standard deviation of its noise [m].
        rate: vertical speed while it climbs or descends [m/s]; 0 on a floor.
        risen: on the first height of a climb, height since it began [m]; 0 otherwise.
        stepped: step of the air's pressure since the last height [m]; 0 without one.
    """

    time: float
    height: float
    sigma: float
    rate: float = 0.0
    risen: float = 0.0
    stepped: float = 0.0


def pressure_altitude(pressure_hPa: FloatArray) -> FloatArray:
    """Return altitudes (N,) in the standard atmosphere [m], 8.4 m/hPa at the sea's level.

    Differences are as much too small as the air is warmer than 15 degrees less 6.5 per kilometre:
    2 % in a room. ISO 2533.
    """
    return np.asarray(44330.77 * (1.0 - (pressure_hPa / 1013.25) ** 0.1902632))


@dataclass(frozen=True, eq=False)
class _Line:
    """A line through the last heights, and the step that fits them best."""

    slope: float
    scatter: float
    is_step: bool


class HeightBuffer(TimedBuffer[float]):
    """Pressures of a stream, as averaged heights."""

    def __init__(self) -> None:
        super().__init__()
        self._first = math.nan
        self._past: deque[tuple[float, float]] = deque()
        self._variance, self._count = _FIRST_SCATTER**2, 0
        self._doubt: tuple[float, float] | None = None  # time and height before a sudden change
        self._climbing = False

    def add(self, time: float, pressure_hPa: float, now: float) -> bool:
        """Add a pressure [hPa]; return False if its value or time cannot be right.

        Args:
            time: its time [s].
            pressure_hPa: [hPa].
            now: as for `fits`.
        """
        low, high = PRESSURE_RANGE
        right = low <= pressure_hPa <= high and self.fits(time, now)
        return right and self.keep(time, pressure_hPa)

    def at(self, stop: float) -> HeightSample | None:
        """Return the height of the half second before a time [s]; None if there is none to be used.

        Later pressures wait.
        """
        self._last_query, taken = stop, []
        while self._waiting and self._waiting[0][0] <= stop:
            taken.append(self._waiting.popleft())
        taken = [each for each in taken if each[0] > stop - HEIGHT_SECONDS]
        if not taken:
            return None
        times, pressures = np.array(taken).T
        altitude, time = float(pressure_altitude(pressures).mean()), float(times.mean())
        if math.isnan(self._first):
            self._first = altitude
        return self._judged(time, altitude - self._first)

    def _judged(self, time: float, height: float) -> HeightSample | None:
        usual = float(np.median([h for _, h in self._past])) if self._past else height
        self._past.append((time, height))
        while self._past[0][0] < time - _SPAN - 0.5 * HEIGHT_SECONDS:
            self._past.popleft()
        line = _line(np.array(self._past))
        climbs = line is not None and self._is_climb(line)
        doubt, began, climbed = self._doubt, self._past[0], self._climbing
        self._doubt, self._climbing = None, climbs
        if climbs:
            assert line is not None
            risen = 0.0 if climbed else height - (doubt or began)[1]
            return HeightSample(time, height, self._sigma, line.slope, risen=risen)
        if doubt is None and abs(height - usual) > _SUDDEN and not climbed:
            doubt = time, usual
        if doubt is not None and time - doubt[0] < _LONGEST_DOUBT:
            self._doubt = doubt
            return None
        if doubt is not None:
            return HeightSample(time, height, self._sigma, stepped=height - doubt[1])
        if line is not None:
            self._learn(line.scatter)
        return HeightSample(time, height, self._sigma)

    @property
    def _sigma(self) -> float:
        return math.sqrt(_CORRELATION * self._variance)

    def _is_climb(self, line: _Line) -> bool:
        # Over n heights at equal steps the slope's sigma is the mean's times sqrt(12) / span.
        sigma = math.sqrt(12.0 * _CORRELATION * self._variance / len(self._past)) / _SPAN
        least = max(MIN_CLIMB_RATE, _CLIMB_SIGMAS * sigma)
        return abs(line.slope) > least and not line.is_step

    def _learn(self, scatter: float) -> None:
        self._count = min(self._count + 1, _SCATTER_COUNT)
        change = min(scatter * scatter, 9.0 * self._variance) - self._variance
        self._variance = max(self._variance + change / self._count, _MIN_SCATTER**2)


def _line(past: FloatArray) -> _Line | None:
    """Fit a line and a step to heights (n, 2) of time and height; None if they are too few."""
    n = len(past)
    if n < _MIN_POINTS:
        return None
    x, y = (past - past.mean(axis=0)).T
    slope = float(x @ y / (x @ x))
    about_line = float(np.square(y - slope * x).sum())
    # Between mean m1 of the first k and m2 of the others: k m1^2 + (n - k) m2^2 is explained.
    k, total = np.arange(1, n), np.cumsum(y)[:-1]
    explained = float((total**2 / k + total**2 / (n - k)).max())
    is_step = float(y @ y) - explained < about_line
    return _Line(slope, math.sqrt(about_line / (n - 2)), is_step)
