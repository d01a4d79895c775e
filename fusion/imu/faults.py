"""Faults of samples: a clock set back, spikes and saturation, a gyroscope in deg/s.

Clock: single late samples are dropped, and so is a burst in the wrong order. Late samples that
advance among themselves for seconds come from another clock, and how much time has passed between
the two is unknown.

Outliers: a spike is one sample that differs from both its neighbours by more than a carried device
can cause; it is replaced by their mean. Saturation shows as values of a moving axis that repeat
exactly and more than once at the largest magnitude measured so far; two that are equal by chance,
at a magnitude soon exceeded, do not count. What the sensor missed is unknown, so these are only
flagged.

Units of a stream: that of the accelerometer shows in the first second, that of the gyroscope not at
rest. A recording is checked as a whole before it runs (`sequences.inspection.checks`), a stream
piece by piece by the same physics. A single piece may fail because the device is thrown or dropped,
so several, with no calm one in between, are needed to refuse the stream.
"""

from __future__ import annotations

import numpy as np

from stario.fusion.imu.intervals import NO_FLAGS, Flags, ImuInterval, Start
from stario.sequences.errors import InputError
from stario.sequences.inspection.checks import check_gyro
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.windows import MAX_RATE, MIN_RATE

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

    def on_time(self) -> None:
        """Note that a sample was not late."""
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


SPIKE = np.array([12.0, 12.0, 12.0, 60.0, 60.0, 60.0])
"""A sample that differs from both neighbours by more than this is a spike [rad/s], [m/s^2]; heel
strikes stay below half of it at 50 Hz."""

_MOVING_RANGE = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])
_LARGE_VALUE = np.array([3.0, 3.0, 3.0, 15.0, 15.0, 15.0])
"""An axis within this range and size [rad/s], [m/s^2] may repeat itself: coarse digits at rest."""

_MIN_REPEATS = 2.0
"""Minimum number of repetitions at the same limit that cannot be chance."""

_NO_AXES = np.zeros(6)


class OutlierDetector:
    """Detects outliers in the samples of one stream, interval by interval."""

    def __init__(self) -> None:
        self.largest = np.zeros(6)
        self._repeats = np.zeros(6)  # of each axis at its current largest magnitude

    def detect(self, table: FloatArray) -> Flags:
        """Replace spikes in place and return the faults.

        Args:
            table: (n, 7) samples: time, gyroscope, accelerometer; the first was checked before.
        """
        values = table[:, 1:]
        steps = values[1:] - values[:-1]
        candidates = np.abs(steps).max(axis=0) > SPIKE
        spikes = self._replace_spikes(values) if candidates.any() else _NO_AXES
        largest = np.maximum(self.largest, np.abs(values).max(axis=0))
        self._repeats = np.where(largest > self.largest, 0.0, self._repeats)
        self.largest = largest
        saturated = _NO_AXES
        if not steps.all():
            saturated = self._count_saturated(values)
        bad = (spikes + saturated) > 0
        if not bad.any():
            return NO_FLAGS
        return Flags(
            bool(bad[:3].any()), bool(bad[3:].any()), int(spikes.max()), int(saturated.max())
        )

    @staticmethod
    def _replace_spikes(values: FloatArray) -> FloatArray:
        """Replace spikes by the mean of their neighbours; return their number per axis (6,)."""
        found = np.zeros(6)
        n = len(values)
        for k in range(1, n):
            before = values[k - 1]
            # The last sample has no successor yet: it is compared with the two before it.
            after = values[k + 1] if k + 1 < n else values[max(k - 2, 0)]
            off = np.minimum(np.abs(values[k] - before), np.abs(values[k] - after)) > SPIKE
            if off.any():
                mean = 0.5 * (before + after) if k + 1 < n else before
                values[k, off] = mean[off]
                found += off
        return found

    def _count_saturated(self, values: FloatArray) -> FloatArray:
        """Return the number of samples per axis (6,) that repeat at the axis's limit."""
        size = np.abs(values)
        moving = (np.ptp(values, axis=0) > _MOVING_RANGE) | (self.largest > _LARGE_VALUE)
        repeated: BoolArray = (values[1:] == values[:-1]) & (size[1:] >= self.largest) & moving
        count = repeated.sum(axis=0)
        self._repeats = self._repeats + count
        return np.asarray(np.where(self._repeats >= _MIN_REPEATS, count, 0.0))


_START_FORCE = (5.0, 15.0)
"""Accepted mean force of the first second [m/s^2]: allows for a jump, excludes units of g."""


def check_start(start: Start, gravity: float) -> None:
    """Check the first second of a stream, which cannot be checked as a whole.

    Raises:
        InputError: the rate is not about 50 Hz to 1 kHz, or the mean force cannot be gravity.
    """
    if not MIN_RATE <= start.rate <= MAX_RATE:
        raise InputError("time", f"{start.rate:.3g} samples a second", "50 to 1000")
    if not _START_FORCE[0] <= start.force <= _START_FORCE[1]:
        raise InputError(
            "accel",
            f"an average of {start.force:.3g} over the first second",
            f"about {gravity:.2f} m/s^2",
            "give specific force in m/s^2 with gravity left in, and rates in rad/s",
        )


_PIECE_SECONDS = 4.0
"""Length of a piece [s], as in the check of recordings."""

_MIN_FAILED_PIECES = 3
"""Number of failed pieces, with no calm one in between, that refuse a stream: a single fall may
cause two, and no recording has failed any."""

_MIN_TURNING_PIECES = 12
"""Number of pieces with turns after which later failures are not attributed to the unit."""

_TURNING_RAD_S, _DOUBTFUL_RAD_S = 1.0, 6.0
"""Rates exceeded for a twentieth of a piece: the first by walks, but not by noise and bias at rest,
even in deg/s; the second by hardly any walk (maximum recorded 4.2), but by all given in deg/s."""


class GyroUnitCheck:
    """Checks a stream's intervals until the unit of the gyroscope is beyond doubt."""

    def __init__(self) -> None:
        self._tables: list[FloatArray] = []  # time, gyro, accel (k, 7) of the piece so far
        self._wrong = self._turned = 0

    def check(self, interval: ImuInterval) -> None:
        """Add the stream's next interval.

        Raises:
            InputError: the gyroscope cannot be in rad/s.
        """
        if interval.gap:
            self._tables = []
            return
        if self._turned >= _MIN_TURNING_PIECES:
            return
        table = np.column_stack([interval.time, interval.gyro, interval.accel])
        self._tables.append(table[1:] if self._tables else table)
        if interval.stop - self._tables[0][0, 0] > _PIECE_SECONDS - 1e-6:
            piece, self._tables = np.vstack(self._tables), []
            self._check_piece(piece[:, 0], piece[:, 1:4], piece[:, 4:7])

    def _check_piece(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
        try:
            check_gyro("stream", time, gyro, accel, [slice(0, len(time))])
        except InputError as error:
            self._wrong += 1
            if self._wrong >= _MIN_FAILED_PIECES:
                remedy = "if it is in deg/s, push np.radians(gyro)"
                raise InputError("gyro", error.found, error.expected, remedy) from None
        else:
            speed = np.percentile(np.linalg.norm(gyro, axis=1), 95)
            if speed < _DOUBTFUL_RAD_S:
                self._wrong = 0
                self._turned += int(speed > _TURNING_RAD_S)
