"""Parsers for what devices send: Sensor Logger's pushes, and lines of JSON from anything else.

A push of the app Sensor Logger is a JSON object with a batch of samples of all its sensors:

    {"messageId": 7, "sessionId": "...", "deviceId": "...", "payload": [
        {"name": "gyroscope", "time": 1698501144401773000, "values": {"x": 0.1, "y": 0, "z": 0}}]}

`time` is in nanoseconds, rates in rad/s, accelerations in m/s^2. "accelerometer" excludes gravity,
which is a separate sensor, "gravity"; "totalacceleration" (Android) includes both; "magnetometer"
is in uT, the "pressure" of "barometer" in hPa (mbar), and "location" in degrees and metres. Other
sensors are skipped.

A line of any other device is one sample; gyro [rad/s], accel [m/s^2] and, optionally, mag [uT] may
share a line or have lines of their own:

    {"device": "rig", "t": 12.345, "gyro": [0.1, 0, 0], "accel": [0, 0, 9.81]}

`t_ns` (an integer) may replace `t`. A batch is accepted or refused as a whole.
"""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, groupby
from typing import Any

from stario.sequences.errors import InputError

Vector = tuple[float, ...]
"""Numbers of one sample: x, y and z of most sensors."""

MAX_ENTRIES = 50_000
"""Maximum number of samples in one push; the fastest phone takes a minute to record them."""

MAX_SPAN = 600 * 10**9
"""Maximum time [ns] between a push's first and last sample; beyond it a timestamp is wrong."""

_MIN_STEP, _FEW_SAMPLES = 100_000, 5
"""Minimum average step [ns] between that many samples of a sensor: none has 10 kHz, but times in
microseconds or a coarser unit seem to be so dense."""

BACKWARD = 5 * 10**9
"""A batch whose middle is this [ns] before the newest sample comes from a clock set back."""

_STRAY_SHARE = 0.1
"""Maximum share of a batch's readings whose times, `BACKWARD` or more from the batch's middle, are
taken to be wrong; more are a backlog."""

MAX_READING = 1e4
"""Maximum reading of any sensor in rad/s, m/s^2 or uT."""

_AS_LINES = "send lines of JSON with the content type application/x-ndjson"
_MAX_TIME_NS = 2**63
_MAX_NAME_LENGTH = 80
_NORM_TOLERANCE = 0.05

GYRO, MAG, BAROMETER = "gyroscope", "magnetometer", "barometer"
TOTAL, LINEAR, GRAVITY = "totalacceleration", "accelerometer", "gravity"
GYROS = GYRO, "gyroscopeuncalibrated"
ACCELS = (TOTAL,), (LINEAR, GRAVITY), ("accelerometeruncalibrated",)
"""Sensors that give a rate, and those that together give a specific force, the best ones first."""

_AXES = {MAG, *GYROS, *chain(*ACCELS)}
ORIENTATION = "orientation"
"""The phone's own attitude, of which only the vertical is used."""

LOCATION = "location"
"""Places by the phone's satellite receiver."""


@dataclass(frozen=True)
class Reading:
    """One sample of one sensor.

    Attributes:
        time_ns: time on the device's clock [ns].
        value: reading in rad/s, m/s^2 or uT; for an attitude, the upward unit vector in B; for the
            barometer, one number in hPa; for a place, latitude and longitude [deg], altitude [m],
            radius [m], speed [m/s] and bearing [deg], NaN where unknown.
    """

    sensor: str
    time_ns: int
    value: Vector


@dataclass(frozen=True)
class Batch:
    """Readings that arrived together from one device.

    Attributes:
        recording: the device's name for the recording; empty if it gives none.
        number: place of a push among those of its recording; -1 if it gives none.
        places: places by the satellite receiver; their times, perhaps minutes old, decide nothing.
    """

    device: str
    recording: str
    readings: list[Reading]
    number: int = -1
    places: list[Reading] = field(default_factory=list)

    @property
    def middle_ns(self) -> int:
        """Median time of a batch that is not empty [ns]."""
        return sorted(reading.time_ns for reading in self.readings)[len(self.readings) // 2]

    def credible(self) -> list[Reading]:
        """Return the readings without single ones far from the rest, which would seem newest."""
        middle, count = self.middle_ns, len(self.readings)
        near = [reading for reading in self.readings if abs(reading.time_ns - middle) < BACKWARD]
        return near if count - len(near) <= _STRAY_SHARE * count else self.readings


def parse_push(body: bytes) -> Batch:
    """Parse a push of Sensor Logger.

    Raises:
        InputError: the body does not have this form; the error names the field.
    """
    try:
        message = object_from("body", body)
    except InputError as error:  # perhaps because it is several lines
        fix = _AS_LINES if body.strip().count(b"\n") else ""
        raise InputError(error.field, error.found, error.expected, fix) from None
    payload = message.get("payload")
    if not isinstance(payload, list):
        fix = _AS_LINES if payload is None else ""
        raise InputError("payload", _describe(payload), "a list of samples", fix)
    if len(payload) > MAX_ENTRIES:
        found = f"{len(payload)} samples"
        raise InputError("payload", found, f"at most {MAX_ENTRIES}", "choose a shorter period")
    device = _name("deviceId", message.get("deviceId"))
    recording = _name("sessionId", message.get("sessionId", ""), needed=False)
    known = [
        reading
        for k, entry in enumerate(payload)
        if (reading := _pushed(f"payload[{k}]", _object(f"payload[{k}]", entry))) is not None
    ]
    readings = [reading for reading in known if reading.sensor != LOCATION]
    places = [reading for reading in known if reading.sensor == LOCATION]
    _check_times(readings)
    number = message.get("messageId")
    if not recording or type(number) is not int:
        number = -1
    return Batch(device, recording, readings, number, places)


def _check_times(readings: list[Reading]) -> None:
    """Check that the times of a push can be nanoseconds, by their span and each sensor's rate."""
    times = [reading.time_ns for reading in readings]
    if times and max(times) - min(times) > MAX_SPAN:
        found = f"times {(max(times) - min(times)) / 1e9:.3g} s apart"
        raise InputError("payload", found, f"at most {MAX_SPAN / 1e9:g} s in one push")
    for sensor in {reading.sensor for reading in readings}:
        at = [reading.time_ns for reading in readings if reading.sensor == sensor]
        if len(at) >= _FEW_SAMPLES and max(at) - min(at) < (len(at) - 1) * _MIN_STEP:
            found = f"samples of {sensor} less than {_MIN_STEP / 1e6:g} ms apart"
            fix = "send integers: times in s, ms or us seem to stand still"
            raise InputError("payload.time", found, "times in nanoseconds", fix)


def parse_lines(body: bytes, sender: str) -> list[Batch]:
    """Parse lines of JSON into a batch for each stretch of lines of one device and recording.

    Args:
        body: JSON objects, one a line.
        sender: name of the device of a line that gives none.

    Raises:
        InputError: a line does not have this form; the error names the line and the field.
    """
    lines = []
    for number, line in enumerate(body.splitlines(), 1):
        try:
            lines += [_line(line, sender)] if line.strip() else []
        except InputError as error:
            field = f"line {number}, {error.field}"
            raise InputError(field, error.found, error.expected, error.fix) from None
    return [
        Batch(device, recording, [reading for _, readings in stretch for reading in readings])
        for (device, recording), stretch in groupby(lines, key=lambda line: line[0])
    ]


def _line(line: bytes, sender: str) -> tuple[tuple[str, str], list[Reading]]:
    """Parse a line of JSON into device and recording, and readings."""
    message = object_from("line", line)
    if "t_ns" in message:
        time_ns = _nanoseconds("t_ns", message["t_ns"])
    else:
        time_ns = _nanoseconds("t", 1e9 * number_from("t", message.get("t")))
    readings = [
        Reading(sensor, time_ns, _three(key, message[key]))
        for key, sensor in (("gyro", GYRO), ("accel", TOTAL), ("mag", MAG))
        if key in message
    ]
    if not readings:
        raise InputError("line", "none of gyro, accel and mag", "at least one of them")
    device = _name("device", message.get("device", sender))
    return (device, _name("recording", message.get("recording", ""), needed=False)), readings


def object_from(where: str, text: bytes) -> Mapping[str, Any]:
    """Parse a JSON object from arbitrary bytes; an error names `where`."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise InputError("JSON", "too many levels", "an object") from None
    except ValueError as error:  # not UTF-8, not JSON, or a number of thousands of digits
        raise InputError("JSON", str(error)[:120], "valid JSON in UTF-8") from None
    return _object(where, value)


def _pushed(where: str, entry: Mapping[str, Any]) -> Reading | None:
    """Parse one sample of a push; None if its sensor, or the value of one not needed, is unused."""
    name = entry.get("name")
    if not isinstance(name, str):
        raise InputError(f"{where}.name", _describe(name), "a sensor name")
    sensor, time, values = name.lower(), entry.get("time"), entry.get("values", entry)
    if sensor in _AXES:
        time_ns = _nanoseconds(f"{where}.time", time)
        axes = _object(f"{where}.values", values)
        value = tuple(_axis(f"{where}.values.{axis}", axes.get(axis)) for axis in "xyz")
        return Reading(sensor, time_ns, value)
    with suppress(InputError):
        if sensor in _OPTIONAL:
            value = _OPTIONAL[sensor](_object("values", values))
            return Reading(sensor, _nanoseconds("time", time), value)
    return None


def _vertical(values: Mapping[str, Any]) -> Vector:
    """Return the vertical in B from the phone's attitude."""
    x, y, z, w = (number_from("q", values.get(f"q{axis}")) for axis in "xyzw")
    if abs((norm := x * x + y * y + z * z + w * w) - 1.0) > _NORM_TOLERANCE:
        raise InputError("q", f"norm {norm:.3g}", "a unit quaternion")
    return 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


def _place(values: Mapping[str, Any]) -> Vector:
    known = (number_from(name, values.get(name)) for name in ("latitude", "longitude"))
    rest = (values.get(name) for name in ("altitude", "horizontalAccuracy", "speed", "bearing"))
    return *known, *(math.nan if value is None else number_from("", value) for value in rest)


_OPTIONAL: dict[str, Callable[[Mapping[str, Any]], Vector]] = {
    ORIENTATION: _vertical,
    BAROMETER: lambda values: (number_from("pressure", values.get("pressure")),),
    LOCATION: _place,
}


def _object(where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(where, _describe(value), "an object")
    return value


def _name(where: str, value: Any, needed: bool = True) -> str:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        value = str(value)
    if not isinstance(value, str):
        raise InputError(where, _describe(value), "a name")
    # Neither the page nor a response could contain a lone surrogate or a control character.
    shown = "".join(character if character.isprintable() else " " for character in value).strip()
    if needed and not shown:
        raise InputError(where, _describe(value), "a name")
    return shown[:_MAX_NAME_LENGTH]


def _nanoseconds(where: str, value: Any) -> int:
    """Parse an integer, also given as a string of digits as in the app's JSON exports."""
    if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 20:
        value = int(value)
    if isinstance(value, float) and math.isfinite(value):
        value = round(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _MAX_TIME_NS:
        raise InputError(where, _describe(value), "a non-negative time in nanoseconds")
    return value


def _axis(where: str, value: Any) -> float:
    """Return a reading along an axis; an error names its place in the message."""
    if abs(number := number_from(where, value)) > MAX_READING:
        raise InputError(where, f"{number:.3g}", f"at most {MAX_READING:g} rad/s, m/s^2 or uT")
    return number


def _three(where: str, values: Any) -> Vector:
    if not isinstance(values, list) or len(values) != 3:
        raise InputError(where, _describe(values), "a list of three numbers")
    return tuple(_axis(f"{where}[{k}]", value) for k, value in enumerate(values))


def number_from(where: str, value: Any) -> float:
    """Return a finite number of a message; an error names `where`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(where, _describe(value), "a number")
    with suppress(OverflowError):
        if math.isfinite(number := float(value)):
            return number
    raise InputError(where, "no finite number", "a finite number")


def _describe(value: Any) -> str:
    """Return a short description of a value of any size."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    return "nothing" if value is None else reprlib.repr(value)
