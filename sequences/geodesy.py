"""Latitude and longitude to metres in a map, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymap3d

from stario.sequences.arrays import as_float64
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray


@dataclass(frozen=True)
class Georeference:
    """Where on the earth a map lies: a plane that touches the ellipsoid WGS 84 at the origin.

    Attributes:
        latitude_deg: latitude of the map's origin [deg].
        longitude_deg: its longitude [deg].
        yaw: direction of the map's x axis, counter-clockwise from east [rad]: with zero x points
            east and y north.
        altitude_m: altitude of the map's z = 0, as its source counts it [m]; NaN where unknown.

    Raises:
        InputError: a latitude or longitude is none, or yaw is not a finite angle.
    """

    latitude_deg: float
    longitude_deg: float
    yaw: float = 0.0
    altitude_m: float = math.nan

    def __post_init__(self) -> None:
        expected = "latitude and longitude in degrees, as in 48.137 and 11.575"
        bounds = {
            "latitude_deg": (-90.0, 90.0),
            "longitude_deg": (-180.0, 360.0),
            "yaw": (-1e2, 1e2),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not low <= value <= high:
                wanted = "an angle in radians" if name == "yaw" else expected
                raise InputError(f"georeference: {name}", f"{value:g}", wanted)

    def xy(self, latlon_deg: FloatArray) -> FloatArray:
        """Return metres (N, 2) in the map's axes for latitudes and longitudes (N, 2) [deg].

        Raises:
            InputError: they have another shape; a single place is one row.
        """
        latitude, longitude = _columns("latlon_deg", latlon_deg)[:2]
        east, north, _ = pymap3d.geodetic2enu(
            latitude, longitude, 0.0, self.latitude_deg, self.longitude_deg, 0.0
        )
        return turned(np.column_stack([east, north]), -self.yaw)

    def latlon_deg(self, position_W: FloatArray) -> FloatArray:
        """Return latitudes and longitudes (N, 2) [deg] of positions (N, 2 or 3) [m] in the map.

        Raises:
            InputError: they have another shape; a single position is one row.
        """
        east, north = turned(_columns("position_W", position_W)[:2].T, self.yaw).T
        # The plane leaves the ellipsoid: at 10 km by 8 m, which moves no point sideways.
        latitude, longitude, _ = pymap3d.enu2geodetic(
            east, north, np.zeros_like(east), self.latitude_deg, self.longitude_deg, 0.0
        )
        return np.column_stack([latitude, (longitude + 180.0) % 360.0 - 180.0])


def _columns(field: str, rows: FloatArray) -> FloatArray:
    """Return the columns (2 or 3, N) of rows."""
    try:
        columns = np.atleast_2d(as_float64(field, rows)).T
    except InputError as error:
        raise InputError(field, error.found, "numbers (N, 2)") from None
    if columns.ndim != 2 or len(columns) not in (2, 3):
        raise InputError(field, f"shape {np.shape(rows)}", "(N, 2)")
    return columns


def east_north(latlon_deg: FloatArray) -> FloatArray:
    """Return metres (N, 2) east and north of the first of N points.

    Args:
        latlon_deg: (N, 2) latitude and longitude on WGS 84 [deg].
    """
    return Georeference(*latlon_deg[0].tolist()).xy(latlon_deg)


def turned(xy: FloatArray, angle: float) -> FloatArray:
    """Turn points (N, 2) counter-clockwise by an angle [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(xy @ np.array([[c, s], [-s, c]]))
