"""Units of recordings, and their conversion to s, rad/s and m/s^2."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from stario.sequences.arrays import check_type, short_repr
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence

TIME_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds per unit: whole numbers, so that nanoseconds since 1970 can be read exactly."""

FILETIME_NS = 100
"""Windows and HoloLens count ticks of 100 ns since 1601."""

FILETIME_1970 = 116_444_736_000_000_000
"""Number of these ticks at the beginning of 1970."""

GYRO_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "mdps": math.pi / 180e3}

ACCEL_UNITS = {
    "m/s^2": 1.0,
    "g": STANDARD_GRAVITY,
    "-m/s^2": -1.0,
    "-g": -STANDARD_GRAVITY,
    "mg": 1e-3 * STANDARD_GRAVITY,
    "-mg": -1e-3 * STANDARD_GRAVITY,
}
"""The minus is for devices that report gravity instead of specific force: Apple's."""

FAST_RAD_S = 15.0
"""Largest 95th percentile of the rate of a carried device; recordings have at most 2.7, but at
least 41 if deg/s are taken for rad/s."""

MAGNETIC_UNITS = {"uT": 1.0, "nT": 1e-3, "mT": 1e3, "T": 1e6, "gauss": 100.0, "g": 100.0, "mg": 0.1}
"""`G`, in any case, and `mG` are gauss here."""

PRESSURE_UNITS = {
    "hPa": 1.0,
    "Pa": 0.01,
    "kPa": 10.0,
    "inHg": 33.8639,
    "mmHg": 1.33322,
    "bar": 1e3,
    "atm": 1013.25,
    "psi": 68.9476,
}
"""`mbar` is hPa as well."""

METRES_PER_HPA = 8.43
"""Height that a hectopascal is worth near the sea."""

_SEA_LEVEL_HPA, _SCALE_M, _EXPONENT = 1013.25, 44_330.77, 5.25588
"""Of the standard atmosphere (ISO 2533): pressure at the sea's level [hPa], temperature there over
its fall with altitude [m], exponent of the temperature, g M / (R 0.0065 K/m)."""

LOWEST_HPA, HIGHEST_HPA = 300.0, 1100.0
"""Range of phones' barometers, from 9 km above the sea to 0.7 km below it."""

_PRESSURES = {
    "hPa": (LOWEST_HPA, HIGHEST_HPA),
    "Pa": (3e4, 1.1e5),
    "kPa": (50.0, 110.0),
    "inHg": (15.0, 32.5),
}
"""Values of each unit that are told from those of the others by their size."""


def pressure_unit_of(value: float) -> str:
    """Return the unit in which a value is a plausible pressure, empty if it is in none."""
    return next((unit for unit, (low, high) in _PRESSURES.items() if low <= value <= high), "")


def pressure_altitude(pressure_hPa: FloatArray) -> FloatArray:
    """Return altitudes (N,) [m] in the standard atmosphere, 8.4 m/hPa at the sea's level.

    Differences are as much too small as the air is warmer than 15 degrees less 6.5 per kilometre:
    2 % in a room.
    """
    return np.asarray(_SCALE_M * (1.0 - (pressure_hPa / _SEA_LEVEL_HPA) ** (1.0 / _EXPONENT)))


def standard_pressure(altitude: FloatArray) -> FloatArray:
    """Return the pressure (N,) [hPa] of the standard atmosphere at altitudes (N,) [m]."""
    return np.asarray(_SEA_LEVEL_HPA * (1.0 - altitude / _SCALE_M) ** _EXPONENT)


SPEED_UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704, "kn": 1852.0 / 3600.0}

_EARTH_UT = (20.0, 80.0)


def magnetic_advice(size: float) -> str:
    """Return what to do about a field of a size that is the earth's in another unit than uT."""
    fits = (u for u in MAGNETIC_UNITS if _EARTH_UT[0] < size * MAGNETIC_UNITS[u] < _EARTH_UT[1])
    unit = next(fits, "uT")
    iron = "; if in uT, most of it is the device's own (hard iron)" if unit == "mg" else ""
    return "" if unit == "uT" else f"if in {unit}, give {MAGNETIC_UNITS[unit]:g} * field{iron}"


_SPELLINGS = {
    spelling: unit
    for unit, spellings in {
        "uT": ("ut", "µt", "μt", "î¼t", "\ufffdt", "microtesla"),
        "nT": ("nt",),
        "mT": ("mt",),
        "T": ("t", "tesla"),
        "mg": ("milligauss",),
        "ms": ("msec", "millisec", "millisecond", "milliseconds"),
        "us": ("usec", "microsec", "microsecond", "microseconds", "µs", "μs"),
        "ns": ("nsec", "nanosec", "nanosecond", "nanoseconds"),
        "rad/s": ("rads", "rads-1", "radps"),
        "mdps": ("mdeg/s",),
        "deg/s": ("dps", "°/s", "º/s", "\ufffd/s", "degs", "degs-1", "°s-1"),
        "m/s^2": ("m/s2", "m/s/s", "m/s\ufffd", "ms2", "ms-2", "mps2", "m/(s2)"),
        "-m/s^2": ("-m/s2",),
        "g": ("g's",),
        "hPa": ("hpa", "mbar", "mb", "millibar", "millibars", "hectopascal"),
        "Pa": ("pa", "pascal", "pascals"),
        "kPa": ("kpa", "kilopascal"),
        "inHg": ("inhg", '"hg'),
        "mmHg": ("mmhg", "torr"),
        "km/h": ("kmh", "kph", "km/hr"),
        "m/s": ("mps", "ms-1"),
        "kn": ("kt", "kts", "knot", "knots"),
    }.items()
    for spelling in spellings
}

_IGNORED = str.maketrans({" ": "", "^": "", "â": "", "·": "", "⁻": "-", "¹": "1", "²": "2"})
"""Signs that make no difference; `â` begins those of a wrong encoding."""

_WORDS = (
    ("squared", "2"),
    ("degrees?", "deg"),
    ("radians?", "rad"),
    ("met(er|re)s?", "m"),
    ("seconds?|sec", "s"),
    ("per", "/"),
)
"""Words of units that are spelled out, `degrees per second`, without blanks."""


def unit_named(text: str) -> str:
    """Return a unit in the tables' spelling, ignoring case, blanks and `^` (`rad s^-1`: `rad/s`).

    It may be spelled out (`radians per second`). In the names of columns a `_` stands for the `/`,
    as in `deg_s`.

    Characters garbled by a wrong encoding (`m/sÂ²`, `\ufffdT`) are recognised as well.
    """
    plain = text.lower().translate(_IGNORED).replace("_", "/")
    if plain in _SPELLINGS:
        return _SPELLINGS[plain]
    for word, short in _WORDS:
        plain = re.sub(word, short, plain)
    return _SPELLINGS.get(plain, plain)


def known_unit(field: str, text: str, known: Mapping[str, float]) -> str:
    """Return a unit in the tables' spelling.

    Raises:
        InputError: it is not one of those known; names the field.
    """
    if (name := unit_named(text)) not in known:
        raise InputError(field, short_repr(text), f"one of {', '.join(known)}")
    return name


def with_units(
    sequence: ImuSequence, gyro_unit: str = "rad/s", accel_unit: str = "m/s^2"
) -> ImuSequence:
    """Convert a recording to rad/s and m/s^2 from the units of its numbers.

    Args:
        sequence: recording whose numbers are in the given units.
        gyro_unit: one of `GYRO_UNITS`.
        accel_unit: one of `ACCEL_UNITS`; a leading minus turns gravity into specific force.

    Raises:
        InputError: a unit is unknown, or given for numbers already converted from the unit named
            in their file; or so is a minus; or the recording has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    return replace(
        sequence,
        gyro=sequence.gyro * _factor(sequence, "gyro", gyro_unit, GYRO_UNITS),
        accel=sequence.accel * _factor(sequence, "accel", accel_unit, ACCEL_UNITS),
    )


def _factor(sequence: ImuSequence, sensor: str, unit: str, known: dict[str, float]) -> float:
    field = f"{sensor}_unit"
    name = known_unit(field, unit, known)
    if abs(known[name]) != 1.0 and sensor in sequence.converted:
        found = f"{unit!r} for {sequence.name}, whose file names its unit"
        expected = f"{next(iter(known))}, to which it was converted on reading"
        raise InputError(field, found, expected, "omit the option or fix the file's header")
    if known[name] < 0.0 and "sign" in sequence.converted:
        found = f"{unit!r} for {sequence.name}, whose sign was already turned on reading"
        fix = "omit the minus and `--accel-sign apple`"
        raise InputError(field, found, "a unit without a minus", fix)
    return known[name]
