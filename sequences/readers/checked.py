"""Parts of a recording as files give them, checked.

These are numbers, rotations and poses, the magnetic field, the pressure of the air (in which unit,
and whether it is pressure at all) and positions of a satellite receiver, as measurements.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import NORM_TOLERANCE
from stario.sequences.errors import ReadError
from stario.sequences.readers.text import IntArray
from stario.sequences.sequence import (
    Barometer,
    BoolArray,
    FloatArray,
    Magnetometer,
    Satellites,
    Trajectory,
)
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import (
    HIGHEST_HPA,
    LOWEST_HPA,
    PRESSURE_UNITS,
    SPEED_UNITS,
    pressure_unit_of,
)

_log = logging.getLogger(__name__)

_HELD_SHARE = 1.0 / 3.0
_LARGEST_STEP_HPA = 0.3
"""Median step between different neighbours of anything but pressure; of barometers it is below 0.1,
and 0.2 in a lift at 1 Hz. Altitudes in metres taken for hPa have larger ones."""

OPTIONAL = {"alt": "altitude_m", "acc": "radius_m", "speed": "speed_m_s", "bearing": "bearing_deg"}
"""Optional attributes of `Satellites` by their columns in a generic CSV."""

DEGREES = {"deg": 1.0, "": 1.0, "°": 1.0}

_METRES = {"m": 1.0, "": 1.0, "ft": 0.3048}

UNITS = {
    "altitude_m": _METRES,
    "radius_m": _METRES,
    "speed_m_s": SPEED_UNITS | {"": 1.0},
    "bearing_deg": DEGREES,
}
"""Factors of the units of these attributes, without a unit as well."""

_PRESSURE = (
    f"pressure of {LOWEST_HPA:g} to {HIGHEST_HPA:g} hPa, or in Pa, kPa or inHg",
    "is it an altitude?",
)
"""What is expected of a barometer's values, and what others may be."""

RADIUS_PER_SIGMA = 1.51
"""Radius that holds 68 % of a Gaussian in the plane, in standard deviations per axis."""

USUAL_RADIUS, LARGEST_RADIUS = 10.0, 30.0
"""Radius [m] where none is stated, and the largest: more is that of positions from the network's
cells or of rooms without reception."""


def finite_rows(path: Path, field: str, values: FloatArray, all_of_them: bool = False) -> IntArray:
    """Return the rows of values (N,) or (N, K) that are finite, and warn of the others."""
    rows = np.flatnonzero(np.isfinite(values).reshape(len(values), -1).all(axis=1))
    if lost := len(values) - len(rows):
        if all_of_them or lost > len(values) / 2:
            found = f"{lost} of {len(values)} rows that are not finite"
            raise ReadError(path, field, found, "finite numbers")
        count = len(values)
        _log.warning("%s: %s: dropped %d of %d rows that are not finite", path, field, lost, count)
    return rows


def rotations(
    path: Path,
    field: str,
    quat: FloatArray,
    order: str = "wxyz",
    numbers: IntArray | None = None,
    row: str = "row",
) -> Rotation:
    """Return rotations from unit quaternions (N, 4) in an order, `wxyz` or `xyzw`.

    The error of another names its field and row, by its number (N,), or its index from 1.
    """
    found, known = captured_rotations(quat if order == "xyzw" else quat[:, [1, 2, 3, 0]])
    if not known.all():
        k = int(np.argmin(known))
        where = f"{row} {k + 1 if numbers is None else numbers[k]}, {field}"
        norm, fix = f"norm {np.linalg.norm(quat[k]):.4g}", "cut the recording there"
        raise ReadError(path, where, norm, "a unit quaternion", fix)
    return found


def captured_rotations(quat_xyzw: FloatArray) -> tuple[Rotation, BoolArray]:
    """Return rotations from (N, 4) and the mask of those with a unit quaternion, else identity.

    Captures that lose track write zeros, NaN or other numbers instead.
    """
    norm = np.linalg.norm(quat_xyzw, axis=1)
    known = np.isfinite(norm) & (np.abs(norm - 1.0) <= NORM_TOLERANCE)
    return Rotation.from_quat(np.where(known[:, None], quat_xyzw, [0.0, 0.0, 0.0, 1.0])), known


def magnetometer(
    time: FloatArray, field: FloatArray | None, held: bool = True
) -> Magnetometer | None:
    """Return a magnetometer's finite, non-zero samples at times that advance; None if none.

    If more than a third of the values (N, 3) repeat the last one, those are `held` ones and
    skipped: some apps write the last reading at the IMU's rate.
    """
    if field is None:
        return None
    known = np.isfinite(field).all(axis=1) & np.isfinite(time) & field.any(axis=1)
    time, field = time[known], field[known]
    keep = increasing_mask(time)
    if held and len(field) > 1:
        fresh = np.append(True, np.diff(field, axis=0).any(axis=1))
        if fresh.mean() < 1.0 - _HELD_SHARE:
            keep &= fresh
    return Magnetometer(time[keep], field[keep]) if keep.any() else None


def pose_mask(path: Path, time: FloatArray) -> BoolArray:
    """Return which of a truth's times (N,) [s] to keep, so that they increase.

    Repeated rows are usual; a warning counts the others that are dropped.
    """
    keep = increasing_mask(time)
    if (np.diff(time) < 0.0).any():
        count = int((~keep).sum())
        _log.warning(
            "%s: dropped %d of %d poses: their times do not increase", path, count, len(keep)
        )
    return keep


def trajectory(
    path: Path,
    time: FloatArray,
    position_W: FloatArray,
    attitude_WB: Rotation,
    velocity_W: FloatArray | None = None,
) -> Trajectory:
    """Return a trajectory of a file's poses whose times advance, as `pose_mask` selects them."""
    keep = pose_mask(path, time)
    return Trajectory(
        time=time[keep],
        position_W=position_W[keep],
        attitude_WB=attitude_WB[keep],
        velocity_W=None if velocity_W is None else velocity_W[keep],
    )


def barometer(
    path: Path, title: str, time: FloatArray, values: FloatArray, unit: str = ""
) -> Barometer | None:
    """Return the pressure in hPa at the times that advance; None if there is none.

    None too, with a warning, if the values (N,) are no pressure in any unit: a barometer is
    optional. They are NaN, zero or negative where there is none; their size tells a missing unit.
    """
    kept = np.isfinite(time) & np.isfinite(values) & (values > 0.0)
    kept[kept] = increasing_mask(time[kept])
    if not kept.any():
        return None
    try:
        return Barometer(time[kept], _in_hPa(path, title, values[kept], unit))
    except ReadError as error:
        _log.warning("pressure skipped: %s", error)
        return None


def _in_hPa(path: Path, title: str, values: FloatArray, unit: str) -> FloatArray:
    """Return pressures (N,) in the named unit, or in the one that fits a typical value, in hPa."""
    value = float(np.median(values))
    if unit and unit not in PRESSURE_UNITS:
        raise ReadError(path, title, f"{value:.6g} {unit}", *_PRESSURE)
    plausible = bool(unit) and LOWEST_HPA <= PRESSURE_UNITS[unit] * value <= HIGHEST_HPA
    likely = unit if plausible else pressure_unit_of(value)
    if not likely:
        raise ReadError(path, title, f"{value:.6g} {unit}".rstrip(), *_PRESSURE)
    pressure_hPa = values * PRESSURE_UNITS[likely]
    steps = np.abs(np.diff(pressure_hPa))
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if likely != unit and step > _LARGEST_STEP_HPA:  # in the title's unit they may be rounded
        found = f"steps of {step:.2g} hPa, which is {8.4 * step:.0f} m of height"
        raise ReadError(path, title, found, *_PRESSURE)
    if unit and likely != unit:
        words = "%s: %s: %.6g is no pressure in %s: read as %s"
        _log.warning(words, path, title, value, unit, likely)
    return np.asarray(pressure_hPa)


def known_places(latlon_deg: FloatArray) -> BoolArray:
    """Return which latitudes and longitudes (N, 2) are a place, unlike zeros until the first."""
    return np.asarray((np.abs(latlon_deg) <= [90, 180]).all(axis=1) & latlon_deg.any(axis=1))


def in_degrees(path: Path, latlon_deg: FloatArray) -> FloatArray:
    """Return latitudes and longitudes (N, 2), exchanged if only that makes them places.

    A few rows may hold anything; a single one proves nothing.
    """
    present = latlon_deg[np.isfinite(latlon_deg).all(axis=1) & latlon_deg.any(axis=1)]
    if len(present) < 2 or known_places(present).any():
        return latlon_deg
    if known_places(present[:, ::-1]).all():
        _log.warning("%s: latitude and longitude are exchanged: read the other way round", path)
        return latlon_deg[:, ::-1]
    found, fix = f"{present[0, 0]:.10g} and {present[0, 1]:.10g}", ""
    degrees, minutes = np.divmod(np.abs(present), 100.0)
    if (minutes < 60.0).all() and known_places(degrees).all():
        latitude = np.sign(present[0, 0]) * (degrees[0, 0] + minutes[0, 0] / 60.0)
        fix = f"NMEA's degrees and minutes? That latitude is {latitude:.6f}"
    expected = "degrees, as in 48.137 and 11.575"
    raise ReadError(path, "latitude, longitude", found, expected, fix)


def satellites(
    time: FloatArray, latlon_deg: FloatArray, rest: Mapping[str, FloatArray]
) -> Satellites | None:
    """Return the known places (N, 2) [deg] whose times advance; None if there is none.

    The `rest` are those of the attributes of `OPTIONAL` that the file has. Phones write a negative
    accuracy, speed or bearing, or an accuracy of 0, where they know none: it becomes NaN.
    """
    kept = known_places(latlon_deg) & np.isfinite(time)
    kept[kept] = increasing_mask(time[kept])
    if not kept.any():
        return None
    stated = {name: values[kept] for name, values in rest.items()}
    if "radius_m" in stated:
        stated["radius_m"] = np.where(stated["radius_m"] > 0.0, stated["radius_m"], np.nan)
    for name in {"speed_m_s", "bearing_deg"} & set(stated):
        stated[name] = np.where(stated[name] >= 0.0, stated[name], np.nan)
    told = {name: values for name, values in stated.items() if np.isfinite(values).any()}
    return Satellites(time[kept], latlon_deg[kept], **told)
