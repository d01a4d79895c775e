"""Output of the front end: the start, IMU intervals, and the magnetic field at their ends."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stario.fusion.fixes import Fix
from stario.fusion.state import changed
from stario.sequences.attitude.levelling import GravityStart
from stario.sequences.sequence import MAX_SENSOR_VALUE, FloatArray

Sample = tuple[float, float, float, float, float, float, float]
"""Time [s], gyroscope xyz [rad/s], specific force xyz [m/s^2]."""


@dataclass(frozen=True, eq=False)
class Start(GravityStart):
    """Start of the filter, estimated from the first second of samples, also after a gap.

    Attributes:
        time: time of the first sample [s].
        rate: sampling rate, from the median step [Hz].
    """

    time: float
    rate: float


_LOST_SECONDS = 10.0
"""Length of a gap [s] beyond which the motion before it tells nothing about that after it."""


class Flags(NamedTuple):
    """Faults in a stretch of samples.

    Attributes:
        gyro: whether a sample of the gyroscope is saturated or was a spike.
        accel: the same for the accelerometer.
        spikes: number of samples replaced.
        saturated: number of samples at the limit.
        missing: whether samples are missing and were interpolated from those around them.
    """

    gyro: bool = False
    accel: bool = False
    spikes: int = 0
    saturated: int = 0
    missing: bool = False


NO_FLAGS = Flags()
"""No faults."""


class Window(NamedTuple):
    """The network's input: a second of unbroken samples in a levelled frame N.

    Attributes:
        imu_N: (6, 200) gyroscope [rad/s] and specific force [m/s^2].
        R_NB: (3, 3) levelled attitude at its start.
        heading: heading of the device in N, averaged over it [rad].
        flagged: whether any of its samples are saturated, missing, or were spikes.
    """

    imu_N: NDArray[np.float32]
    R_NB: FloatArray
    heading: float
    flagged: bool


@dataclass(frozen=True, eq=False)
class ImuInterval:
    """IMU samples between two times of the grid.

    Attributes:
        table: (n + 1, 7) samples: time [s], gyro [rad/s] and accel [m/s^2] in B, interpolated at
            both ends, which are on the grid.
        gap: whether this is a gap too long to be bridged; its samples then carry no information.
        R_NB: (3, 3) levelled attitude at the end, after its correction by gravity.
        update: whether windows begin and end at this interval's end.
        window: the window that ends here; None if there is none.
        field_B: (3,) magnetic field at its end [uT]; None if none was measured.
        levelled: attitude from gravity after a gap, estimated as at the first sample; None
            elsewhere.
        flags: whether samples of either sensor are saturated, missing, or were spikes.
    """

    table: FloatArray
    gap: bool
    R_NB: FloatArray
    update: bool = False
    window: Window | None = None
    field_B: FloatArray | None = None
    levelled: Start | None = None
    flags: Flags = NO_FLAGS

    def without_window(self) -> ImuInterval:
        """Return a copy without the window, which an estimator does not need."""
        return changed(self, window=None)

    @property
    def lost(self) -> bool:
        """Whether this is a gap too long for the motion before it to tell anything about after."""
        return self.gap and self.duration > _LOST_SECONDS

    @property
    def time(self) -> FloatArray:
        """Sample times (n + 1,) [s]."""
        return self.table[:, 0]

    @property
    def gyro(self) -> FloatArray:
        """Gyroscope (n + 1, 3) [rad/s] in B."""
        return self.table[:, 1:4]

    @property
    def accel(self) -> FloatArray:
        """Specific force (n + 1, 3) [m/s^2] in B."""
        return self.table[:, 4:]

    @property
    def start(self) -> float:
        """Time of the first sample [s]."""
        return float(self.table[0, 0])

    @property
    def stop(self) -> float:
        """Time of the last sample [s]."""
        return float(self.table[-1, 0])

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return self.stop - self.start


SAME_TIME = 1e-6
"""Times that differ by no more than this [s] count as the same."""


def split_at_fixes(
    interval: ImuInterval, fixes: Sequence[Fix]
) -> list[tuple[ImuInterval | None, list[Fix]]]:
    """Split an interval at the times of its fixes; return each piece with the fixes at its end.

    Fixes at the start of the interval come first, with None as their piece.

    Args:
        interval: the interval.
        fixes: fixes with start <= time <= stop, in order.
    """
    pieces: list[tuple[ImuInterval | None, list[Fix]]] = []
    rest = interval
    for fix in fixes:
        if fix.time <= rest.start + SAME_TIME:
            if not pieces:
                pieces.append((None, []))
        elif fix.time < rest.stop - SAME_TIME:
            before, rest = split_at(rest, fix.time)
            pieces.append((before, []))
        else:
            break
        pieces[-1][1].append(fix)
    count = sum(len(due) for _, due in pieces)
    return [*pieces, (rest, list(fixes[count:]))]


def split_at(interval: ImuInterval, time: float) -> tuple[ImuInterval, ImuInterval]:
    """Split an interval at a time [s] inside it; the second part keeps window and update."""
    table = interval.table
    k = int(np.searchsorted(table[:, 0], time))
    boundary = interpolated_sample(table[k - 1], table[k], time)
    later = table[k:] if table[k, 0] - time >= 1e-9 else table[k + 1 :]
    before, after = np.vstack([table[:k], boundary]), np.vstack([boundary, later])
    first = changed(interval, table=before, update=False, window=None)
    return first, changed(interval, table=after)


def interpolated_sample(before: FloatArray, after: FloatArray, time: float) -> FloatArray:
    """Return the sample (7,) at a time [s] between two samples of time, gyro and accel."""
    sample = before + (time - before[0]) / (after[0] - before[0]) * (after - before)
    sample[0] = time
    return np.asarray(sample)


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
        value = tuple(field_B.tolist())
        size = sum(map(abs, value))
        if not (math.isfinite(time) and time > newest and size < MAX_SENSOR_VALUE):
            return False
        if value != self._value:
            self._value, self._since = value, time
        if time - self._since > _MAX_REPEATED:
            return False
        room = len(self._fields) < _MAX_FIELDS
        self._fields.append((time, field_B))
        return room

    @property
    def waiting(self) -> FloatArray:
        """The fields (N, 3) that are held."""
        return np.reshape([field for _, field in self._fields], (-1, 3))

    def at(self, time: float) -> FloatArray | None:
        """Return the newest field (3,) up to a time [s], None if it is too old; later ones wait."""
        self._last_query = time
        while self._fields and self._fields[0][0] < time - _MAX_FIELD_AGE:
            self._fields.popleft()
        return next((m_B for t, m_B in reversed(self._fields) if t <= time), None)
