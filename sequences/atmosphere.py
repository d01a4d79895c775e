"""Pressure and altitude in the international standard atmosphere (ISO 2533)."""

from __future__ import annotations

import numpy as np

from stario.sequences.arrays import FloatArray

_SEA_LEVEL_HPA = 1013.25
_SCALE_M = 44_330.77
"""Temperature at the sea's level over its fall with altitude [m]."""

_EXPONENT = 5.25588
"""Of the temperature, g M / (R 0.0065 K/m)."""


def pressure_altitude(pressure_hPa: FloatArray) -> FloatArray:
    """Return altitudes (N,) [m], 8.4 m/hPa at the sea's level.

    Differences are as much too small as the air is warmer than 15 degrees less 6.5 per kilometre:
    2 % in a room.
    """
    return np.asarray(_SCALE_M * (1.0 - (pressure_hPa / _SEA_LEVEL_HPA) ** (1.0 / _EXPONENT)))


def standard_pressure(altitude: FloatArray) -> FloatArray:
    """Return the pressure (N,) [hPa] at altitudes (N,) [m]."""
    return np.asarray(_SEA_LEVEL_HPA * (1.0 - altitude / _SCALE_M) ** _EXPONENT)
