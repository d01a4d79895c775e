"""Routes of simulated pedestrians: speed, course, heading and height over time.

A route is a sequence of random activities (walk straight, along a curve, around a corner, turn on
the spot, stand, step sideways or backward, climb stairs), each a constant command for some time.
Smoothing the commands with a Gaussian gives gradual changes like a person's and makes the route
infinitely differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from stario.sequences.sequence import FloatArray

RISER, TREAD = 0.17, 0.29
"""Height and depth of a stair [m]."""


@dataclass(frozen=True, eq=False)
class Route:
    """Motion of the person's body at regular times, without the gait.

    Attributes:
        position_W: (N, 3) point on the floor below the person [m].
        heading: (N,) direction that the person faces [rad].
        velocity_H: (N, 2) velocity over the floor, ahead and to the left [m/s].
        turn_rate: (N,) rate of change of the heading [rad/s].
        climb: (N,) vertical speed on stairs [m/s], negative when descending.
    """

    position_W: FloatArray
    heading: FloatArray
    velocity_H: FloatArray
    turn_rate: FloatArray
    climb: FloatArray

    @property
    def speed(self) -> FloatArray:
        """(N,) speed over the floor [m/s]."""
        return np.asarray(np.hypot(*self.velocity_H.T))


class Command(NamedTuple):
    """Duration [s], speed [m/s], turn rate [rad/s], course from the heading [rad], climb [m/s].

    `lift` is a vertical speed [m/s] without steps.
    """

    duration: float
    speed: float
    turn_rate: float = 0.0
    course: float = 0.0
    climb: float = 0.0
    lift: float = 0.0


def random_route(
    rng: np.random.Generator,
    count: int,
    rate: float,
    preferred_speed: float,
    wheels: bool = False,
    corridors: bool = False,
    level: bool = False,
) -> Route:
    """Draw a route of `count` samples at `rate` [Hz].

    Args:
        rng: random generator for all draws.
        count: number of samples.
        rate: sampling rate [Hz].
        preferred_speed: preferred speed [m/s]; actual speeds are 0.3 to 2.2 m/s, 0 when standing.
        wheels: whether the person pushes a trolley: no stairs, no steps sideways or backward.
        corridors: whether the person walks along the corridors of a floor instead of anywhere.
        level: whether the person takes no stairs.
    """
    commands: list[Command] = []
    while sum(command.duration for command in commands) < count / rate:
        if corridors:
            commands += corridor(rng, preferred_speed)
        else:
            commands += _activity(rng, preferred_speed, wheels, level or wheels)
    return route_along(rng, commands, count, rate, corridors)


def route_along(
    rng: np.random.Generator, commands: list[Command], count: int, rate: float, walls: bool
) -> Route:
    """Return the route (count samples at `rate` [Hz]) of commands; `walls` keep the heading."""
    table = np.array(commands)
    repeats = np.diff(np.round(np.cumsum([0.0, *table[:, 0]]) * rate))
    held = np.repeat(table[:, 1:], repeats.astype(np.int64), axis=0)[:count]
    # A course means nothing without its speed: smooth velocity components, not the angle.
    velocity_H = held[:, :1] * np.stack([np.cos(held[:, 2]), np.sin(held[:, 2])], axis=1)
    sigma = rng.uniform(0.2, 0.35)
    velocity_H = smoothed(velocity_H, rate, sigma)
    wander = drift(rng, count, rate, 1.5)
    # Walls keep the heading, not only the rate of turn, near what was commanded.
    wander = 0.1 * np.gradient(wander, 1.0 / rate) if walls else 0.08 * wander
    turn_rate = smoothed(held[:, 1], rate, sigma) + wander
    climb = smoothed(held[:, 3], rate, sigma)
    heading = rng.uniform(-np.pi, np.pi) + integral(turn_rate, rate)
    c, s = np.cos(heading), np.sin(heading)
    forward, left = velocity_H.T
    up = climb + smoothed(held[:, 4], rate, sigma)
    velocity_W = np.stack([c * forward - s * left, s * forward + c * left, up], axis=1)
    return Route(integral(velocity_W, rate), heading, velocity_H, turn_rate, climb)


def _activity(
    rng: np.random.Generator, preferred: float, wheels: bool, level: bool
) -> list[Command]:
    speed = float(np.clip(preferred * rng.uniform(0.6, 1.4), 0.3, 2.2))
    side = float(rng.choice([-1.0, 1.0]))
    kinds = ["straight", "curve", "corner", "spot", "stand", "sidle", "stairs", "slow"]
    odds = np.array([0.28, 0.24, 0.2, 0.06, 0.07, 0.05, 0.06, 0.04])
    odds[[kinds.index("sidle"), kinds.index("stairs")]] *= [not wheels, not level]
    kind = rng.choice(kinds, p=odds / odds.sum())
    if kind == "curve":
        radius = rng.uniform(0.8, 6.0)
        turn_rate = min(speed / radius, 1.5)
        angle = rng.uniform(0.3, 2.0) * np.pi
        return [Command(min(angle / turn_rate, 12.0), speed, side * turn_rate)]
    if kind == "corner":
        turn_rate = rng.uniform(1.2, 3.0)
        angle = rng.uniform(0.4, 1.6)
        slowed = speed * rng.uniform(0.5, 1.0)
        return [
            Command(rng.uniform(0.8, 4.0), speed),
            Command(angle / turn_rate, slowed, side * turn_rate),
        ]
    if kind == "spot":
        turn_rate = rng.uniform(0.8, 2.5)
        turn = Command(rng.uniform(0.8, 3.3) / turn_rate, 0.0, side * turn_rate)
        return [Command(0.6, 0.0), turn, Command(rng.uniform(0.2, 1.5), 0.0)]
    if kind == "stand":
        return [Command(rng.uniform(1.0, 6.0), 0.0)]
    if kind == "sidle":
        course = side * rng.uniform(0.4, 1.0) * np.pi
        return [Command(rng.uniform(1.0, 3.0), rng.uniform(0.3, 0.7), 0.0, course)]
    if kind == "stairs":
        steps_per_second = rng.uniform(1.3, 2.0)
        climb = side * RISER * steps_per_second
        flight = rng.integers(6, 18) / steps_per_second
        return [Command(flight, TREAD * steps_per_second, 0.0, 0.0, climb)]
    if kind == "slow":
        return [Command(rng.uniform(2.0, 5.0), rng.uniform(0.3, 0.6))]
    return [Command(rng.uniform(1.5, 7.0), speed)]


def corridor(rng: np.random.Generator, preferred: float) -> list[Command]:
    """Draw a straight of 5 to 20 m, a pause at one of seven doors, and a corner."""
    speed = float(np.clip(preferred * rng.uniform(0.85, 1.15), 0.3, 2.2))
    turn_rate = rng.uniform(1.2, 2.2)
    pause = [Command(rng.uniform(1.0, 5.0), 0.0)] if rng.random() < 1.0 / 7.0 else []
    return [
        Command(rng.uniform(5.0, 20.0) / speed, speed),
        *pause,
        Command(0.5 * np.pi / turn_rate, 0.7 * speed, float(rng.choice([-1.0, 1.0])) * turn_rate),
    ]


def integral(values: FloatArray, rate: float) -> FloatArray:
    """Return the trapezoidal integral along the first axis, starting at 0."""
    steps = 0.5 * (values[1:] + values[:-1]) / rate
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(steps, axis=0)])


def smoothed(values: FloatArray, rate: float, sigma: float) -> FloatArray:
    """Convolve with a Gaussian of deviation `sigma` [s] along the first axis, holding the ends."""
    pad = int(np.ceil(5.0 * sigma * rate))
    padded = np.concatenate([np.repeat(values[:1], pad, 0), values, np.repeat(values[-1:], pad, 0)])
    gain = np.exp(-0.5 * (2.0 * np.pi * sigma * rfftfreq(len(padded), 1.0 / rate)) ** 2)
    spectrum = rfft(padded, axis=0) * gain.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(irfft(spectrum, n=len(padded), axis=0)[pad : pad + len(values)])


def drift(
    rng: np.random.Generator, count: int, rate: float, sigma: float, columns: int = 0
) -> FloatArray:
    """Draw smooth noise of unit deviation and a correlation time of about `sigma` [s].

    Returns:
        (count,), or (count, columns) if `columns` is not 0.
    """
    padded = next_fast_len(count + int(np.ceil(10.0 * sigma * rate)), real=True)
    # White noise smoothed by a Gaussian has frequencies of up to 6 of its deviations.
    bins = min(padded // 2, int(np.ceil(6.0 / (2.0 * np.pi * sigma) * padded / rate)))
    gain = np.exp(-0.5 * (2.0 * np.pi * sigma * np.arange(bins) * rate / padded) ** 2)
    noise = rng.standard_normal((max(columns, 1), 2 * bins)).view(np.complex128)
    noise *= 0.5 * padded * gain / np.sqrt(np.sum(gain[1:] ** 2) + 0.25)
    drawn = irfft(noise, padded, axis=1)[:, :count]
    return np.asarray(drawn.T if columns else drawn[0])


def band_noise(
    rng: np.random.Generator, count: int, rate: float, low: float, high: float, columns: int
) -> FloatArray:
    """Draw noise (count, columns) of unit deviation between `low` and `high` [Hz], soft edges."""
    f = rfftfreq(count, 1.0 / rate)
    gain = np.exp(-0.5 * ((f - 0.5 * (low + high)) / (0.5 * (high - low))) ** 2)
    gain[0] = 0.0
    white = rfft(rng.standard_normal((count, columns)), axis=0)
    noise = irfft(white * gain[:, None], n=count, axis=0)
    # White noise spreads its variance evenly over the bins, each but the first counted twice.
    return np.asarray(noise / np.sqrt(2.0 * np.sum(gain**2) / count))
