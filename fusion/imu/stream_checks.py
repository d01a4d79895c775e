"""Faults that only a running stream shows: a clock set back, a frozen sensor, gyro in deg/s.

Clock: single late samples are dropped, and so is a burst in the wrong order. Late samples that
advance among themselves for seconds come from another clock, and how much time has passed between
the two is unknown.

Frozen sensor: no real sensor measures the same six numbers for long, since its noise changes the
last digits. One that does has stopped, and its samples are treated as a gap. Values that have never
changed are left to the checks of a stream's first second; they may be simulated without noise.

Unit of the gyroscope: it cannot be determined at rest. A recording is checked as a whole before it
runs (`sequences.inspection.checks`), a stream piece by piece by the same physics. A single piece
may fail because the device is thrown or dropped, so several, with no calm one in between, are
needed to refuse the stream.
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.imu.intervals import ImuInterval
from stario.sequences.errors import InputError
from stario.sequences.inspection.checks import check_gyro
from stario.sequences.sequence import FloatArray

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


_FROZEN_SECONDS = 0.1
"""Maximum time that values may repeat [s]; loggers repeat slow samples for a few hundredths."""

_FROZEN_RATE, _FROZEN_FORCE = 0.05, 1.5
"""A coarse sensor at rest repeats values as well: its rate is below the first [rad/s], its force
within the second of gravity [m/s^2]."""


class FrozenSensorDetector:
    """Detects a sensor that has stopped and repeats its last values.

    Args:
        gravity: magnitude [m/s^2].
    """

    def __init__(self, gravity: float) -> None:
        self._gravity = gravity
        self._values: tuple[float, ...] = ()
        self._since = math.inf
        self._changed = False

    def is_frozen(self, sample: tuple[float, ...]) -> bool:
        """Return whether a sample (time, gyro, accel) has repeated its values for too long."""
        time, values = sample[0], sample[1:]
        if values != self._values:
            self._changed = bool(self._values)
            self._values, self._since = values, time
            return False
        return self._changed and time - self._since > _FROZEN_SECONDS and not self._looks_at_rest()

    def _looks_at_rest(self) -> bool:
        gyro, accel = self._values[:3], self._values[3:]
        off = abs(math.hypot(*accel) - self._gravity)
        return math.hypot(*gyro) < _FROZEN_RATE and off < _FROZEN_FORCE


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
