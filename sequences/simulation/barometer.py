"""Barometer simulation along any trajectory: height, weather, doors and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stario.sequences.arrays import generator
from stario.sequences.atmosphere import standard_pressure
from stario.sequences.sequence import Barometer, FloatArray, Trajectory
from stario.sequences.settings import check_number
from stario.sequences.simulation.routes import smoothed

_STREAM = 0x626172
"""Seed of the barometer's separate draws: they do not change the IMU of the same seed."""

_DOOR_SECONDS = 0.5
"""Standard deviation of the Gaussian that smooths a step at a door [s]."""


@dataclass(frozen=True)
class Air:
    """Pressure of the air around a device, and the errors of its barometer, as heights.

    Attributes:
        altitude: altitude of the trajectory's origin [m].
        weather: random walk of the pressure [m/sqrt(s)]: 0.02 are 0.15 m in one minute.
        door: standard deviation of the step at a door, to a room with other ventilation [m].
        noise: standard deviation of a sample [m].
        rate: sampling rate [Hz].

    Raises:
        InputError: a value is not finite, or a magnitude or the rate is out of range.
    """

    altitude: float = 100.0
    weather: float = 0.02
    door: float = 0.35
    noise: float = 0.1
    rate: float = 8.0

    def __post_init__(self) -> None:
        check_number(self, "altitude", -400.0, 9000.0)
        for name in ("weather", "door", "noise"):
            check_number(self, name)
        check_number(self, "rate", 0.1, 200.0)


USUAL_AIR = Air()
"""A phone's barometer in changing weather and a house with ventilation."""


def simulate_barometer(
    truth: Trajectory, air: Air = USUAL_AIR, doors: FloatArray | None = None, seed: int = 0
) -> Barometer:
    """Simulate a barometer.

    Args:
        truth: poses without gaps at any rate.
        air: the air and the sensor's errors.
        doors: (D,) times [s] at which the device passes a door, each with a step of pressure; None
            for none.
        seed: seed of every random draw.

    Raises:
        InputError: there are fewer than two valid poses, or the seed is not an integer >= 0.
    """
    rng = generator(seed, _STREAM)
    span = truth.time[-1] - truth.time[0]
    time = truth.time[0] + np.arange(int(span * air.rate) + 1) / air.rate
    height = truth.at(time).position_W[:, 2] + air.altitude
    height += air.weather * np.cumsum(rng.standard_normal(len(time))) / np.sqrt(air.rate)
    rooms = np.append(0.0, air.door * rng.standard_normal(0 if doors is None else len(doors)))
    room = np.searchsorted(np.empty(0) if doors is None else doors, time, side="right")
    height += smoothed(rooms[room], air.rate, _DOOR_SECONDS)
    height += air.noise * rng.standard_normal(len(time))
    return Barometer(time, standard_pressure(height))
