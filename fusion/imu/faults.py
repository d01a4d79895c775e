"""Faults of samples: a clock set back, stopped sensors, spikes and saturation.

Clock: single late samples are dropped, and so is a burst in the wrong order. Late samples that
advance among themselves for seconds come from another clock, and how much time has passed between
the two is unknown. If they catch up with the newest sample before, the clock was set back by less:
the motion meanwhile is unknown, a gap. What was logged twice repeats that newest sample.

Stopped sensors: no real sensor repeats its numbers for long, since noise changes the last digits.
Six numbers that repeat for a tenth of a second come from sensors that have stopped, unless the
device may be at rest. One sensor alone: loggers repeat samples of a slow one, and a coarse one at
rest measures the same numbers for minutes. So its values must repeat for half a second in which the
other one shows motion that they rule out, by the rules of `sequences.inspection.samples`; or those
of one axis of the gyroscope, below any limit, while both others vary by more than digits hide. From
then on it counts as stopped until its values change. Samples of a stopped sensor are dropped, so
that they are treated as a gap. (An axis of the accelerometer that stops at a usual force costs less
than the heading that is lost in a gap.) A sensor whose values have never changed is dead (`units`);
an axis may be constant from the beginning, as in data simulated in a plane. Three zeros of an
accelerometer are no measurement at all, not even of a free fall, which has noise.

Outliers: spikes are replaced (`sequences.clean_samples`). Saturation shows as values of a moving
axis that repeat exactly and more than once at the largest magnitude measured so far, beside steps
that are too large for a peak rounded to the axis's digits; two that are equal by chance, at a
magnitude soon exceeded, do not count. What the sensor missed is unknown, so these are only flagged.
A phone that falls 1 m stops within 10 to 20 ms at 30 to 60 g, of which its accelerometer measures 8
or 16: the force that it misses is of its limit's size. What recurs, as in a runner's pocket with a
limit of 2 g, the filter learns from its innovations; what happens once must be said at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from operator import ne
from typing import Literal

import numpy as np

from stario.fusion.imu.intervals import NO_FLAGS, Flags, Sample
from stario.sequences.clean_samples import MIN_RATE, replace_spikes
from stario.sequences.errors import InputError
from stario.sequences.inspection.samples import (
    contradicts_constant_accel,
    contradicts_constant_gyro,
)
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.time_order import MAX_IMU_GAP

Stopped = Literal["both", "gyroscope", "accelerometer"]
"""What has stopped: both sensors, or one alone."""

SET_BACK_SECONDS = 5.0
"""Late samples that advance for this long in a row [s] come from a clock that was set back; batches
that arrive twice or in the wrong order are shorter."""


class ClockSetBackError(InputError):
    """The clock of the samples was set back.

    Attributes:
        by: amount [s].
    """

    def __init__(self, by: float) -> None:
        self.by = by
        super().__init__(
            "time",
            f"a clock set back by {by:.3g} s",
            "a clock that advances",
            "what follows is treated as a new recording",
        )


class ClockSetBackDetector:
    """Detects late samples that come from a clock that was set back."""

    def __init__(self) -> None:
        self._first = self._last = 0.0
        self._running = False

    def on_time(self, time: float) -> float:
        """Note that a sample at `time` [s] was not late.

        Returns:
            Time of the first of the late samples that it continues [s]; infinity if there are none.
        """
        continued = self._running and time - self._last <= MAX_IMU_GAP
        self._running = False
        return self._first if continued else math.inf

    def logged_twice(self) -> None:
        """Note that the late samples repeat earlier ones."""
        self._running = False

    def note_late(self, time: float, newest: float) -> float:
        """Note that a sample at `time` [s] came after one at `newest` [s].

        Returns:
            Duration of the late samples in a row so far [s].

        Raises:
            ClockSetBackError: the late samples come from another clock.
        """
        if not self._running or time < self._last:
            self._first = time
        self._running, self._last = True, time
        if time - self._first >= SET_BACK_SECONDS:
            raise ClockSetBackError(newest - self._first)
        return time - self._first


Moves = Callable[[FloatArray, FloatArray, FloatArray], bool]
"""Whether times (n,), rates (n, 3) and forces (n, 3) show motion."""

_FROZEN_SECONDS = 0.1
"""Maximum time that all values may repeat [s]; loggers repeat slow samples for a few hundredths."""

_FROZEN_RATE, _FROZEN_FORCE = 0.05, 1.5
"""A coarse sensor at rest repeats values as well: its rate is below the first [rad/s], its force
within the second of gravity [m/s^2]."""

_ALONE_SECONDS = 0.5
"""Time that the values of one sensor alone repeat [s] before the other one is asked for motion."""

_ALONE_SAMPLES = round(MIN_RATE * _ALONE_SECONDS)
"""Minimum number of samples in that time: a gap shows no motion."""


_TURNS, _LEAST_LIMIT = 0.06, 3.0
"""Standard deviation of the other two rates [rad/s] above which no digits of a gyroscope hide the
third one (three of a degree per second), and the least rate that may be its limit [rad/s]."""


def _contradicts_constant_rate(
    axis: int, time: FloatArray, gyro: FloatArray, accel: FloatArray
) -> bool:
    """Return whether both other rates vary, as in no rotation with a constant third one."""
    others = np.delete(gyro, axis, axis=1).std(axis=0)
    return bool(others.min() > _TURNS and abs(gyro[0, axis]) < _LEAST_LIMIT)


_PARTS: list[tuple[Stopped, slice, Moves]] = [
    ("gyroscope", slice(1, 4), contradicts_constant_gyro),
    ("accelerometer", slice(4, 7), contradicts_constant_accel),
    *(("gyroscope", slice(k + 1, k + 2), partial(_contradicts_constant_rate, k)) for k in range(3)),
]
"""What may stop alone, its columns, and whether others show motion that its values rule out."""


class FrozenSensorDetector:
    """Detects sensors that have stopped and repeat their last values.

    Args:
        gravity: magnitude [m/s^2].
    """

    def __init__(self, gravity: float) -> None:
        self._gravity = gravity
        self._last: Sample = (math.nan,) * 7  # before the first: no value equals NaN
        self._since = math.inf  # time of the first of equal samples [s]
        self._unclear = True  # whether a part repeats its values, or has never changed them
        self._parts = [_Repetition() for _ in _PARTS]

    def stopped(self, sample: Sample) -> Stopped | None:
        """Return what has stopped according to a sample (time, gyro, accel); None if nothing."""
        last, self._last = self._last, sample
        accel = self._parts[1]
        if accel.varied and not any(sample[4:]):
            return "accelerometer" if any(sample[1:4]) else "both"
        # Most samples end here: comparing the numbers is the cheapest proof.
        if not self._unclear and all(map(ne, sample, last)):
            self._since = sample[0]
            return None
        return self._judged(last, sample)

    def _judged(self, last: Sample, sample: Sample) -> Stopped | None:
        if sample[1:] != last[1:]:
            self._since = math.inf if math.isnan(last[0]) else sample[0]
        elif sample[0] - self._since > _FROZEN_SECONDS and not self._looks_at_rest():
            return "both"
        self._unclear, found = False, None
        # All of them, whatever the first says: each has to know when its values change.
        for part, (sensor, columns, moves) in zip(self._parts, _PARTS, strict=True):
            if same := sample[columns] == last[columns]:
                part.add(last, sample, moves)
            else:
                part.restart(last)
            self._unclear |= same or not part.varied
            if part.stopped:
                found = found or sensor
        return found

    def _looks_at_rest(self) -> bool:
        gyro, accel = self._last[1:4], self._last[4:]
        off = abs(math.hypot(*accel) - self._gravity)
        return math.hypot(*gyro) < _FROZEN_RATE and off < _FROZEN_FORCE


class _Repetition:
    """Samples in which a sensor, or one axis of it, repeats its values.

    Attributes:
        varied: whether its values have ever changed.
        stopped: whether others have shown motion that its values rule out.
    """

    def __init__(self) -> None:
        self.varied = self.stopped = False
        self._samples: list[Sample] = []  # since others were last asked

    def restart(self, last: Sample) -> None:
        """Note that the values differ from those of the sample before, if there is one."""
        self.varied, self.stopped = not math.isnan(last[0]), False
        if self._samples:
            self._samples = []

    def add(self, last: Sample, sample: Sample, moves: Moves) -> None:
        """Add a sample that repeats the values of the last one; ask others for motion."""
        if self.stopped or not self.varied:
            return
        if sample[0] < last[0]:  # a late sample, or the one before was ahead of its time
            self._samples = []
        samples = self._samples
        if not samples or sample[0] != last[0]:
            samples.append(sample)
        if len(samples) >= _ALONE_SAMPLES and sample[0] - samples[0][0] >= _ALONE_SECONDS:
            table = np.array(samples)
            self._samples = [sample]
            self.stopped = moves(table[:, 0], table[:, 1:4], table[:, 4:7])


_MOVING_RANGE = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])
_LARGE_VALUE = np.array([3.0, 3.0, 3.0, 15.0, 15.0, 15.0])
"""An axis within this range and size [rad/s], [m/s^2] may repeat itself: coarse digits at rest."""

_COARSEST = np.array([0.02, 0.02, 0.02, 0.15, 0.15, 0.15])
"""Digit of an axis until a smaller one has shown [rad/s], [m/s^2]: a degree per second, and 8 bits
of 2 g."""

_ROUNDED_STEP = 5.0
"""Largest step beside a peak that is rounded to equal values, in digits: n of them lie on a
parabola that falls by 4 / n digits in the next step; rounding adds one, noise two."""

_MIN_REPEATS = 2.0
"""Minimum number of repetitions at the same limit that cannot be chance."""

_MISSED = 2.0
"""Sigma of the force beyond an accelerometer's limit, as a multiple of that limit."""

_RECENT_SECONDS = 60.0
"""Time for which an impact counts as recent [s]: each has the less weight the more there were."""

_NO_AXES = np.zeros(6)


class OutlierDetector:
    """Detects outliers in the samples of one stream, interval by interval."""

    def __init__(self) -> None:
        self.largest = np.zeros(6)
        self._digits = _COARSEST  # smallest step of each axis so far
        self._repeats = np.zeros(6)  # of each axis at its current largest magnitude
        self._impacts = 0.0  # recent ones, each weighted by its age
        self._time = -math.inf

    def detect(self, table: FloatArray) -> Flags:
        """Replace spikes in place and return the faults.

        Args:
            table: (n, 7) samples: time, gyroscope, accelerometer; the first was checked before.
        """
        values = table[:, 1:]
        steps = values[1:] - values[:-1]
        spikes = replace_spikes(values, first=False).sum(axis=0)
        largest = np.maximum(self.largest, np.abs(values).max(axis=0))
        self._repeats = np.where(largest > self.largest, 0.0, self._repeats)
        self.largest = largest
        saturated = _NO_AXES
        if not steps.all():
            saturated = self._count_saturated(values, np.abs(steps))
        bad = (spikes + saturated) > 0
        if not bad.any():
            return NO_FLAGS
        return Flags(
            bool(bad[:3].any()),
            bool(bad[3:].any()),
            int(spikes.max()),
            int(saturated.max()),
            self._missed(table[:, 0], saturated[3:]),
        )

    def _missed(self, time: FloatArray, saturated: FloatArray) -> float:
        """Return the sigma of the velocity missed [m/s], of axes with samples at a limit (3,)."""
        if not saturated.any():
            return 0.0
        seconds = (saturated + (saturated > 0.0)) * np.diff(time).mean()
        recent = self._impacts * math.exp((self._time - time[-1]) / _RECENT_SECONDS)
        self._impacts, self._time = recent + 1.0, float(time[-1])
        return float((_MISSED * self.largest[3:] * seconds).max() / (1.0 + recent))

    def _count_saturated(self, values: FloatArray, steps: FloatArray) -> FloatArray:
        """Return the number of samples per axis (6,) that repeat at the axis's limit.

        The steps (n - 1, 6) are those before spikes were replaced, which digits do not explain; nor
        those from the first sample, which may be interpolated.
        """
        shown = np.where(steps[1:] > 0.0, steps[1:], np.inf).min(axis=0, initial=np.inf)
        self._digits = np.minimum(self._digits, shown)
        at_limit: BoolArray = np.abs(values) >= self.largest
        moving = (np.ptp(values, axis=0) > _MOVING_RANGE) | (self.largest > _LARGE_VALUE)
        count = ((values[1:] == values[:-1]) & at_limit[1:] & moving).sum(axis=0)
        beside = np.where(at_limit[1:] | at_limit[:-1], steps, 0.0).max(axis=0)
        self._repeats = self._repeats + np.where(beside > _ROUNDED_STEP * self._digits, count, 0)
        return np.asarray(np.where(self._repeats >= _MIN_REPEATS, count, 0.0))
