"""Barometer and satellite receiver along any trajectory: weather, doors, held positions, noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from stario.sequences.arrays import generator, interpolated
from stario.sequences.attitude.rotations import about_z
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import Barometer, BoolArray, FloatArray, Satellites, Trajectory
from stario.sequences.simulation.routes import smoothed
from stario.sequences.units import standard_pressure

_BAROMETER_STREAM, _RECEIVER_STREAM = 0x626172, 0x736174
"""Seeds of these sensors' separate draws: they do not change the IMU of the same seed."""

_ALTITUDE = 100.0
"""Altitude of a trajectory's origin [m]."""

_DOOR_SECONDS = 0.5
"""Standard deviation of the Gaussian that smooths a step at a door [s]."""

STREET, LASTING_S = 3.0, 30.0
"""Factor of a position's error between houses, and the error's correlation time [s]."""

PLACE = Georeference(48.0, 11.0, 0.5 * np.pi)
"""Where a trajectory lies on the earth, with x to the north."""

_SPEED_SIGMA = 0.1
"""Standard deviation of the Doppler velocity per axis [m/s]."""

_RADIUS, _INDOOR_RADIUS = 4.7, 9.0
"""Radius [m] that phones state, between houses as well, and of the position repeated indoors."""


def simulate_barometer(
    truth: Trajectory,
    doors: FloatArray | None = None,
    seed: int = 0,
    *,
    weather: float = 0.02,
    door: float = 0.35,
    noise: float = 0.1,
    rate: float = 8.0,
) -> Barometer:
    """Simulate a barometer; the defaults are a phone's in changing weather and a ventilated house.

    Args:
        truth: poses without gaps at any rate.
        doors: (D,) times [s] at which the device passes a door, each with a step of pressure; None
            for none.
        seed: seed of every random draw.
        weather: random walk of the pressure [m/sqrt(s)]: 0.02 are 0.15 m in one minute.
        door: standard deviation of the step at a door, to a room with other ventilation [m].
        noise: standard deviation of a sample [m].
        rate: sampling rate [Hz].

    Raises:
        InputError: there are fewer than two valid poses, or the seed is not an integer >= 0.
    """
    rng = generator(seed, _BAROMETER_STREAM)
    span = truth.time[-1] - truth.time[0]
    time = truth.time[0] + np.arange(int(span * rate) + 1) / rate
    height = truth.at(time).position_W[:, 2] + _ALTITUDE
    height += weather * np.cumsum(rng.standard_normal(len(time))) / np.sqrt(rate)
    passed = np.empty(0) if doors is None else doors
    rooms = np.append(0.0, door * rng.standard_normal(len(passed)))
    room = np.searchsorted(passed, time, side="right")
    height += smoothed(rooms[room], rate, _DOOR_SECONDS)
    height += noise * rng.standard_normal(len(time))
    return Barometer(time, standard_pressure(height))


def simulate_satellites(
    truth: Trajectory,
    place: Georeference = PLACE,
    between_houses: BoolArray | None = None,
    indoors: BoolArray | None = None,
    seed: int = 0,
    sigma: float = 2.5,
) -> Satellites:
    """Simulate a receiver that reports once per second.

    Args:
        truth: poses without gaps at any rate that resolves the walk.
        place: where the trajectory lies on the earth.
        between_houses: (N,) whether each pose is where signals are reflected; None for nowhere.
        indoors: (N,) whether it is indoors, where the receiver repeats its last position; None for
            nowhere. A walk that begins indoors repeats the first one.
        seed: seed of every random draw.
        sigma: standard deviation of a position's error per horizontal axis [m]; 1.5 times as much
            vertically, `STREET` times between houses.

    Raises:
        InputError: there are fewer than two valid poses, or the seed is not an integer >= 0.
    """
    rng = generator(seed, _RECEIVER_STREAM)
    rows = np.searchsorted(truth.time, np.arange(truth.time[0], truth.time[-1]))
    time, count = truth.time[rows], len(rows)
    keep = np.exp(-1.0 / LASTING_S)
    drive = rng.standard_normal((count, 3))
    drive[1:] *= np.sqrt(1.0 - keep**2)
    error = sigma * np.array([1.0, 1.0, 1.5]) * lfilter([1.0], [1.0, -keep], drive, axis=0)
    if between_houses is not None:
        error *= np.where(between_houses[rows], STREET, 1.0)[:, None]
    measured = truth.position_W[rows] + error
    before, after = (np.clip(time + t, *truth.time[[0, -1]]) for t in (-0.5, 0.5))
    ends = (interpolated(t, truth.time, truth.position_W) for t in (before, after))
    velocity = -np.subtract(*ends) / (after - before)[:, None]
    velocity += _SPEED_SIGMA * rng.standard_normal((count, 3))
    east, north, _ = about_z(place.yaw).apply(velocity).T
    inside = np.zeros(count, dtype=np.bool_) if indoors is None else indoors[rows]
    last = np.maximum.accumulate(np.where(inside, 0, np.arange(count)))  # the position repeated
    return Satellites(
        time,
        latlon_at(place, measured)[last],
        altitude_m=_ALTITUDE + measured[last, 2],
        radius_m=np.where(inside, _INDOOR_RADIUS, _RADIUS),
        speed_m_s=np.where(inside, 0.0, np.hypot(east, north)),
        bearing_deg=np.degrees(np.arctan2(east, north))[last] % 360.0,
    )


def latlon_at(place: Georeference, position_W: FloatArray) -> FloatArray:
    """Return latitudes and longitudes (N, 2) [deg] of positions (N, 3) [m]."""
    # Turned in three dimensions, as velocities are, a seed's walk is the same to the last bit.
    return replace(place, yaw=0.0).latlon_deg(about_z(place.yaw).apply(position_W))
