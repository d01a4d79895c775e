"""Satellite receiver simulation along any trajectory: errors that last, and held positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from stario.sequences.arrays import generator, interpolated
from stario.sequences.attitude.rotations import about_z
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import BoolArray, FloatArray, Satellites, Trajectory
from stario.sequences.settings import check_number

_STREAM = 0x736174
"""Seed of the receiver's separate draws: they do not change the IMU of the same seed."""

_INDOOR_RADIUS = 9.0
"""Radius [m] that phones state of the position that they repeat indoors."""


@dataclass(frozen=True)
class Sky:
    """Where a trajectory lies on the earth, and the errors of a satellite receiver.

    Attributes:
        latitude: latitude of the trajectory's origin [deg].
        longitude: its longitude [deg].
        altitude: its altitude [m].
        azimuth: direction of W's x axis, clockwise from north [rad].
        sigma: standard deviation of a position's error per horizontal axis [m]; 1.5 times as much
            vertically.
        street: factor of that error between houses.
        lasting: correlation time of the error [s].
        speed_sigma: standard deviation of the Doppler velocity per axis [m/s].
        radius: radius [m] that the receiver states, between houses as well.

    Raises:
        InputError: a value is not finite or out of range.
    """

    latitude: float = 48.0
    longitude: float = 11.0
    altitude: float = 100.0
    azimuth: float = 0.0
    sigma: float = 2.5
    street: float = 3.0
    lasting: float = 30.0
    speed_sigma: float = 0.1
    radius: float = 4.7

    def __post_init__(self) -> None:
        check_number(self, "latitude", -80.0, 80.0)
        check_number(self, "longitude", -180.0, 180.0)
        check_number(self, "azimuth", -2.0 * np.pi, 2.0 * np.pi)
        for name in ("sigma", "street", "speed_sigma"):
            check_number(self, name)
        for name in ("lasting", "radius"):
            check_number(self, name, 0.1, 1e4)

    def degrees(self, position_W: FloatArray) -> FloatArray:
        """Return latitude and longitude (N, 2) [deg] of positions (N, 3) in W [m]."""
        place = Georeference(self.latitude, self.longitude)
        return place.latlon_deg(self.east_north(position_W))

    def east_north(self, vectors_W: FloatArray) -> FloatArray:
        """Return vectors (N, 3) in W as east, north and up."""
        return np.asarray(about_z(0.5 * np.pi - self.azimuth).apply(vectors_W))


def simulate_satellites(
    truth: Trajectory,
    sky: Sky = Sky(),
    between_houses: BoolArray | None = None,
    indoors: BoolArray | None = None,
    seed: int = 0,
) -> Satellites:
    """Simulate a receiver that reports once per second.

    Args:
        truth: poses without gaps at any rate that resolves the walk.
        sky: place and errors.
        between_houses: (N,) whether each pose is where signals are reflected; None for nowhere.
        indoors: (N,) whether it is indoors, where the receiver repeats its last position; None for
            nowhere. A walk that begins indoors repeats the first one.
        seed: seed of every random draw.

    Raises:
        InputError: there are fewer than two valid poses, or the seed is not an integer >= 0.
    """
    rng = generator(seed, _STREAM)
    rows = np.searchsorted(truth.time, np.arange(truth.time[0], truth.time[-1]))
    time, count = truth.time[rows], len(rows)
    keep = np.exp(-1.0 / sky.lasting)
    drive = rng.standard_normal((count, 3))
    drive[1:] *= np.sqrt(1.0 - keep**2)
    error = sky.sigma * np.array([1.0, 1.0, 1.5]) * lfilter([1.0], [1.0, -keep], drive, axis=0)
    if between_houses is not None:
        error *= np.where(between_houses[rows], sky.street, 1.0)[:, None]
    measured = truth.position_W[rows] + error
    before, after = (np.clip(time + t, *truth.time[[0, -1]]) for t in (-0.5, 0.5))
    ends = (interpolated(t, truth.time, truth.position_W) for t in (before, after))
    velocity = -np.subtract(*ends) / (after - before)[:, None]
    velocity += sky.speed_sigma * rng.standard_normal((count, 3))
    east, north, _ = sky.east_north(velocity).T
    inside = np.zeros(count, dtype=np.bool_) if indoors is None else indoors[rows]
    last = np.maximum.accumulate(np.where(inside, 0, np.arange(count)))  # the position repeated
    return Satellites(
        time,
        sky.degrees(measured)[last],
        altitude_m=sky.altitude + measured[last, 2],
        radius_m=np.where(inside, _INDOOR_RADIUS, sky.radius),
        speed_m_s=np.where(inside, 0.0, np.hypot(east, north)),
        bearing_deg=np.degrees(np.arctan2(east, north))[last] % 360.0,
    )
