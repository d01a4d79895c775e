"""Units of a stream, which cannot be checked as a whole before it runs.

That of the accelerometer shows in the first second, that of the gyroscope, or a dead sensor, not at
rest. A stream is therefore checked piece by piece, by the same physics as a recording
(`sequences.inspection`). A single piece may fail because the device is thrown or dropped, so
several, with no calm one in between, are needed to refuse the stream.
"""

from __future__ import annotations

import logging

import numpy as np

from stario.fusion.imu.intervals import SAME_TIME, ImuInterval, Start
from stario.sequences.clean_samples import MAX_RATE, MIN_RATE
from stario.sequences.errors import InputError
from stario.sequences.findings import warn
from stario.sequences.inspection.checks import check_gyro, downward
from stario.sequences.inspection.gyro_axes import check_changes, force_changes
from stario.sequences.inspection.samples import check_not_dead
from stario.sequences.sequence import FloatArray
from stario.sequences.units import magnetic_advice

log = logging.getLogger(__name__)

_DEG_S = "if it is in deg/s, push np.radians(gyro)"

_START_FORCE = (5.0, 15.0)
"""Accepted mean force of the first second [m/s^2]: allows for a jump, excludes units of g."""


_SPINNING_RAD_S = 6.0
"""Rate beyond that of any walk, by which a force of 9.8 m/s^2 averages to something else."""


def check_start(start: Start, gravity: float, table: FloatArray) -> None:
    """Check the first second of a stream.

    Args:
        start: what was made of it.
        gravity: its magnitude [m/s^2].
        table: (N, 7) time, gyro, accel of the samples since.

    Raises:
        InputError: the rate is not about 50 Hz to 1 kHz, the mean force cannot be gravity, or the
            gyroscope cannot be in rad/s.
    """
    warn("stream", downward(table[:, 4:7]))
    if not MIN_RATE <= start.rate <= MAX_RATE:
        raise InputError("time", f"{start.rate:.3g} samples a second", "50 to 1000")
    low, high = _START_FORCE
    if low <= start.force <= high:
        return
    speed, size = (_typical_size(table[:, columns]) for columns in (slice(1, 4), slice(4, 7)))
    if speed > _SPINNING_RAD_S and low <= size <= high:
        raise InputError("gyro", f"rotations of {speed:.3g} in the first second", "rad/s", _DEG_S)
    if low <= speed <= high:
        fix = "gyro and accel are swapped: push(time, gyro, accel)"
        raise InputError("gyro", f"values of {speed:.3g}, as of gravity", "rad/s", fix)
    found = f"an average of {start.force:.3g} over the first second"
    fix = "give specific force in m/s^2 with gravity left in, and rates in rad/s"
    raise InputError("accel", found, f"about {gravity:.2f} m/s^2", fix)


def _typical_size(vectors: FloatArray) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))


def warn_of_field(fields: FloatArray) -> None:
    """Warn of magnetic fields (N, 3) that are the earth's in another unit than uT."""
    size = _typical_size(fields) if len(fields) else 0.0
    if advice := magnetic_advice(size):
        log.warning("magnetometer: found a field of %.3g, expected 25 to 65 uT: %s", size, advice)


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


_AXES_PIECES = 15
"""Number of pieces to which the gyroscope's axes are judged: in the first minute of 174 recordings
no others ever left less than 0.6 of the change of those given."""


class SensorCheck:
    """Checks a stream's intervals until the unit of the gyroscope is beyond doubt.

    A sensor that is dead from the beginning, or has wrong axes, shows before that.
    """

    def __init__(self) -> None:
        self._tables: list[FloatArray] = []  # time, gyro, accel (k, 7) of the piece so far
        self._changes: list[FloatArray] = []  # of each piece with all axes
        self._wrong = self._turned = 0

    def check(self, interval: ImuInterval) -> None:
        """Add the stream's next interval.

        Raises:
            InputError: the gyroscope cannot be in rad/s, or has other axes or signs than the
                accelerometer, or one sensor's values never change.
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
        try:
            check_not_dead("stream", time, gyro, accel)
            *_, doubts = check_gyro("stream", time, gyro, accel, [slice(0, len(time))], _DEG_S)
        except InputError as error:
            self._wrong += 1
            if self._wrong >= _MIN_FAILED_PIECES:
                field = "accel" if error.field.endswith("accelerometer") else "gyro"
                raise InputError(field, error.found, error.expected, error.fix) from None
        else:
            warn("stream", doubts)
            self._check_axes(time, gyro, accel)
            speed = np.percentile(np.linalg.norm(gyro, axis=1), 95)
            if speed < _DOUBTFUL_RAD_S:
                # A sensor that is dead does not get better while the device is calm.
                if _varies(gyro) and _varies(accel):
                    self._wrong = 0
                self._turned += int(speed > _TURNING_RAD_S)

    def _check_axes(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
        if len(self._changes) < _AXES_PIECES:
            self._changes.append(force_changes(time, gyro, accel))
            check_changes("gyro", self._changes)


def _varies(values: FloatArray) -> bool:
    return bool(np.diff(values, axis=0).any())
