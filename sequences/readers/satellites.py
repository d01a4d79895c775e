"""Positions of a satellite receiver as files give them, as measurements."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stario.sequences.sequence import BoolArray, FloatArray, Satellites
from stario.sequences.time_order import increasing_mask

OPTIONAL = ("altitude_m", "radius_m", "speed_m_s", "bearing_deg")
"""Optional attributes of `Satellites`."""

_LARGEST_DEGREES = 90.0, 180.0
"""Largest latitude and longitude."""


def known_places(latlon_deg: FloatArray) -> BoolArray:
    """Return which of the latitudes and longitudes (N, 2) are a place: not NaN, nor zeros.

    Some apps write zeros until there is a position.
    """
    return np.asarray((np.abs(latlon_deg) <= _LARGEST_DEGREES).all(axis=1) & latlon_deg.any(axis=1))


def satellites(
    time: FloatArray, latlon_deg: FloatArray, rest: Mapping[str, FloatArray]
) -> Satellites | None:
    """Return the known places whose times advance; None if there is none.

    Args:
        time: (N,) [s].
        latlon_deg: (N, 2) latitude and longitude [deg].
        rest: (N,) each of the attributes of `OPTIONAL` that the file has. Phones write a negative
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
