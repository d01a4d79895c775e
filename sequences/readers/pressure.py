"""Pressure of the air as files give it: in which unit, and whether it is pressure at all."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.sequence import Barometer, FloatArray
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import HIGHEST_HPA, LOWEST_HPA, PRESSURE_UNITS, pressure_unit_of

_log = logging.getLogger(__name__)

_LARGEST_STEP_HPA = 0.3
"""Median step between different neighbours of anything but pressure; of barometers it is below 0.1,
and 0.2 in a lift at 1 Hz. Altitudes in metres taken for hPa have larger ones."""


def barometer(
    path: Path, title: str, time: FloatArray, values: FloatArray, unit: str = ""
) -> Barometer | None:
    """Return the pressure in hPa at the times that advance; None if there is none.

    None too, with a warning, if the values are no pressure in any unit: a barometer is optional.

    Args:
        path: the file, for messages.
        title: title of its column, for messages.
        time: (N,) [s].
        values: (N,) pressure; NaN, zero or negative where there is none.
        unit: its unit in the tables' spelling; empty to tell it by the size.
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
    pressure_hPa = values * _factor(path, title, float(np.median(values)), unit)
    steps = np.abs(np.diff(pressure_hPa))
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if not unit and step > _LARGEST_STEP_HPA:
        found = f"steps of {step:.2g} hPa, which is {8.4 * step:.0f} m of height"
        raise ReadError(path, title, found, *_expected())
    return np.asarray(pressure_hPa)


def _factor(path: Path, title: str, value: float, unit: str) -> float:
    """Return the factor to hPa of the named unit, or of the one that fits a typical value."""
    if unit and unit not in PRESSURE_UNITS:
        raise ReadError(path, title, f"{value:.6g} {unit}", *_expected())
    if unit and LOWEST_HPA <= PRESSURE_UNITS[unit] * value <= HIGHEST_HPA:
        return PRESSURE_UNITS[unit]
    if not (likely := pressure_unit_of(value)):
        raise ReadError(path, title, f"{value:.6g} {unit}".rstrip(), *_expected())
    if unit:
        _log.warning(
            "%s: %s: %.6g is no pressure in %s: read as %s", path, title, value, unit, likely
        )
    return PRESSURE_UNITS[likely]


def _expected() -> tuple[str, str]:
    expected = f"pressure of {LOWEST_HPA:g} to {HIGHEST_HPA:g} hPa, or in Pa, kPa or inHg"
    return expected, "is it an altitude?"
