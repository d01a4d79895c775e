"""Output of the front end: the start, and IMU intervals with what else was measured in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stario.fusion.imu.barometer import HeightSample
from stario.fusion.values.fixes import Fix
from stario.fusion.values.state import changed
from stario.sequences.attitude.levelling import GravityStart
from stario.sequences.sequence import FloatArray

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
        missed: sigma of the velocity that the accelerometer missed there, per axis [m/s].
        missing: whether samples are missing and were interpolated from those around them.
    """

    gyro: bool = False
    accel: bool = False
    spikes: int = 0
    saturated: int = 0
    missed: float = 0.0
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
        R_NB: (3, 3) levelled attitude at the end, after its correction by gravity.
        update: whether windows begin and end at this interval's end.
        window: the window that ends here; None if there is none.
        field_B: (3,) magnetic field at its end [uT]; None if none was measured.
        height: height by the pressure of the last half second; None if there is none.
        levelled: attitude from gravity after a gap too long to be bridged, estimated as at the
            first sample; None elsewhere.
        flags: whether samples of either sensor are saturated, missing, or were spikes.
        field_anew: whether the device has calibrated its magnetometer anew.
    """

    table: FloatArray
    R_NB: FloatArray
    update: bool = False
    window: Window | None = None
    field_B: FloatArray | None = None
    height: HeightSample | None = None
    levelled: Start | None = None
    flags: Flags = NO_FLAGS
    field_anew: bool = False

    def without_window(self) -> ImuInterval:
        """Return a copy without the window, which an estimator does not need."""
        return changed(self, window=None)

    @property
    def gap(self) -> bool:
        """Whether this is a gap too long to be bridged; its samples then carry no information."""
        return self.levelled is not None

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
