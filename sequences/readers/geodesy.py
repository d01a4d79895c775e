"""Latitude and longitude to metres in a local plane."""

from __future__ import annotations

import math

import numpy as np

from stario.sequences.sequence import FloatArray

_EQUATOR_M, _ECCENTRICITY_2 = 6_378_137.0, 6.694_379_990_14e-3
"""Semi-major axis and squared eccentricity of the WGS 84 ellipsoid."""


def east_north(degrees: FloatArray) -> FloatArray:
    """Return metres (N, 2) east and north of the first of N points.

    To first order about that point: at a kilometre and a latitude of 60 degrees off by 0.16 m, and
    by four times as much at twice the distance.

    Args:
        degrees: (N, 2) latitude and longitude on WGS 84 [deg].
    """
    away = degrees - degrees[0]
    away[:, 1] = (away[:, 1] + 180.0) % 360.0 - 180.0
    return np.asarray(np.radians(away[:, ::-1]) * _radii(degrees[0, 0]))


def latitude_longitude(origin: FloatArray, metres: FloatArray) -> FloatArray:
    """Return latitude and longitude (N, 2) [deg] of points (N, 2) east and north of an origin [m].

    The inverse of `east_north`; the origin's are (2,) [deg].
    """
    return np.asarray(origin + np.degrees(metres / _radii(origin[0]))[:, ::-1])


def _radii(latitude_deg: float) -> FloatArray:
    """Return metres per radian of longitude and of latitude (2,)."""
    latitude = math.radians(latitude_deg)
    w = 1.0 - _ECCENTRICITY_2 * math.sin(latitude) ** 2
    north = _EQUATOR_M * (1.0 - _ECCENTRICITY_2) / w**1.5  # radius of curvature of the meridian
    return np.array([_EQUATOR_M / math.sqrt(w) * math.cos(latitude), north])
