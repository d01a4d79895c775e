"""Heights from the air's pressure, averaged twice a second, and what their last seconds look like.

README.md, "Barometer". Whether one climbs shows in a line through the last seconds: stairs and
lifts change the height over seconds, a door at once. What has just changed by much is held back
until it is known which of both it was.
"""

from __future__ import annotations

import math
from collections import deque
from operator import itemgetter
from statistics import median
from typing import NamedTuple

import numpy as np

from stario.fusion.imu.buffers import TimedBuffer
from stario.sequences.sequence import FloatArray
from stario.sequences.units import pressure_altitude

PRESSURE_RANGE = (300.0, 1100.0)
"""Pressures at which people walk [hPa]: 9 km above the sea, and the Dead Sea's shore."""

HEIGHT_SECONDS = 0.5
"""Time over which heights are averaged [s]."""

FASTEST_LIFT = 10.0
"""Vertical speed [m/s] that only the lifts of towers exceed: what rises faster is no height."""

MIN_CLIMB_RATE = 0.15
"""Vertical speed from which a line through the last seconds means stairs or a lift [m/s]: stairs
have 0.2 to 0.4, and a phone's pressure on a level floor exceeds it in 1 % of the time (28 walks of
IPIN 2023)."""

CLIMB_DELAY = 4.0
"""Length of that line [s], and so the longest time before a climb is known to be one."""

SILENT_SECONDS = CLIMB_DELAY + HEIGHT_SECONDS
"""Time without heights, longer than any doubt, in which nobody knows whether one climbed [s]."""

_MIN_POINTS = 4
"""Number of heights that a line needs."""

_CLIMB_SIGMAS = 3.0
"""Sigmas of the line's slope from which it means a climb."""

UNKNOWN_RATE = 1e-3
"""Vertical speed that stands for one that is not known [m/s], as where there is no pressure for
seconds: heights yield, lengths do not."""

_STILL_CLIMBING = 0.1
"""Vertical speed below which a climb has ended [m/s]."""

_SUDDEN = 0.45
"""Change [m] against the last seconds' median that is not used before it is known what it was."""

_LONGEST_DOUBT = 3.0
"""Time [s] after which it must be known."""

_LIFT_ACCELERATION = 1.5
"""Acceleration that no passenger lift exceeds [m/s^2]."""

_NO_DOOR, _STILL_MOVING = 1.2, 0.1
"""Change [m] that is a lift's and no door's, if each of the last three half seconds has moved by
this share of it: a step falls into two averages at most."""

_RESOLUTIONS = (1.0, 0.1, 0.01)
"""Steps in which pressures are rounded [hPa]: 8 m, 0.8 m and 8 cm of height."""

_EXACT = 1e-4
"""Distance from a multiple within which a pressure is one [hPa]: phones log floats of 32 bits,
which are exact to 3e-5."""

_MAX_REPEATED, _REPEATED_PER_STEP, _MANY = 3.0, 1000.0, 4
"""Time for which that many equal pressures may come in a row [s], and per step of a rounded one
[s/hPa]: real ones repeat for at most 2.1 s, and the coarser, the longer the air takes to a step."""

_FIRST_SCATTER, _MIN_SCATTER = 0.1, 0.02
"""Scatter of averaged heights about their line [m]: assumed at first, and the least."""

_SCATTER_COUNT = 60
"""Number of heights over which the scatter is averaged: those of half a minute."""

_CORRELATION = 4.0
"""Variance of a height's noise relative to its scatter about the line: that of phones is correlated
over a second."""

_STEP_SHARE = 0.025
"""Share of averages in which the air steps: a door every 20 s."""


def is_step(difference: float, variance: float) -> bool:
    """Return whether a difference of heights [m] is more likely a step of the air than noise.

    Args:
        difference: to what is expected without a step.
        variance: that of the difference without a step [m^2].
    """
    nis = difference * difference / variance
    # Likelihoods with variances v and v + d^2, in logarithms.
    gain = 0.5 * (nis - nis / (1.0 + nis) - math.log1p(nis))
    return gain > -math.log(_STEP_SHARE)


class HeightSample(NamedTuple):
    """An averaged height above the first one, by the pressure.

    Attributes:
        time: mean time of the averaged samples [s].
        height: [m].
        sigma: standard deviation of its noise [m].
        rate: vertical speed while it climbs or descends [m/s]; 0 on a floor, `UNKNOWN_RATE` if
            there are too few or too coarse heights to tell.
        risen: change [m] that was not known to be a climb before; 0 otherwise.
        stepped: step of the air's pressure since the last height [m]; 0 without one.
    """

    time: float
    height: float
    sigma: float
    rate: float = 0.0
    risen: float = 0.0
    stepped: float = 0.0


class _Line(NamedTuple):
    """A line through the last heights."""

    slope: float
    """[m/s]."""
    scatter: float
    """Standard deviation about it [m]."""
    step_ratio: float
    """Squared residuals about the best step, relative to those about the line."""


class HeightBuffer(TimedBuffer[float]):
    """Pressures of a stream, as averaged heights."""

    def __init__(self) -> None:
        super().__init__()
        self._first = math.nan
        self._past: deque[tuple[float, float]] = deque()
        self._variance, self._count = _FIRST_SCATTER**2, 0
        self._doubt: tuple[float, float] | None = None  # time and height before a sudden change
        self._climbing = False
        self._pressure, self._since, self._equal = math.nan, math.nan, 0
        self._resolution = 0  # index; beyond the last one it is finer than those
        self._averages = 0  # equal ones in a row
        self._heard, self._silence = math.nan, (0.0, 0.0)

    def add(self, time: float, pressure_hPa: float, now: float) -> bool:
        """Add a pressure [hPa]; return False if it, its time or its sensor cannot be right.

        So it does if too many wait; `now` is as for `fits`.
        """
        low, high = PRESSURE_RANGE
        if not (low <= pressure_hPa <= high and self.fits(time, now)):
            return False
        if pressure_hPa != self._pressure:
            self._pressure, self._since, self._equal = pressure_hPa, time, 0
            while self._step and abs(math.remainder(pressure_hPa, self._step)) > _EXACT:
                self._resolution += 1
        self._equal += 1
        longest = max(_MAX_REPEATED, _REPEATED_PER_STEP * self._step)
        held = self._equal >= _MANY and time - self._since > longest
        return not held and self.keep(time, pressure_hPa)

    @property
    def silence(self) -> tuple[float, float]:
        """Start and length [s] of the longest time without a usable pressure, if there are any."""
        return self._silence if self._equal else (0.0, 0.0)

    def at(self, stop: float) -> HeightSample | None:
        """Return the height of the half second before a time [s]; None if there is none to be used.

        Later pressures wait.
        """
        self._last_query, taken = stop, []
        while self._waiting and self._waiting[0][0] <= stop:
            taken.append(self._waiting.popleft())
        taken = [each for each in taken if each[0] > stop - HEIGHT_SECONDS]
        if not taken:
            self._heard = stop if math.isnan(self._heard) else self._heard
            self._silence = max(self._silence, (self._heard, stop - self._heard), key=itemgetter(1))
            return None
        self._heard = stop
        times, pressures = np.array(taken).T
        altitude, time = float(pressure_altitude(pressures).mean()), float(times.mean())
        if math.isnan(self._first):
            self._first = altitude
        height = altitude - self._first
        same = bool(self._past) and height == self._past[-1][1]
        self._averages = self._averages + 1 if same else 1
        if same and not self._coarse:  # noise never repeats: the sensor has stopped
            return None
        if self._past:
            before, from_height = self._past[-1]
            if abs(height - from_height) > FASTEST_LIFT * (time - before):
                return None
        return self._judged(time, height)

    def _judged(self, time: float, height: float) -> HeightSample | None:
        if self._past and time - self._past[-1][0] > CLIMB_DELAY:  # who knows what lies between
            self._past.clear()
            self._doubt = None
        usual = median(h for _, h in self._recent(time - HEIGHT_SECONDS)) if self._past else height
        self._past.append((time, height))
        while self._past[0][0] < time - CLIMB_DELAY - _LONGEST_DOUBT:
            self._past.popleft()
        recent = self._recent(time)
        line = _line(np.array(recent))
        climbed, doubt = self._climbing, self._doubt
        self._climbing = line is not None and (
            self._is_climb(line, len(recent), climbed) or self._is_lift(height - usual)
        )
        self._doubt = None
        known = line is not None and self._rounding < _NO_DOOR
        sample = HeightSample(time, height, self._sigma, 0.0 if known else UNKNOWN_RATE)
        if line is not None and self._climbing:
            sample = sample._replace(rate=line.slope)
            return sample if climbed else self._explained(sample, *(doubt or recent[0]))
        sudden = max(_SUDDEN, 1.5 * self._rounding)
        if doubt is None and abs(height - usual) > sudden and not climbed:
            doubt = time, usual
        if doubt is not None and time - doubt[0] < _LONGEST_DOUBT:
            self._doubt = doubt
            return None
        if doubt is not None:
            found = self._explained(sample, *doubt)
            # Rounding hides which it was: it may be each.
            each = self._coarse and not found.stepped
            return found._replace(stepped=found.risen) if each else found
        if line is not None:
            self._learn(line.scatter)
        return sample

    def _recent(self, time: float) -> list[tuple[float, float]]:
        """Return the heights of the seconds before a time [s] in which a climb shows."""
        since = time - CLIMB_DELAY - 0.5 * HEIGHT_SECONDS
        return [each for each in self._past if each[0] >= since] or [self._past[-1]]

    def _explained(self, sample: HeightSample, since: float, before: float) -> HeightSample:
        """Return a sample with its change since a height as the air's step and what was climbed."""
        late = [each for each in self._past if each[0] > since - _MIN_POINTS * HEIGHT_SECONDS]
        step = _air_step(np.array(late), sample.sigma**2)
        return sample._replace(risen=sample.height - before - step, stepped=step)

    @property
    def _step(self) -> float:
        """Step in which all pressures so far are rounded [hPa]; 0 for a fine one."""
        return (*_RESOLUTIONS, 0.0)[self._resolution]

    @property
    def _rounding(self) -> float:
        """That step as a height [m]."""
        ends = np.array([self._pressure - self._step, self._pressure])
        return float(-np.diff(pressure_altitude(ends))[0])

    @property
    def _coarse(self) -> bool:
        """Whether heights are rounded by more than a phone's noise."""
        return self._rounding**2 / 12.0 > _FIRST_SCATTER**2

    @property
    def _sigma(self) -> float:
        # n equal averages share one error of rounding: sum of 1 / (k (k + 1)) up to n is below 1.
        rounded = self._rounding**2 / 12.0 * self._averages * (self._averages + 1)
        return math.sqrt(_CORRELATION * self._variance + rounded)

    def _is_climb(self, line: _Line, count: int, climbed: bool) -> bool:
        if climbed:
            return abs(line.slope) > _STILL_CLIMBING
        # Over heights at equal steps the slope's sigma is the mean's times sqrt(12) / span.
        variance = _CORRELATION * self._variance + self._rounding**2 / 12.0
        sigma = math.sqrt(12.0 * variance / count) / CLIMB_DELAY
        least = max(MIN_CLIMB_RATE, _CLIMB_SIGMAS * sigma)
        return abs(line.slope) > least and line.step_ratio > 1.0

    def _is_lift(self, change: float) -> bool:
        time, height = np.array(self._past)[-_MIN_POINTS:].T
        moved = np.diff(height) * math.copysign(1.0, change)
        if abs(change) < _NO_DOOR or moved.min() < _STILL_MOVING * abs(change):
            return False
        beyond = np.abs(np.diff(moved)).max() - _LIFT_ACCELERATION * np.diff(time).max() ** 2
        return not is_step(max(0.0, float(beyond)), 6.0 * self._variance + self._rounding**2 / 2.0)

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
    ratio = (float(y @ y) - explained) / max(about_line, 1e-9)
    return _Line(slope, math.sqrt(about_line / (n - 2)), ratio)


def _air_step(past: FloatArray, variance: float) -> float:
    """Return the step [m] by which the air changed within heights (n, 2); 0 if none is likely.

    Who begins to climb changes the speed, a door the height: heights are fitted with a change of
    speed anywhere, and with a step anywhere beside it. The average into which a step falls is free.
    """
    n = len(past)
    if n < 2 * _MIN_POINTS:
        return 0.0
    t, y = (past - past[0]).T
    at, bend = (k.ravel() for k in np.meshgrid(np.arange(2, n - 2), np.arange(n - 2)))
    k = np.arange(n)
    columns = [np.ones((len(at), n)), np.maximum(t - t[bend, None], 0.0), k == at[:, None]]
    columns.append(k > at[:, None])
    q, r = np.linalg.qr(np.stack(columns, axis=2))
    along = np.einsum("mnk,n->mk", q, y)
    left = y @ y - np.square(along).sum(axis=1)
    best = int(left.argmin())
    if left[best] > n * variance:  # a puff of air, for instance
        return 0.0
    step = float(along[best, 3] / r[best, 3, 3])
    without = (left + np.square(along[:, 3]))[at == at[best]].min()
    return step if is_step(step, step**2 * variance / max(without - left[best], 1e-12)) else 0.0
