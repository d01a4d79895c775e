"""Units that recordings come in, and how they turn into s, rad/s and m/s^2."""

from __future__ import annotations

import math
from dataclasses import replace

from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence

TIME_UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""How many make a second: whole numbers, so that nanoseconds since 1970 can be read exactly."""

GYRO_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180.0}

ACCEL_UNITS = {
    "m/s^2": 1.0,
    "g": STANDARD_GRAVITY,
    "-m/s^2": -1.0,
    "-g": -STANDARD_GRAVITY,
}
"""The minus is for devices that report gravity where others report specific force: Apple's."""

_SPELLINGS = {
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "usec": "us",
    "µs": "us",
    "μs": "us",
    "rads-1": "rad/s",
    "rad/sec": "rad/s",
    "dps": "deg/s",
    "°/s": "deg/s",
    "deg/sec": "deg/s",
    "degs-1": "deg/s",
    "m/s2": "m/s^2",
    "m/s/s": "m/s^2",
    "m/s²": "m/s^2",
    "ms-2": "m/s^2",
    "-m/s2": "-m/s^2",
}


def unit_named(text: str) -> str:
    """The table's spelling of a unit: case, blanks and `^` do not matter (`rad s^-1`: `rad/s`)."""
    plain = text.lower().replace(" ", "").replace("^", "")
    return _SPELLINGS.get(plain, plain)


def with_units(
    sequence: ImuSequence, gyro_unit: str = "rad/s", accel_unit: str = "m/s^2"
) -> ImuSequence:
    """The recording in rad/s and m/s^2, given what its numbers are in.

    Args:
        sequence: a recording whose numbers are in the units named.
        gyro_unit: one of `GYRO_UNITS`.
        accel_unit: one of `ACCEL_UNITS`; a leading minus turns gravity into specific force.

    Raises:
        InputError: a unit is unknown.
    """
    gyro, accel = unit_named(gyro_unit), unit_named(accel_unit)
    if gyro not in GYRO_UNITS:
        raise InputError("gyro_unit", repr(gyro_unit), f"one of {', '.join(GYRO_UNITS)}")
    if accel not in ACCEL_UNITS:
        raise InputError("accel_unit", repr(accel_unit), f"one of {', '.join(ACCEL_UNITS)}")
    return replace(
        sequence,
        gyro=sequence.gyro * GYRO_UNITS[gyro],
        accel=sequence.accel * ACCEL_UNITS[accel],
    )
