"""Units of a stream, which cannot be checked as a whole before it runs.

That of the accelerometer shows in the first second, that of the gyroscope, or a dead sensor, not at
rest. A stream is therefore checked piece by piece, by the same physics as a recording
(`sequences.inspection.checks`). A single piece may fail because the device is thrown or dropped, so
several, with no calm one in between, are needed to refuse the stream.
"""

from __future__ import annotations

import numpy as np

from stario.fusion.imu.intervals import SAME_TIME, ImuInterval, Start
from stario.sequences.clean_samples import MAX_RATE, MIN_RATE
from stario.sequences.errors import InputError
from stario.sequences.findings import warn
from stario.sequences.inspection.checks import check_gyro
from stario.sequences.inspection.constant_values import check_not_dead
from stario.sequences.sequence import FloatArray

_START_FORCE = (5.0, 15.0)
"""Accepted mean force of the first second [m/s^2]: allows for a jump, excludes units of g."""


def check_start(start: Start, gravity: float) -> None:
    """Check the first second of a stream.

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


class SensorCheck:
    """Checks a stream's intervals until the unit of the gyroscope is beyond doubt.

    A sensor that is dead from the beginning shows before that.
    """

    def __init__(self) -> None:
        self._tables: list[FloatArray] = []  # time, gyro, accel (k, 7) of the piece so far
        self._wrong = self._turned = 0

    def check(self, interval: ImuInterval) -> None:
        """Add the stream's next interval.

        Raises:
            InputError: the gyroscope cannot be in rad/s, or one sensor's values never change.
        """
        if interval.gap:
            self._tables = []
            return
        if self._turned >= _MIN_TURNING_PIECES:
            return
        table = interval.table
        self._tables.append(table[1:] if self._tables else table)
        if interval.stop - self._tables[0][0, 0] > _PIECE_SECONDS - SAME_TIME:
            piece, self._tables = np.vstack(self._tables), []
            self._check_piece(piece[:, 0], piece[:, 1:4], piece[:, 4:7])

    def _check_piece(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
        remedy = "is the sensor connected?"
        try:
            check_not_dead("stream", time, gyro, accel)
            remedy = "if it is in deg/s, push np.radians(gyro)"
            *_, doubts = check_gyro("stream", time, gyro, accel, [slice(0, len(time))])
        except InputError as error:
            self._wrong += 1
            if self._wrong >= _MIN_FAILED_PIECES:
                field = "accel" if error.field.endswith("accelerometer") else "gyro"
                raise InputError(field, error.found, error.expected, remedy) from None
        else:
            warn("stream", doubts)
            speed = np.percentile(np.linalg.norm(gyro, axis=1), 95)
            if speed < _DOUBTFUL_RAD_S:
                self._wrong = 0
                self._turned += int(speed > _TURNING_RAD_S)
