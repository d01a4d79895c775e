"""A stream's gyroscope in deg/s, found once the device turns: at rest no unit can be told.

A recording is checked as a whole before it runs (`sequences.checks`); a stream piece by piece with
the same physics. A single piece may fail for a device that is thrown or dropped, so several, with
no calm one in between, are needed to refuse the stream.
"""

from __future__ import annotations

import numpy as np

from stario.fusion.imu.intervals import ImuInterval
from stario.sequences.errors import InputError
from stario.sequences.inspection.checks import average_force, check_gyro
from stario.sequences.sequence import FloatArray
from stario.sequences.units import GYRO_UNITS

_PIECE_S = 4.0
"""Length of a piece [s], as in the check of recordings."""

_WRONG = 3
"""Pieces that must fail, no calm one in between: two may share one fall; recordings fail none."""

_TURNED = 12
"""Pieces in which the device turns that clear the gyroscope; later failures are not its unit's."""

_TURNING_RAD_S, _DOUBTFUL_RAD_S = 1.0, 6.0
"""Exceeded for a twentieth of a piece: the first by walks, but at rest not by noise and bias, even
in deg/s; the second by hardly any walk (recorded are 4.2 at most), but by all read as deg/s."""


class GyroUnitWatch:
    """Looks at a stream's intervals until the unit of the gyroscope is beyond doubt."""

    def __init__(self) -> None:
        self._tables: list[FloatArray] = []  # time, gyro, accel (k, 7) of the piece so far
        self._wrong = self._turned = 0

    def look(self, interval: ImuInterval) -> None:
        """Take in the stream's next interval.

        Raises:
            InputError: the gyroscope cannot be in rad/s.
        """
        if interval.gap:
            self._tables = []
            return
        if self._turned >= _TURNED:
            return
        table = np.column_stack([interval.time, interval.gyro, interval.accel])
        self._tables.append(table[1:] if self._tables else table)
        if interval.stop - self._tables[0][0, 0] > _PIECE_S - 1e-6:
            piece, self._tables = np.vstack(self._tables), []
            self._judge(piece[:, 0], piece[:, 1:4], piece[:, 4:7])

    def _judge(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
        try:
            _check_piece(time, gyro, accel)
        except InputError as error:
            self._wrong += 1
            if self._wrong >= _WRONG:
                fix = "if it is in deg/s, push np.radians(gyro)"
                raise InputError("gyro", error.found, error.expected, fix) from None
        else:
            speed = np.percentile(np.linalg.norm(gyro, axis=1), 95)
            if speed < _DOUBTFUL_RAD_S:
                self._wrong = 0
                self._turned += int(speed > _TURNING_RAD_S)


def _check_piece(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
    whole = [slice(0, len(time))]
    check_gyro(
        "stream",
        gyro,
        float(np.median(np.linalg.norm(accel, axis=1))),
        average_force(time, gyro, accel, whole),
        average_force(time, gyro * GYRO_UNITS["deg/s"], accel, whole),
    )
