"""Client of a phone running phyphox, which polls its remote interface several times a second.

The app (menu: "Allow remote access") answers `/config` with the experiment's sensors and the names
of their buffers, and `/get?acc_time=12.3&accX=12.3|acc_time` with the values after 12.3 s. The
experiment must record the gyroscope and the acceleration with g: "Add experiment, simple" has both.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import urllib.request
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote, urlsplit

from stario.fusion.live.hub import Hub
from stario.fusion.live.payload import (
    BAROMETER,
    GRAVITY,
    GYRO,
    LINEAR,
    LOCATION,
    MAG,
    MAX_READING,
    TOTAL,
    Batch,
    Reading,
    object_from,
)
from stario.sequences.errors import InputError

PERIOD = 0.2
"""Interval between two requests [s]."""

_SENSORS: dict[str, tuple[str, Sequence[str]]] = {
    "gyroscope": (GYRO, "xyz"),
    "accelerometer": (TOTAL, "xyz"),
    "magnetic_field": (MAG, "xyz"),
    "linear_acceleration": (LINEAR, "xyz"),
    "gravity": (GRAVITY, "xyz"),
    "pressure": (BAROMETER, "x"),
    "location": (LOCATION, ("lat", "lon", "z", "accuracy", "v", "dir")),
}
"""Sensors and their outputs beside the time, by phyphox's names."""

_TIMEOUT = 3.0
_RETRY_SECONDS = 2.0
_LARGEST = 1e9
"""Limit of times [s] and readings; beyond it a buffer's value is invalid."""

_MAX_RESPONSE_BYTES = 16 * 1024 * 1024

_log = logging.getLogger(__name__)


class Phyphox:
    """Client of one phone; an error tells of an address that is none of HTTP."""

    def __init__(self, address: str) -> None:
        url = urlsplit(address if "//" in address else f"//{address}", scheme="http")
        if url.scheme != "http" or not url.hostname:
            raise InputError("phyphox", repr(address), "an address such as 192.168.0.7:8080")
        self.device = f"phyphox {url.netloc}"
        self._root = f"http://{url.netloc}"
        self._buffers: dict[str, tuple[str, ...]] = {}
        self._newest: dict[str, float] = {}
        self._session = ""
        self._restarts, self._measuring = 0, True

    def fetch(self) -> Batch:
        """Fetch the samples recorded since the last call.

        Raises:
            InputError: the response is not phyphox's, or the experiment lacks a sensor.
            OSError: the phone does not respond.
        """
        if not self._buffers:
            self._buffers = _buffers_of(self._get("/config"))
        response = self._get(f"/get?{'&'.join(self._query())}")
        status, buffers = response.get("status"), response.get("buffer")
        if not isinstance(status, dict) or not isinstance(buffers, dict):
            raise InputError("phyphox", "no status or no buffers", "a response of phyphox's /get")
        session = str(status.get("session", ""))
        if session != self._session:  # another experiment, with other buffers and times
            started, self._session = bool(self._session), session
            if started:
                self._buffers, self._newest = {}, {}
                return Batch(self.device, session, [])
        if self._is_forced(buffers):
            self._restart()
        known = {sensor: self._readings(sensor, buffers) for sensor in self._buffers}
        places = known.pop(LOCATION, [])
        readings = [*itertools.chain(*known.values())]
        measuring = status.get("measuring") is not False
        if measuring and not self._measuring:
            self._restarts += 1  # phyphox's time does not count a pause: the track cannot continue
        self._measuring = measuring
        if measuring and not readings and self._is_behind():
            self._restart()
        return Batch(self.device, f"{session} {self._restarts}", readings, places=places)

    def _restart(self) -> None:
        """Follow a cleared experiment, whose time restarts at 0, from its beginning."""
        self._newest, self._restarts = {}, self._restarts + 1

    def _is_forced(self, buffers: Mapping[str, Any]) -> bool:
        """Return whether whole buffers answer a request for their ends: once after a clear."""
        times = [buffers.get(self._buffers[sensor][0], {}) for sensor in self._newest]
        return any(time.get("updateMode") == "full" for time in times)

    def _is_behind(self) -> bool:
        """Return whether the phone's newest times lie before those known, after a lost answer."""
        newest = {self._buffers[sensor][0]: time for sensor, time in self._newest.items()}
        buffers = newest and self._get(f"/get?{'&'.join(map(quote, newest))}").get("buffer")
        if not isinstance(buffers, dict):
            return False
        times = [(_column(buffers, name), time) for name, time in newest.items()]
        return any(not column or column[-1] < time for column, time in times)

    def _query(self) -> list[str]:
        parts = []
        for sensor, names in self._buffers.items():
            t, *axes = map(quote, names)
            if sensor in self._newest:
                since = repr(self._newest[sensor])
                parts += [f"{t}={since}", *(f"{axis}={since}%7C{t}" for axis in axes)]
            else:
                parts += [f"{name}=full" for name in (t, *axes)]
        return parts

    def _readings(self, sensor: str, buffers: Mapping[str, Any]) -> list[Reading]:
        columns = [
            _column(buffers, name, unknown=k > 2 and sensor == LOCATION)
            for k, name in enumerate(self._buffers[sensor])
        ]
        readings = []
        for t, *value in zip(*columns, strict=False):  # one column may be a sample longer
            if t <= self._newest.get(sensor, -1.0) or max(map(abs, value)) > MAX_READING:
                continue
            self._newest[sensor] = t
            readings.append(Reading(sensor, round(1e9 * t), tuple(value)))
        return readings

    def _get(self, path: str) -> Mapping[str, Any]:
        with urllib.request.urlopen(self._root + path, timeout=_TIMEOUT) as response:
            return object_from("phyphox", response.read(_MAX_RESPONSE_BYTES))


def _buffers_of(config: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the names of the buffers of time and values by sensor from phyphox's `/config`."""
    found: dict[str, tuple[str, ...]] = {}
    for source in config.get("inputs", []):
        sensor, axes = _SENSORS.get(source.get("source"), ("", ""))
        outputs = {k: v for output in source.get("outputs", []) for k, v in output.items()}
        names = [outputs.get(key) for key in ("t", *axes)]
        if sensor and None not in names:
            found[sensor] = tuple(map(str, names))
    if GYRO not in found or not (TOTAL in found or {LINEAR, GRAVITY} <= set(found)):
        expected = "gyroscope and acceleration with g in one experiment"
        fix = "add a simple experiment with both"
        raise InputError("phyphox", ", ".join(found) or "neither", expected, fix)
    return found


async def follow(hub: Hub, phone: Phyphox) -> None:
    """Poll a phone for as long as the server runs; log each problem once and retry."""
    last_problem = ""
    while True:
        try:
            batch = await asyncio.to_thread(phone.fetch)
            await hub.take(batch)
            last_problem = ""
        except Exception as error:  # whatever a phone on a bad network answers, retry
            problem = str(error) or type(error).__name__
            if problem != last_problem:
                _log.warning("%s: %s", phone.device, problem)
                last_problem = problem
            await asyncio.sleep(_RETRY_SECONDS)
        await asyncio.sleep(PERIOD)


def _column(buffers: Mapping[str, Any], name: str, unknown: bool = False) -> list[float]:
    """Return the numbers of a buffer, up to the first invalid value or with NaN where `unknown`."""
    numbers: list[float] = []
    for value in buffers.get(name, {}).get("buffer", []):
        valid = isinstance(value, (int, float)) and abs(value) < _LARGEST  # not NaN
        if not (valid or unknown):
            break
        numbers.append(float(value) if valid else math.nan)
    return numbers
