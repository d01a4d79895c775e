"""Satellite positions as fixes: honest about errors that last, and about positions that are none.

A receiver's errors are those of its satellites' paths: between houses it is wrong by the same
metres for a minute, however often it says so, and by more than its radius. Indoors phones repeat
the last position, with a radius as small as outdoors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stario.fusion.values.fixes import UNKNOWN_HEIGHT, Fix, position_fix, velocity_fix
from stario.sequences.geodesy import Georeference
from stario.sequences.readers.checked import LARGEST_RADIUS, RADIUS_PER_SIGMA, USUAL_RADIUS
from stario.sequences.sequence import BoolArray, FloatArray, Satellites

APART_M = 3.0
"""Distance from their centre [m] that positions must have to tell the direction of a track."""

_RADIUS_FACTOR = 1.5
"""Factor on the stated radius: it held 44 % of the positions of 28 recordings in and around two
buildings, and 1.7 to 2.2 times of it held 90 %."""

_CORRELATION_S = 30.0
"""Time for which a position's error lasts [s]."""

_PERIOD_S = 1.0
"""Time between the positions of phones [s]."""

_HELD_S = 3.0
"""Time over which the same position is held [s] from which on it is stale."""

_VELOCITY_SIGMA, _VELOCITY_PERIOD_S = 0.3, 5.0
"""Standard deviation per axis [m/s] of a velocity, and periods in each of which one is used [s]."""

_SETTLED_S = 3.0
"""Time [s] after a pause of as much before velocities count: receivers smooth them."""

_LEAST_SPEED = 0.5
"""Speed [m/s] below which its direction is noise."""

_VERTICAL_SPEED = 10.0
"""Standard deviation of a vertical velocity [m/s], which is not given."""


class SatelliteFixes(NamedTuple):
    """Fixes from a receiver's positions, in the map that `origin` places on the earth."""

    fixes: list[Fix]
    origin: Georeference


def satellite_fixes(
    satellites: Satellites, origin: Georeference | None = None
) -> SatelliteFixes | None:
    """Return a receiver's positions and velocities as fixes; None if there is none to rely on.

    They are given in the map of `origin`; None begins one at the first good position, with x east
    and y north.
    """
    good = reliable(satellites)
    if not good.any():
        return None
    used = satellites.select(good)
    if origin is None:
        altitude = _column(used.altitude_m, used)
        known = altitude[np.isfinite(altitude)]
        altitude_m = float(np.median(known)) if len(known) else math.nan
        latitude, longitude = used.latlon_deg[0].tolist()
        origin = Georeference(latitude, longitude, altitude_m=altitude_m)
    sigma = _RADIUS_FACTOR / RADIUS_PER_SIGMA * _radius(used) * np.sqrt(_shared(used.time))
    positions = [
        position_fix(time, [x, y, 0.0], np.diag(np.square([s, s, UNKNOWN_HEIGHT])))
        for time, (x, y), s in zip(used.time, origin.xy(used.latlon_deg), sigma, strict=True)
    ]
    return SatelliteFixes([*positions, *_velocities(used, origin)], origin)


def reliable(satellites: Satellites) -> BoolArray:
    """Return which positions (N,) a receiver has measured well: not those held, nor of cells."""
    radius = _radius(satellites)
    return np.asarray((radius > 0.0) & (radius <= LARGEST_RADIUS) & ~_held(satellites))


def georeference_of(latlon_deg: FloatArray, track: FloatArray) -> Georeference | None:
    """Return where a frame lies on the earth in which a track fits places best.

    Args:
        latlon_deg: (N, 2) latitude and longitude of at least one place [deg].
        track: (N, 2) the track at the same times, in its frame [m].

    Returns:
        The frame's place; None if the places or the track are too close together to tell it.
    """
    first = Georeference(*latlon_deg[0].tolist())
    w, z = (xy[:, 0] + 1j * xy[:, 1] for xy in (first.xy(latlon_deg), track))
    turn = np.vdot(z - z.mean(), w - w.mean())
    if min(np.abs(w - w.mean()).max(), np.abs(z - z.mean()).max()) < APART_M:
        return None
    origin = w.mean() - turn / abs(turn) * z.mean()
    latitude, longitude = first.latlon_deg(np.array([[origin.real, origin.imag]]))[0].tolist()
    return Georeference(latitude, longitude, float(np.angle(turn)))


def _radius(satellites: Satellites) -> FloatArray:
    """Return the stated radius (N,) [m], or the usual one."""
    radius = _column(satellites.radius_m, satellites)
    return np.where(np.isnan(radius) | (radius == 0.0), USUAL_RADIUS, radius)


def _column(values: FloatArray | None, satellites: Satellites) -> FloatArray:
    """Return an optional column (N,), NaN where unknown."""
    return np.full(len(satellites), np.nan) if values is None else values


def _held(satellites: Satellites) -> BoolArray:
    """Return which positions (N,) are among those that are held for long."""
    moved = (np.diff(satellites.latlon_deg, axis=0) != 0.0).any(axis=1)
    run = np.append(0, np.cumsum(moved))
    first, last = np.searchsorted(run, run), np.searchsorted(run, run, side="right") - 1
    return np.asarray(satellites.time[last] - satellites.time[first] >= _HELD_S)


def _shared(time: FloatArray) -> FloatArray:
    """Return how many positions around each one (N,) tell as much as one: they share an error."""
    first = time[1] - time[0] if len(time) > 1 else _PERIOD_S
    step = np.diff(time, prepend=time[0] - first)
    return np.asarray(_CORRELATION_S / np.clip(step, 1e-3, _CORRELATION_S))


def _velocities(used: Satellites, origin: Georeference) -> list[Fix]:
    """Return some velocities, by Doppler shifts: few enough that their errors do not repeat."""
    speed, bearing = _column(used.speed_m_s, used), _column(used.bearing_deg, used)
    # Without a bearing, receivers leave it at zero.
    known = (speed >= _LEAST_SPEED) & np.isfinite(bearing) & (bearing != 0.0)
    paused = np.diff(used.time, prepend=-math.inf) > _SETTLED_S
    known &= used.time - np.maximum.accumulate(np.where(paused, used.time, -math.inf)) >= _SETTLED_S
    covariance = np.diag(np.square([_VELOCITY_SIGMA, _VELOCITY_SIGMA, _VERTICAL_SPEED]))
    rows = np.flatnonzero(known)
    _, first = np.unique(used.time[rows] // _VELOCITY_PERIOD_S, return_index=True)
    fixes: list[Fix] = []
    for k in rows[first]:
        angle = 0.5 * math.pi - math.radians(bearing[k]) - origin.yaw
        v_W = speed[k] * np.array([math.cos(angle), math.sin(angle), 0.0])
        fixes.append(velocity_fix(used.time[k], v_W, covariance))
    return fixes
