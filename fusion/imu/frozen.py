"""Frozen sensors: no real sensor repeats its numbers for long, since noise changes the last digits.

Values that have never changed are left to the checks of a stream's first second; they may be
simulated without noise.

Both at once: six numbers that repeat for a tenth of a second come from sensors that have stopped,
unless the device may be at rest.

One alone: loggers repeat samples of a slow sensor, and a coarse one at rest measures the same
numbers for minutes. So the values of one sensor must repeat for half a second in which the other
one shows motion that they rule out, by the rules of `sequences.inspection.stuck`. From then on the
sensor counts as stopped until its values change.

Samples of a stopped sensor are dropped, so that they are treated as a gap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from stario.sequences.inspection.stuck import shaken, tilting
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import MIN_RATE

Sample = tuple[float, ...]
"""Time [s], gyroscope xyz [rad/s], specific force xyz [m/s^2]."""

Stopped = Literal["both", "gyroscope", "accelerometer"]
"""What has stopped: both sensors, or one alone."""

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

_NEVER: Sample = (math.nan,) * 7
"""Sample before the first: no value equals NaN."""


class FrozenSensorDetector:
    """Detects sensors that have stopped and repeat their last values.

    Args:
        gravity: magnitude [m/s^2].
    """

    def __init__(self, gravity: float) -> None:
        self._gravity = gravity
        self._last = _NEVER
        self._since = math.inf  # time of the first of equal samples [s]
        self._unclear = True  # whether a sensor repeats its values, or has never changed them
        self._gyro, self._accel = _Repetition(), _Repetition()

    def stopped(self, sample: Sample) -> Stopped | None:
        """Return what has stopped according to a sample (time, gyro, accel); None if nothing."""
        last, self._last = self._last, sample
        # Nearly all samples end here: comparing two numbers is the cheapest proof.
        if sample[1] != last[1] and sample[4] != last[4] and not self._unclear:
            self._since = sample[0]
            return None
        return self._judged(last, sample)

    def _judged(self, last: Sample, sample: Sample) -> Stopped | None:
        same_gyro, same_accel = sample[1:4] == last[1:4], sample[4:] == last[4:]
        if not (same_gyro and same_accel):
            self._since = math.inf if math.isnan(last[0]) else sample[0]
        elif sample[0] - self._since > _FROZEN_SECONDS and not self._looks_at_rest():
            return "both"
        gyro, accel = self._gyro, self._accel
        # Both, whatever the first says: each has to know when its values change.
        if same_gyro:
            gyro.add(last, sample, shaken)
        else:
            gyro.restart(last)
        if same_accel:
            accel.add(last, sample, tilting)
        else:
            accel.restart(last)
        self._unclear = same_gyro or same_accel or not (gyro.varied and accel.varied)
        return "gyroscope" if gyro.stopped else "accelerometer" if accel.stopped else None

    def _looks_at_rest(self) -> bool:
        gyro, accel = self._last[1:4], self._last[4:]
        off = abs(math.hypot(*accel) - self._gravity)
        return math.hypot(*gyro) < _FROZEN_RATE and off < _FROZEN_FORCE


class _Repetition:
    """Samples in which one sensor repeats its values.

    Attributes:
        varied: whether its values have ever changed.
        stopped: whether the other sensor has shown motion that its values rule out.
    """

    def __init__(self) -> None:
        self.varied = self.stopped = False
        self._samples: list[Sample] = []  # since the other sensor was last asked

    def restart(self, last: Sample) -> None:
        """Note that the sensor's values differ from those of the sample before, if there is one."""
        self.varied, self.stopped = not math.isnan(last[0]), False
        if self._samples:
            self._samples = []

    def add(self, last: Sample, sample: Sample, moves: Moves) -> None:
        """Add a sample that repeats the values of the one before.

        Args:
            last: sample before.
            sample: newest sample.
            moves: whether samples show motion that the sensor's values rule out.
        """
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
