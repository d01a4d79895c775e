"""Sensor, axis and unit of a file or a column, determined by its name.

Apps spell the same things in many ways (`TotalAcceleration.csv`, `gyr_walk1.txt`, `magneticFieldX`,
`ACCELEROMETER X (m/s²)`, `gFx`). A name is split into words at case changes and at non-letters,
which are then looked up, so that order, case and surrounding characters do not matter.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from stario.sequences.units import ACCEL_UNITS, GYRO_UNITS, MAGNETIC_UNITS, TIME_UNITS, unit_named

Sensor = Literal["accel", "gyro", "mag", "gravity", "linear", "attitude"]

_WORD = re.compile(r"[A-Z]{2,}(?![a-z])|[A-Z]?[a-z]+|[A-Z]|\d+|[^\W\d_]+")
_G_FORCE = re.compile(r"(?<![a-z])g[-_ ]?f(orce)?(?=[\W_xyz]|$)", flags=re.IGNORECASE)
_WITH_G = re.compile(r"\bwith[-_ ]g\b", flags=re.IGNORECASE)
_WITHOUT_G = re.compile(r"\bwithout[-_ ]g\b", flags=re.IGNORECASE)
_ANG_VEL = re.compile(r"(?<![a-z])ang[-_ ]?vel(?![a-z])", flags=re.IGNORECASE)
_GLUED = re.compile(r"(?P<stem>[a-z]*?)(?P<axis>[xyz])")


@dataclass(frozen=True)
class SensorKind:
    """What tells a sensor, and what its values can be.

    Attributes:
        beginnings: beginnings of words that name it.
        words: whole words that do.
        units: its units by name, with their factors to the first.
        limit: largest value of any such sensor, in deg/s for gyroscopes.
    """

    beginnings: tuple[str, ...]
    words: tuple[str, ...] = ()
    units: Mapping[str, float] = field(default_factory=dict)
    limit: float = math.inf


SENSORS: dict[Sensor, SensorKind] = {
    "linear": SensorKind(("lin", "user", "free"), (), ACCEL_UNITS, 2e3),
    "gravity": SensorKind(("grav",), (), ACCEL_UNITS, 2e3),
    "gyro": SensorKind(("gyr", "giro", "angular", "omega"), ("g", "w"), GYRO_UNITS, 1e4),
    "mag": SensorKind(("mag",), ("m", "b"), MAGNETIC_UNITS, 1e5),
    "accel": SensorKind(("acc", "aceler", "beschleunig"), ("a", "gf", "force"), ACCEL_UNITS, 2e3),
    "attitude": SensorKind(("quat", "orient", "attitude", "rotation", "game"), ("rv", "ori")),
}
"""The sensors of phones, in the order in which words are looked up."""

_VARIANTS = ("total", "uncal", "calibrated", "field", "vector", "rate", "measurement")
_NOT_SAMPLES = {
    *("bias", "drift", "offset", "calib", "calibration", "accuracy", "std", "variance"),
    *("meta", "metadata", "down", "step", "steps", "estimated"),
}
_TIME = {"t", "time", "times", "timestamp", "timestamps", "seconds", "elapsed", "millis", "nanos"}
_TIME |= {"ts", "datetime", "epoch", "epoc", "uptime", "zeit", "tiempo", "temps", "tempo"}
_NO_TIME = {"date", "zone", "timezone", "txt", "gps", "location", "utc", "format"}
_UNIT_WORDS = {
    **dict.fromkeys(("ns", "nano", "nanos", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("us", "micro", "micros", "microseconds"), "us"),
    **dict.fromkeys(("ms", "milli", "millis", "msec", "milliseconds"), "ms"),
    **dict.fromkeys(("s", "sec", "secs", "seconds"), "s"),
}
XSENS_CLOCK = "sampletimefine"
"""Clock of Xsens, whose unit `clocks.time_unit` determines."""

_BRACKETS = re.compile(r"[\[(]\s*([^\])]*?)\s*[\])]")
_NUMBER = re.compile(r"\((\d+)\)")
_INDEX = re.compile(r"\[([012])\]\s*$")
_UNIT_WORD = re.compile(
    r"[\s_.,-]+(m[/_ ]?s\^?2|m/s²|mps2|m/s/s|rad[/_ ]?s|radps|deg[/_ ]?s|°/s|m?dps|m?g|[unmµμ]t)"
    r"(?=[\s_.,-]|$)",
    flags=re.IGNORECASE,
)
"""A unit that is a word of a column's name: `acc_x_g`, `Gyroscope X deg/s`, `gyro_dps_x`."""


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, without text in brackets but with numbers there.

    The number of a copy, `Gyroscope (1).csv`, tells recordings apart.
    """
    plain = _G_FORCE.sub("gf ", _BRACKETS.sub(" ", _NUMBER.sub(r" \1 ", name)))
    plain = _ANG_VEL.sub("angular", plain)
    plain = _WITHOUT_G.sub(" linear ", _WITH_G.sub(" ", plain)).replace("MetaWear", "Metawear")
    return [word.lower() for word in _WORD.findall(plain)]


def unit_of(name: str) -> str:
    """Return the unit of an axis, in brackets or a word of its name; empty without one."""
    named = _with_axis(name)
    return _bracketed_unit(named) or _without_unit(named)[1]


def _bracketed_unit(name: str) -> str:
    named = (match[1] for match in _BRACKETS.finditer(name) if not match[1].isdecimal())
    return unit_named(next(named, ""))  # not the number of a device: `IMU(0):gyroX`


def _without_unit(name: str) -> tuple[str, str]:
    """Return an axis's name without the word that is its unit, and the unit; else (name, "").

    A `g` is one only next to the name of a sensor: `acc_x_g`, but not `imu_g_x` of a gyroscope.
    """
    match = _UNIT_WORD.search(name)
    if match is None:
        return name, ""
    rest, unit = name[: match.start()] + name[match.end() :], unit_named(match[1])
    axis = _plain_axis_of(rest)
    if unit in ("g", "mg") and (axis is None or sensor_of(axis[1]) in (None, "gyro")):
        return name, ""
    return rest, unit


def _with_axis(name: str) -> str:
    """Return a name whose index is replaced by the axis: `gyro_rad[0]` becomes `gyro_rad_x`."""
    return _INDEX.sub(lambda match: "_" + "xyz"[int(match[1])], name)


def sensor_of(words: Iterable[str]) -> Sensor | None:
    """Return the one sensor that words name; None if they name none, several or no samples."""
    words = list(words)
    if set(words) & _NOT_SAMPLES:
        return None
    # A single letter names a sensor only if no word does: in `Shimmer_A_Gyro_X` it does not.
    sensors = _sensors(word for word in words if len(word) > 1) or _sensors(words)
    if "linear" in sensors:  # linear acceleration, user acceleration
        return "linear" if sensors <= {"linear", "accel"} else None
    if sensors == {"gyro", "attitude"} or (sensors == {"attitude"} and "rate" in words):
        return "gyro"  # gyro rotation, rotation rate
    return next(iter(sensors)) if len(sensors) == 1 else None


def _sensors(words: Iterable[str]) -> set[Sensor]:
    return {sensor for word in words if (sensor := _sensor(word)) is not None}


def _sensor(word: str) -> Sensor | None:
    for sensor, kind in SENSORS.items():
        if word.startswith(kind.beginnings) or word in kind.words:
            return sensor
    return None


def is_sensor_word(word: str) -> bool:
    """Return whether a word names a sensor or one of its variants, rather than a recording."""
    return _sensor(word) is not None or word.startswith(_VARIANTS)


def without_sensor(stem: str) -> str:
    """Remove the words of sensors from a file's name: `Eight_gyr` becomes `Eight`."""
    kept = _WORD.sub(lambda match: "" if is_sensor_word(match[0].lower()) else match[0], stem)
    return re.sub(r"[_\W]*$|^[_\W]*", "", re.sub(r"([_\W])[_\W]+", r"\1", kept))


def is_uncalibrated(words: Iterable[str]) -> bool:
    """Return whether words name a sensor's raw variant."""
    return any(word.startswith(("uncal", "uncomp", "raw")) for word in words)


def axis_of(name: str) -> tuple[str, tuple[str, ...]] | None:
    """Return a column's axis and its other words; None if it is not an axis of samples."""
    named = _with_axis(name)
    axis = _plain_axis_of(_without_unit(named)[0])
    if named != name and axis is not None and sensor_of(axis[1]) is None:
        return None  # an element of some other array
    return axis


def _plain_axis_of(name: str) -> tuple[str, tuple[str, ...]] | None:
    words = words_of(name)
    if set(words) & _NOT_SAMPLES:
        return None
    axes = [word for word in words if word in ("x", "y", "z")]
    if len(axes) == 1:
        return axes[0], tuple(word for word in words if word != axes[0])
    match = _GLUED.fullmatch(words[-1]) if words and not axes else None
    if match is None or (match["stem"] and _sensor(match["stem"]) is None):
        return None
    return match["axis"], (*words[:-1], match["stem"])


def bias_axis_of(name: str) -> str | None:
    """Return the axis of a column with a raw sensor's bias; None for other columns."""
    words = words_of(name)
    axes = [word for word in words if word in ("x", "y", "z")]
    return axes[0] if len(axes) == 1 and {"bias", "drift", "offset"} & set(words) else None


def quaternion_of(name: str) -> str | None:
    """Return the component x, y, z or w of a quaternion in a column; None for other columns."""
    words = words_of(name)
    last = "".join(words[-2:]) if words[-1:] and len(words[-1]) == 1 else "".join(words[-1:])
    match = re.fullmatch(r"(?:q|quat|quaternion|rv|ori|orientation|attitude)([wxyz])", last)
    return match[1] if match else None


def is_time(name: str) -> bool:
    """Return whether a column is a clock."""
    words = set(words_of(name))
    only_a_unit = len(words) == 1 and bool(words & ({*_UNIT_WORDS} - {"s"}))
    return (only_a_unit or bool(words & _TIME)) and not words & _NO_TIME


def time_unit_of(name: str) -> str:
    """Return the unit of a clock's column, in brackets or in its words; empty if it names none.

    Text in brackets is returned as it is, so that an unknown unit can be rejected.
    """
    if "".join(words_of(name)) == XSENS_CLOCK:
        return XSENS_CLOCK
    if (named := _bracketed_unit(name)) and (named in TIME_UNITS or named not in ("", "since")):
        return named
    return next((_UNIT_WORDS[word] for word in reversed(words_of(name)) if word in _UNIT_WORDS), "")
