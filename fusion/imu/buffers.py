"""Buffers of a stream: the last second for the network, magnetic fields until their interval."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stario.sequences.sequence import ABSURD, FloatArray
from stario.sequences.windows import (
    WINDOW_RATE,
    WINDOW_SECONDS,
    facing,
    mean_heading,
    resample,
)


@dataclass(frozen=True, eq=False)
class Block:
    """An interval's part of a window.

    Attributes:
        imu_N: (6, n) the IMU in N.
        R_NB: (3, 3) levelled attitude at its start.
        facing_N: (2,) which way the device faces there.
        flagged: whether a sample cannot be trusted.
    """

    imu_N: NDArray[np.float32]
    R_NB: FloatArray
    facing_N: FloatArray
    flagged: bool


@dataclass(frozen=True, eq=False)
class Window:
    """The last second, as `ImuInterval` tells of it."""

    imu_N: NDArray[np.float32]
    R_NB: FloatArray
    heading: float
    flagged: bool


_TAIL_SAMPLES = 4
"""Samples kept of the interval before: half a step of the window's grid at the fastest rate."""


class WindowBuffer:
    """The last second of unbroken samples.

    Args:
        rate: intervals in a second.
    """

    def __init__(self, rate: int) -> None:
        self._grid = np.arange(round(WINDOW_RATE / rate)) / WINDOW_RATE
        self._blocks: deque[Block] = deque(maxlen=round(rate * WINDOW_SECONDS))
        self._tail: FloatArray | None = None  # time and turned IMU (k, 7) before the interval

    def clear(self) -> None:
        """No window spans what comes next."""
        self._blocks.clear()
        self._tail = None

    def add(
        self,
        time: FloatArray,
        gyro: FloatArray,
        accel: FloatArray,
        attitudes: FloatArray,
        flagged: bool,
    ) -> None:
        """Take in an interval that follows: its samples and the levelled attitudes R_NB at them."""
        rows = np.empty((len(time), 7))
        rows[:, 0] = time
        rows[:, 1:4] = (attitudes @ gyro[:, :, None])[:, :, 0]
        rows[:, 4:] = (attitudes @ accel[:, :, None])[:, :, 0]
        tail, self._tail = self._tail, rows[-_TAIL_SAMPLES - 1 : -1]
        start = float(time[0])
        # Averages reach half a step back: the tail.
        known = rows if tail is None else np.concatenate([tail, rows])
        imu_N = resample(known[:, 0], known[:, 1:], start + self._grid).astype(np.float32).T
        R_NB = attitudes[0]
        self._blocks.append(Block(imu_N, R_NB, facing(R_NB), flagged))

    def window(self) -> Window | None:
        """The second that ends with the newest interval; None before one is whole."""
        blocks = self._blocks
        if len(blocks) < (blocks.maxlen or 0):
            return None
        imu_N = np.concatenate([block.imu_N for block in blocks], axis=1)
        heading = float(mean_heading(np.array([block.facing_N for block in blocks])))
        return Window(imu_N, blocks[0].R_NB, heading, any(block.flagged for block in blocks))


_MAX_FIELDS = 64
"""Fields that are kept: more than come between two intervals."""

_MAX_AHEAD = 1.0
"""A field that is this much ahead of the newest sample [s] is refuted by one that is not."""

_MAX_FIELD_AGE = 0.11
"""How old the field at an interval's end may be [s]: slow sensors give ten in a second."""

_MAX_DELAY = 0.1
"""A field older than the interval that was cut last by this [s] belongs to none that comes."""


class FieldBuffer:
    """The newest magnetic fields of a stream."""

    def __init__(self) -> None:
        self._fields: deque[tuple[float, FloatArray]] = deque(maxlen=_MAX_FIELDS)
        self._asked = -math.inf

    def add(self, time: float, field_B: FloatArray, now: float) -> bool:
        """Take in a field (3,) [uT] in B; False where its value or its time cannot be right.

        Args:
            time: its own [s].
            field_B: (3,) [uT].
            now: time of the newest sample [s]. One wild time must not make all that follow look
                late, so a field far ahead of it counts only until an earlier one comes.
        """
        while (
            self._fields
            and time <= (last := self._fields[-1][0])
            and -math.inf < now < last - _MAX_AHEAD
        ):
            self._fields.pop()
        newest = self._fields[-1][0] if self._fields else -math.inf
        newest = max(newest, self._asked - _MAX_DELAY)
        right = math.isfinite(time) and time > newest and float(np.abs(field_B).sum()) < ABSURD
        if right:
            self._fields.append((time, field_B))
        return right

    def at(self, time: float) -> FloatArray | None:
        """The newest one at a time [s]; fields from ahead of it wait."""
        self._asked = time
        return next(
            (m_B for t, m_B in reversed(self._fields) if time - _MAX_FIELD_AGE <= t <= time), None
        )
