"""Magnetometer simulation along any trajectory: earth, building, moving magnets, hard iron.

A building's field is the gradient of a smooth random potential, as a field without currents must
be. It depends on position only, so that a person who returns measures the same field again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.sequences.arrays import generator
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, Magnetometer, Trajectory
from stario.sequences.settings import check_number

EARTH_W = 48.0 * np.array([math.cos(math.radians(63.0)), 0.0, -math.sin(math.radians(63.0))])
"""The earth's field [uT]: it dips by 63 degrees, and W's x axis points to magnetic north."""

_RATE = 50.0
"""Sampling rate [Hz]."""

_WAVES = 128
_STREAM = 0x6D6167
"""Seed of the magnetometer's separate draws: they do not change the IMU of the same seed."""


@dataclass(frozen=True)
class MagneticField:
    """Magnetic field around a device, and the errors of its magnetometer.

    Attributes:
        disturbance: root mean square of the building's field [uT].
        length: length over which the building's field changes [m].
        hard_iron: constant offset in B that the device adds [uT].
        noise: standard deviation of a sample, per axis [uT].
        lag: delay of the timestamps [s].

    Raises:
        InputError: a value is not finite, a magnitude is negative, or the length below 0.01 m.
    """

    disturbance: float = 0.0
    length: float = 3.0
    hard_iron: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: float = 0.4
    lag: float = 0.0

    def __post_init__(self) -> None:
        check_number(self, "disturbance")
        check_number(self, "length", 0.01)
        check_number(self, "noise")
        check_number(self, "lag", -math.inf)
        if not np.isfinite(self.hard_iron).all():
            raise InputError("hard_iron", repr(self.hard_iron), "finite numbers")


INDOOR_FIELD = MagneticField(disturbance=8.0, length=2.0, hard_iron=(3.0, -2.0, 4.0), lag=0.03)
"""A phone in a building of concrete and steel."""


def simulate_magnetometer(
    truth: Trajectory, magnetic_field: MagneticField, seed: int = 0
) -> Magnetometer:
    """Simulate a magnetometer whose axes are the IMU's.

    Args:
        truth: poses without gaps at the IMU's rate or another that resolves the rotation.
        magnetic_field: field and sensor errors.
        seed: seed of every random draw.

    Raises:
        InputError: there are fewer than two valid poses, or the seed is not an integer >= 0.
    """
    rng = generator(seed, _STREAM)
    count = int((truth.time[-1] - truth.time[0]) * _RATE) + 1
    time = np.minimum(truth.time[0] + np.arange(count) / _RATE, truth.time[-1])
    pose = truth.at(time)
    field_W = EARTH_W + _building(magnetic_field, pose.position_W, rng)
    field_B = pose.attitude_WB.apply(field_W, inverse=True) + np.array(magnetic_field.hard_iron)
    field_B += magnetic_field.noise * rng.standard_normal(field_B.shape)
    return Magnetometer(time + magnetic_field.lag, field_B)


def _building(
    magnetic_field: MagneticField, position_W: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the building's field (N, 3) in W [uT] at positions (N, 3) [m]."""
    waves = rng.standard_normal((_WAVES, 3)) / magnetic_field.length
    phases = rng.uniform(0.0, 2.0 * math.pi, _WAVES)
    # Root mean square of the gradient of the potential sum cos(k p + phase).
    size = math.sqrt(0.5 * float(np.square(waves).sum()))
    slopes = np.sin(position_W @ waves.T + phases)
    return np.asarray(magnetic_field.disturbance / size * slopes @ waves, dtype=np.float64)
