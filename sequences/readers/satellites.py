"""Positions of a satellite receiver as files give them, as measurements."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.sequence import BoolArray, FloatArray, Satellites
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import SPEED_UNITS

_log = logging.getLogger(__name__)

OPTIONAL = {
    "alt": "altitude_m",
    "acc": "radius_m",
    "speed": "speed_m_s",
    "bearing": "bearing_deg",
}
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

RADIUS_PER_SIGMA = 1.51
"""Radius that holds 68 % of a Gaussian in the plane, in standard deviations per axis."""

USUAL_RADIUS, LARGEST_RADIUS = 10.0, 30.0
"""Radius [m] where none is stated, and the largest: more is that of positions from the network's
cells or of rooms without reception."""

_LARGEST_DEGREES = 90.0, 180.0
"""Largest latitude and longitude."""


def known_places(latlon_deg: FloatArray) -> BoolArray:
    """Return which of the latitudes and longitudes (N, 2) are a place: not NaN, nor zeros.

    Some apps write zeros until there is a position.
    """
    return np.asarray((np.abs(latlon_deg) <= _LARGEST_DEGREES).all(axis=1) & latlon_deg.any(axis=1))


def in_degrees(path: Path, latlon_deg: FloatArray) -> FloatArray:
    """Return latitudes and longitudes (N, 2), exchanged if only that makes them places.

    A few rows may hold anything; a single one proves nothing.

    Raises:
        ReadError: no row is in degrees.
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
    """Return the known places whose times advance; None if there is none.

    Args:
        time: (N,) [s].
        latlon_deg: (N, 2) latitude and longitude [deg].
        rest: (N,) those of the attributes of `OPTIONAL` that the file has. Phones write a negative
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


def satellite_columns(reported: Satellites) -> tuple[list[str], FloatArray]:
    """Return names and values (N, K) of a generic CSV's columns for what a receiver reported."""
    known = {name: getattr(reported, attribute) for name, attribute in OPTIONAL.items()}
    known = {name: values for name, values in known.items() if values is not None}
    return ["lat", "lon", *known], np.column_stack([reported.latlon_deg, *known.values()])
