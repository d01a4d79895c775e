"""Merge sensors with separate clocks into samples at the gyroscope's times.

A phone's sensors are sampled at different times and arrive in batches. Each gyroscope sample waits
for the next accelerometer sample and takes the specific force interpolated at its own time; gravity
and linear acceleration, if sent separately, are first joined in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from stario.fusion.live.payload import (
    ACCEL_RAW,
    BAROMETER,
    GRAVITY,
    GYRO,
    GYRO_RAW,
    LINEAR,
    MAG,
    ORIENTATION,
    SENSORS,
    TOTAL,
    Reading,
    Vector,
)
from stario.sequences.sequence import FloatArray
from stario.sequences.time_order import MAX_IMU_GAP

Sample = tuple[int, Vector, Vector]
"""Time [ns], angular rate [rad/s], specific force [m/s^2]."""

CHOOSING = 5 * 10**8
"""Time [ns] allowed for every sensor of a device to appear before choosing among them."""

MAX_WAIT = 5 * 10**9
"""Maximum time [ns] a sensor's samples wait for those of the other."""

_MAX_GAP = round(MAX_IMU_GAP * 1e9)
_GYROS = (GYRO, GYRO_RAW)
_ACCELS = ((TOTAL,), (LINEAR, GRAVITY), (ACCEL_RAW,))
_ASIDE = (MAG, BAROMETER)
"""Sensors whose readings keep their own times."""


class Join:
    """Interpolation of a second stream at the times of a first.

    Attributes:
        late: number of values dropped because their stream already had newer ones.
        alone: number of values of the first stream dropped for lack of values of the second.
    """

    def __init__(self) -> None:
        self._first: deque[tuple[int, Vector]] = deque()
        self._second: deque[tuple[int, Vector]] = deque()
        self._newest = [-1, -1]
        self.late = self.alone = 0

    def add(self, stream: int, time_ns: int, value: Vector) -> None:
        """Add a value to the first (0) or second (1) stream; its times must increase."""
        if time_ns <= self._newest[stream]:
            self.late += 1
            return
        self._newest[stream] = time_ns
        (self._first, self._second)[stream].append((time_ns, value))

    def ready(self) -> list[Sample]:
        """Return the samples that are complete so far, in time order."""
        complete: list[Sample] = []
        while self._first and self._second:
            time, value = self._first[0]
            while len(self._second) > 1 and self._second[1][0] <= time:
                self._second.popleft()
            if self._second[0][0] < time and len(self._second) == 1:
                break  # its next value is still to come
            self._first.popleft()
            other = self._at(time)
            if other is None:
                self.alone += 1
            else:
                complete.append((time, value, other))
        while self._first and self._newest[0] - self._first[0][0] > MAX_WAIT:
            self._first.popleft()
            self.alone += 1
        while self._second and self._newest[1] - self._second[0][0] > MAX_WAIT:
            self._second.popleft()
        return complete

    def _at(self, time: int) -> Vector | None:
        """Return the second stream's value at a time; None outside it or in a gap."""
        before, value = self._second[0]
        if before == time:
            return value
        if before > time:
            return None
        after, other = self._second[1]
        if after - before > _MAX_GAP:
            return None
        weight = (time - before) / (after - before)
        x, y, z = (a + weight * (b - a) for a, b in zip(value, other, strict=True))
        return x, y, z


class Merger:
    """Converter of a device's readings into samples, once its sensors are known.

    Attributes:
        upward: cosine between the specific force and the upward vertical of the device's own
            attitude; 0 if it sends none.
    """

    def __init__(self) -> None:
        self.upward = 0.0
        self._aside: list[Reading] = []
        self._newest = dict.fromkeys((*SENSORS, ORIENTATION), -1)
        self._aside_late = 0
        self._waiting: list[Reading] = []
        self._gyro = ""
        self._accel: tuple[str, ...] = ()
        self._join, self._gravity = Join(), Join()

    @property
    def dropped(self) -> dict[str, int]:
        """Number of readings dropped so far by reason, without zeros."""
        counts = {
            "late": self._join.late + self._gravity.late + self._aside_late,
            "without acceleration": self._join.alone,
        }
        return {reason: count for reason, count in counts.items() if count}

    @property
    def missing(self) -> str:
        """Sensor that a track needs but the device does not send; empty if none is missing."""
        if self._gyro or not self._waiting:
            return ""
        gyro, accel = self._best()
        if not gyro:
            return "gyroscope"
        return "" if accel else "total acceleration, or accelerometer with gravity"

    @property
    def silent(self) -> str:
        """Sensor of the track whose samples ended `MAX_WAIT` before the newest; empty if none."""
        end = max(self._newest.values()) - MAX_WAIT
        sensors = (self._gyro, *self._accel) if self._gyro else ()
        return next((name for name in sensors if self._newest[name] < end), "")

    def add(self, readings: Iterable[Reading]) -> list[Sample]:
        """Add readings as they arrive; return the samples they complete."""
        if not self._gyro:
            self._waiting += readings
            if not self._choose():
                return []
            readings, self._waiting = self._waiting, []
        # A batch lists one sensor after the other; it is sorted by time so that none is late.
        for reading in sorted(readings, key=lambda reading: reading.time_ns):
            self._take(reading)
        if len(self._accel) == 2:
            for time, linear, gravity in self._gravity.ready():
                x, y, z = (a + b for a, b in zip(linear, gravity, strict=True))
                self._join.add(1, time, (x, y, z))
        return self._join.ready()

    def add_places(self, places: Iterable[Reading]) -> None:
        """Add places by the satellite receiver; whoever reads the recording skips repeated ones."""
        self._aside += places

    def aside(self) -> list[Reading]:
        """Return magnetic fields, pressures and places since the last call, in time order."""
        aside, self._aside = self._aside, []
        return sorted(aside, key=lambda reading: reading.time_ns)

    def _take(self, reading: Reading) -> None:
        sensor, time, value = reading.sensor, reading.time_ns, reading.value
        if sensor in _ASIDE:
            if time > self._newest[sensor]:
                self._aside.append(reading)
            else:
                self._aside_late += 1
        if sensor == self._gyro:
            self._join.add(0, time, value)
        elif len(self._accel) == 2 and sensor in self._accel:
            self._gravity.add(self._accel.index(sensor), time, value)
        elif sensor in self._accel:
            self._join.add(1, time, value)
        self._newest[sensor] = max(time, self._newest[sensor])

    def _best(self) -> tuple[str, tuple[str, ...]]:
        """Return the best gyroscope and accelerometer of the readings so far; empty if none."""
        sensors = {reading.sensor for reading in self._waiting}
        gyro = next((name for name in _GYROS if name in sensors), "")
        return gyro, next((names for names in _ACCELS if set(names) <= sensors), ())

    def _choose(self) -> bool:
        """Choose the best sensors, once the stream is long enough to contain all of them."""
        times = [reading.time_ns for reading in self._waiting]
        if not times or max(times) - min(times) < CHOOSING:
            return False
        gyro, accel = self._best()
        if not gyro or not accel:
            newest = max(times)  # bounds memory
            self._waiting = [r for r in self._waiting if newest - r.time_ns < MAX_WAIT]
            return False
        self._gyro, self._accel = gyro, accel
        self.upward = _cosine(
            _mean(r.value for r in self._waiting if r.sensor == ORIENTATION),
            *(_mean(r.value for r in self._waiting if r.sensor == name) for name in accel),
        )
        return True


def _mean(values: Iterable[Vector]) -> FloatArray:
    table = np.array(list(values)).reshape(-1, 3)
    return table.mean(axis=0) if len(table) else np.zeros(3)


def _cosine(up: FloatArray, *forces: FloatArray) -> float:
    force = np.sum(forces, axis=0)
    return float(up @ force / max(np.linalg.norm(up) * np.linalg.norm(force), 1e-9))
