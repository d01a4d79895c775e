"""Buffers of a stream: the last second for the network, and magnetic fields not yet used."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.state import changed
from stario.sequences.sequence import MAX_SENSOR_VALUE, FloatArray
from stario.sequences.windows import (
    WINDOW_RATE,
    WINDOW_SECONDS,
    facing,
    mean_heading,
    resample,
)


@dataclass(frozen=True, eq=False)
class Block:
    """One interval's part of a window.

    Attributes:
        imu_N: (6, n) gyroscope [rad/s] and specific force [m/s^2] in N.
        R_NB: (3, 3) levelled attitude at its start.
        facing_N: (2,) direction that the device faces there, as given by `facing`.
        flagged: whether it contains faulty or missing samples.
    """

    imu_N: NDArray[np.float32]
    R_NB: FloatArray
    facing_N: FloatArray
    flagged: bool


_TAIL_SAMPLES = 4
"""Samples kept from the previous interval: half a step of the window's grid at the fastest rate."""


class WindowBuffer:
    """The last second of unbroken samples.

    Args:
        rate: number of intervals per second.
    """

    def __init__(self, rate: int) -> None:
        self._grid = np.arange(round(WINDOW_RATE / rate)) / WINDOW_RATE
        self._blocks: deque[Block] = deque(maxlen=round(rate * WINDOW_SECONDS))
        self._tail: FloatArray | None = None  # time and turned IMU (k, 7) before the interval

    def clear(self) -> None:
        """Drop all samples, so that no window spans a gap."""
        self._blocks.clear()
        self._tail = None

    def add(self, interval: ImuInterval) -> None:
        """Add the samples of the next interval."""
        attitudes, flags = interval.attitudes, interval.flags
        rows = np.empty((len(interval.time), 7))
        rows[:, 0] = interval.time
        rows[:, 1:4] = (attitudes @ interval.gyro[:, :, None])[:, :, 0]
        rows[:, 4:] = (attitudes @ interval.accel[:, :, None])[:, :, 0]
        tail, self._tail = self._tail, rows[-_TAIL_SAMPLES - 1 : -1]
        # The first average reaches half a grid step back, into the tail.
        samples = rows if tail is None else np.concatenate([tail, rows])
        imu_N = resample(samples[:, 0], samples[:, 1:], interval.start + self._grid)
        R_NB = attitudes[0]
        flagged = flags.gyro or flags.accel or flags.missing
        self._blocks.append(Block(imu_N.astype(np.float32).T, R_NB, facing(R_NB), flagged))

    def with_window(self, interval: ImuInterval) -> ImuInterval:
        """Return the newest interval with the second that ends there, once that is complete."""
        blocks = self._blocks
        if len(blocks) < (blocks.maxlen or 0):
            return interval
        return changed(
            interval,
            window=np.concatenate([block.imu_N for block in blocks], axis=1),
            R_NB_window=blocks[0].R_NB,
            heading=float(mean_heading(np.array([block.facing_N for block in blocks]))),
            window_flagged=any(block.flagged for block in blocks),
        )


_MAX_FIELDS = 1000
"""Maximum number of fields that wait for their samples: ten seconds of a fast sensor."""

_MAX_AHEAD = 1.0
"""A field further than this ahead of the newest sample [s] is dropped once an earlier one comes."""

_MAX_FIELD_AGE = 0.11
"""Maximum age of the field used at an interval's end [s]; slow sensors measure ten per second."""

_MAX_DELAY = 0.1
"""A field older than the end of the last interval by more than this [s] is dropped as late."""


_MAX_REPEATED = 0.5
"""Maximum time for which a field may repeat itself [s]: slow sensors are logged several times, but
one that repeats its value for longer has stopped."""


class FieldBuffer:
    """The newest magnetic fields of a stream."""

    def __init__(self) -> None:
        self._value: tuple[float, ...] = ()
        self._since = math.inf
        self._fields: deque[tuple[float, FloatArray]] = deque(maxlen=_MAX_FIELDS)
        self._last_query = -math.inf

    def add(self, time: float, field_B: FloatArray, now: float) -> bool:
        """Add a field; return False if its value or time cannot be right, or the sensor stopped.

        It also returns False if too many fields wait, so that the first of them is dropped.

        Args:
            time: time of the field [s].
            field_B: (3,) magnetic field in B [uT].
            now: time of the newest sample [s]. A field far ahead of it is kept only until an
                earlier one comes, so that one wild timestamp does not make later fields look late.
        """
        while (
            self._fields
            and time <= (last := self._fields[-1][0])
            and -math.inf < now < last - _MAX_AHEAD
        ):
            self._fields.pop()
        newest = self._fields[-1][0] if self._fields else -math.inf
        newest = max(newest, self._last_query - _MAX_DELAY)
        size = float(np.abs(field_B).sum())
        if not (math.isfinite(time) and time > newest and size < MAX_SENSOR_VALUE):
            return False
        value = tuple(field_B.tolist())
        if value != self._value:
            self._value, self._since = value, time
        if time - self._since > _MAX_REPEATED:
            return False
        room = len(self._fields) < _MAX_FIELDS
        self._fields.append((time, field_B))
        return room

    def at(self, time: float) -> FloatArray | None:
        """Return the newest field (3,) up to a time [s], None if it is too old; later ones wait."""
        self._last_query = time
        while self._fields and self._fields[0][0] < time - _MAX_FIELD_AGE:
            self._fields.popleft()
        return next((m_B for t, m_B in reversed(self._fields) if t <= time), None)
