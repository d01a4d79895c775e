"""Merge sensors with separate clocks into samples at the gyroscope's times.

A phone's sensors are sampled at different times and arrive in batches. Each gyroscope sample waits
for the next accelerometer sample and takes the specific force interpolated at its own time; so do
gravity and linear acceleration, which are added, if they are sent separately.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from stario.fusion.live.payload import ACCELS, BAROMETER, GYROS, MAG, ORIENTATION, Reading, Vector
from stario.sequences.sequence import FloatArray
from stario.sequences.time_order import MAX_IMU_GAP


class Sample(NamedTuple):
    """Time [ns], angular rate [rad/s], specific force [m/s^2]."""

    time_ns: int
    gyro: Vector
    accel: Vector


CHOOSING = 5 * 10**8
"""Time [ns] allowed for every sensor of a device to appear before choosing among them."""

MAX_WAIT = 5 * 10**9
"""Maximum time [ns] a sensor's samples wait for those of the other."""

_MAX_GAP = round(MAX_IMU_GAP * 1e9)


class Merger:
    """Converter of a device's readings into samples, once its sensors are known.

    Attributes:
        dropped: number of readings dropped so far by reason.
        upward: cosine between the specific force and the upward vertical of the device's own
            attitude; 0 if it sends none.
    """

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.upward = 0.0
        self._aside: list[Reading] = []
        self._newest: dict[str, int] = defaultdict(lambda: -1)
        self._waiting: list[Reading] = []
        self._streams: dict[str, deque[Reading]] = {}  # the gyroscope's first

    @property
    def missing(self) -> str:
        """Sensor that a track needs but the device does not send; empty if none is missing."""
        if self._streams or not self._waiting:
            return ""
        gyro, accel = self._best()
        if not gyro:
            return "gyroscope"
        return "" if accel else "total acceleration, or accelerometer with gravity"

    @property
    def silent(self) -> str:
        """Sensor of the track whose samples ended `MAX_WAIT` before the newest; empty if none."""
        end = max(self._newest.values(), default=0) - MAX_WAIT
        return next((name for name in self._streams if self._newest[name] < end), "")

    def add(self, readings: Iterable[Reading], places: Iterable[Reading] = ()) -> list[Sample]:
        """Add readings, and places by satellites, as they arrive; return the completed samples."""
        self._aside += places  # whoever reads the recording skips repeated ones
        if not self._streams:
            self._waiting += readings
            if not self._choose():
                return []
            readings, self._waiting = self._waiting, []
        # A batch lists one sensor after the other; it is sorted by time so that none is late.
        for reading in sorted(readings, key=lambda reading: reading.time_ns):
            self._take(reading)
        return [*self._complete()]

    def aside(self) -> list[Reading]:
        """Return magnetic fields, pressures and places since the last call, in time order."""
        aside, self._aside = self._aside, []
        return sorted(aside, key=lambda reading: reading.time_ns)

    def _take(self, reading: Reading) -> None:
        sensor, time = reading.sensor, reading.time_ns
        # Readings of a magnetometer and of a barometer keep their own times.
        kept = self._aside if sensor in (MAG, BAROMETER) else self._streams.get(sensor)
        if kept is not None and time > self._newest[sensor]:
            kept.append(reading)
        elif kept is not None:
            self.dropped["late"] += 1
        self._newest[sensor] = max(time, self._newest[sensor])

    def _complete(self) -> Iterator[Sample]:
        """Yield the samples that are complete so far, in time order; forget what waits too long."""
        gyro, *accel = self._streams.values()
        while gyro and all([_reaches(stream, gyro[0].time_ns) for stream in accel]):
            rate = gyro.popleft()
            forces = [_at(stream, rate.time_ns) for stream in accel]
            known = [force for force in forces if force is not None]
            if len(known) == len(accel):
                force = tuple(map(sum, zip(*known, strict=True)))
                yield Sample(rate.time_ns, rate.value, force)
            else:
                self.dropped["without acceleration"] += 1
        for sensor, stream in self._streams.items():
            while stream and self._newest[sensor] - stream[0].time_ns > MAX_WAIT:
                stream.popleft()
                if stream is gyro:
                    self.dropped["without acceleration"] += 1

    def _best(self) -> tuple[str, tuple[str, ...]]:
        """Return the best gyroscope and accelerometer of the readings so far; empty if none."""
        sensors = {reading.sensor for reading in self._waiting}
        gyro = next((name for name in GYROS if name in sensors), "")
        return gyro, next((names for names in ACCELS if set(names) <= sensors), ())

    def _choose(self) -> bool:
        """Choose the best sensors, once the stream is long enough to contain all of them."""
        newest = max((reading.time_ns for reading in self._waiting), default=0)
        if all(newest - reading.time_ns < CHOOSING for reading in self._waiting):
            return False
        gyro, accel = self._best()
        if not gyro or not accel:  # for now: this bounds memory
            self._waiting = [r for r in self._waiting if newest - r.time_ns < MAX_WAIT]
            return False
        self._streams = {name: deque() for name in (gyro, *accel)}
        up, *forces = (self._mean(name) for name in (ORIENTATION, *accel))
        force = np.sum(forces, axis=0)
        norms = float(np.linalg.norm(up) * np.linalg.norm(force))
        self.upward = float(up @ force) / max(norms, 1e-9)
        return True

    def _mean(self, sensor: str) -> FloatArray:
        values = [reading.value for reading in self._waiting if reading.sensor == sensor]
        return np.asarray(np.mean(values or [(0.0, 0.0, 0.0)], axis=0))


def _reaches(stream: deque[Reading], time: int) -> bool:
    """Return whether a stream is known at a time, after its values that lie too far before."""
    while len(stream) > 1 and stream[1].time_ns <= time:
        stream.popleft()
    return len(stream) > 1 or (len(stream) == 1 and stream[0].time_ns >= time)


def _at(stream: deque[Reading], time: int) -> Vector | None:
    """Return the value of a stream that reaches a time; None before its start or in a gap."""
    before = stream[0]
    if before.time_ns >= time:
        return before.value if before.time_ns == time else None
    after = stream[1]
    span = after.time_ns - before.time_ns
    if span > _MAX_GAP:
        return None
    weight = (time - before.time_ns) / span
    return tuple(a + weight * (b - a) for a, b in zip(before.value, after.value, strict=True))
