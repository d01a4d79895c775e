"""Bad moments of a carried device: shaken, dropped, thrown, laid down, held still, lifted, driven.

Each is a motion relative to the pose at one instant of a recording. It begins and ends at that
pose, at rest except where noted, so that it can be inserted there (`insertion`). The frame L is
level, its origin the device's position at the instant.

The shake is how people calibrate a phone's compass before a walk: up to 17 rad/s about a wrist or
elbow, which presses the phone outwards by several m/s^2 (IPIN 2023, track 3). Sway, breathing and
tremor of a standing person are those of posturography: 5 mm, 0.25 Hz, 5 to 11 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.simulation.routes import band_noise, drift, smoothed

FASTEST_SHAKE, SLOWEST_SHAKE = 17.0, 3.0
"""Peak rate of a shake at its strongest and its weakest [rad/s]."""

_LEVER = 0.1
"""Distance of a shaken device from the axes that it is turned about [m]: the force of IPIN's shakes
is off gravity by 3.4 to 5.3 m/s^2 (root mean square) at their rates."""

_SWAY_RATE, _SWAY_SECONDS = math.radians(1.0), 6.0
"""Rate [rad/s] at which a standing person turns the device to and fro, and its correlation time."""

_DROP_HEIGHT, _BOUNCE = 1.0, 0.4
"""Height that a phone falls from [m], and the part of its speed with which it leaves the floor."""

_LIFT_HEIGHT, _LIFT_SPEED, _LIFT_ACCELERATION = 12.0, 1.6, 0.9
"""Way [m], speed [m/s] and acceleration [m/s^2] of a lift."""

_THROW_HEIGHT, _THROW_TURNS = 1.2, 2.0
"""Height to which a phone is thrown [m], and its turns until it is caught."""

_BUS_SPEED, _BUS_ACCELERATION, _BUS_VIBRATION = 12.0, 1.2, 0.6
"""Speed [m/s] and acceleration [m/s^2] of a bus, and of its vibration at 2 to 15 Hz (root mean
square)."""


@dataclass(frozen=True, eq=False)
class MomentMotion:
    """Motion of a device during a moment, at N times.

    Attributes:
        offset_L: (N, 3) position relative to that at the instant [m].
        turn_L: (N, 3) rotation vector about L's axes, from the attitude at the instant [rad].
        field_turn: (N,) angle about the vertical by which the magnetic field is turned [rad].
        field_scale: (N,) factor on its size.
    """

    offset_L: FloatArray
    turn_L: FloatArray
    field_turn: FloatArray
    field_scale: FloatArray


Motion = Callable[[np.random.Generator, FloatArray, Rotation], MomentMotion]
"""Function of a random generator, evenly spaced times (N,) from 0 [s], and the attitude R_LB."""


@dataclass(frozen=True)
class Moment:
    """A bad moment: its name, its length [s], and its motion."""

    name: str
    seconds: float
    motion: Motion


def _in_same_field(offset_L: FloatArray, turn_L: FloatArray) -> MomentMotion:
    n = len(offset_L)
    return MomentMotion(offset_L, turn_L, np.zeros(n), np.ones(n))


def ramp(share: FloatArray) -> FloatArray:
    """Return a smooth step (N,) from 0 at share 0 to 1 at share 1, at rest at both (quintic)."""
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


def _within(time: FloatArray, edge: float) -> FloatArray:
    """Return 1 (N,) but for a smooth rise from 0 at the start and fall to 0 at the end [s]."""
    return ramp(time / edge) * ramp((time[-1] - time) / edge)


def _rate(time: FloatArray) -> float:
    return float(1.0 / (time[1] - time[0]))


def _shake(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    rate, n = _rate(time), len(time)
    turn = band_noise(rng, n, rate, 0.8, 2.5, 3)
    share = 0.5 + 0.5 * np.tanh(drift(rng, n, rate, 1.5))
    slow = SLOWEST_SHAKE / FASTEST_SHAKE
    turn *= ((slow + (1.0 - slow) * share) * _within(time, 1.0))[:, None]
    for _ in range(3):  # the rate of a rotation vector is not quite its derivative
        turns = Rotation.from_rotvec(turn)
        peak = rate * float((turns[:-1].inv() * turns[1:]).magnitude().max())
        turn *= FASTEST_SHAKE / peak
    lever = _LEVER * about_z(rng.uniform(0.0, 2.0 * np.pi)).apply([0.8, 0.0, -0.6])
    return _in_same_field(Rotation.from_rotvec(turn).apply(lever) - lever, turn)


def _drop(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    """Fall and tumble once, bounce on the floor, lie there, be taken up again."""
    dropped = 2.5
    fall = math.sqrt(2.0 * _DROP_HEIGHT / STANDARD_GRAVITY)
    height = np.where(time < dropped, _DROP_HEIGHT, 0.0)
    falling = (time >= dropped) & (time < dropped + fall)
    height[falling] = _DROP_HEIGHT - 0.5 * STANDARD_GRAVITY * (time[falling] - dropped) ** 2
    at, speed = dropped + fall, _BOUNCE * STANDARD_GRAVITY * fall
    while speed > 0.1:
        length = 2.0 * speed / STANDARD_GRAVITY
        since = time - at
        up = (since >= 0.0) & (since < length)
        height[up] = since[up] * (speed - 0.5 * STANDARD_GRAVITY * since[up])
        at, speed = at + length, _BOUNCE * speed
    # An impact lasts some ten milliseconds.
    height = smoothed(height, _rate(time), 0.008)
    taken = ramp((time - (time[-1] - 3.0)) / 2.0)
    landed = ramp((time - dropped) / (at - dropped))
    lying = landed - taken
    height += _DROP_HEIGHT * (taken - 1.0)
    away = about_z(rng.uniform(0.0, 2.0 * np.pi)).apply([1.0, 0.0, 0.0])
    slid = 0.3 * (ramp((time - dropped - fall) / 0.6) - taken)
    offset = slid[:, None] * away + height[:, None] * [0.0, 0.0, 1.0]
    tumble = Rotation.from_rotvec(2.0 * np.pi * landed[:, None] * away)
    turn = tumble * Rotation.from_rotvec(lying[:, None] * _to_flat(rng, attitude_LB))
    return _in_same_field(offset, turn.as_rotvec())


def _laid_down(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    lying = ramp((time - 1.0) / 2.0) * ramp((time[-1] - 1.0 - time) / 2.0)
    table = about_z(rng.uniform(0.0, 2.0 * np.pi)).apply([0.5, 0.0, -0.3])
    return _in_same_field(lying[:, None] * table, lying[:, None] * _to_flat(rng, attitude_LB))


def _to_flat(rng: np.random.Generator, attitude_LB: Rotation) -> FloatArray:
    """Return the rotation vector (3,) in L to an attitude flat on a level face [rad]."""
    flat = about_z(float(yaw_of(attitude_LB)[0]) + rng.uniform(-1.0, 1.0))
    return np.asarray((flat * attitude_LB.inv()).as_rotvec())


def _standing(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    rate, n = _rate(time), len(time)
    # The rate of this noise is its deviation over sqrt(2) times its time.
    yaw = math.sqrt(2.0) * _SWAY_SECONDS * _SWAY_RATE * drift(rng, n, rate, _SWAY_SECONDS)
    turn = 0.005 * drift(rng, n, rate, 1.5, 3) + yaw[:, None] * [0.0, 0.0, 1.0]
    offset = 0.005 * drift(rng, n, rate, 1.0, 3)
    offset[:, 2] += 0.002 * np.sin(2.0 * np.pi * 0.25 * time)
    tremor = band_noise(rng, n, rate, 5.0, 11.0, 6) / (2.0 * np.pi * 8.0)
    turn += 0.002 * tremor[:, :3]
    offset += 0.02 / (2.0 * np.pi * 8.0) * tremor[:, 3:]
    held = _within(time, 2.0)[:, None]
    return _in_same_field(held * offset, held * turn)


def _lift(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    motion = _standing(rng, time, attitude_LB)
    side = float(rng.choice([-1.0, 1.0]))
    inside = _within(time - time[0], 3.0)
    passed = ramp((time - 6.0) / (time[-1] - 12.0))
    angle = side * (0.9 + 0.3 * np.sin(2.0 * np.pi * 2.0 * passed))
    scale = 0.55 + 0.15 * np.sin(2.0 * np.pi * 3.0 * passed)
    climbed = side * _climb(time - 6.0)
    return MomentMotion(
        motion.offset_L + climbed[:, None] * [0.0, 0.0, 1.0],
        motion.turn_L,
        inside * angle,
        1.0 + inside * (scale - 1.0),
    )


def _climb(time: FloatArray) -> FloatArray:
    """Return the way (N,) [m] of a lift that starts at 0 s, with a soft trapezoid of speed."""
    rising = _LIFT_SPEED / _LIFT_ACCELERATION
    cruise = _LIFT_HEIGHT / _LIFT_SPEED
    rate = _rate(time)
    speed = np.interp(time, [0.0, rising, cruise, cruise + rising], [0.0, *[_LIFT_SPEED] * 2, 0.0])
    return np.cumsum(smoothed(speed, rate, 0.3)) / rate


def _throw(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    """Throw it up with some turns, catch it and hold it as before."""
    thrown, speed = 3.0, math.sqrt(2.0 * STANDARD_GRAVITY * _THROW_HEIGHT)
    caught = thrown + 2.0 * speed / STANDARD_GRAVITY
    instants = [thrown - 0.6, thrown - 0.45, thrown - 0.3, thrown, caught, caught + 0.1]
    speeds = [0.0, -0.5 * speed, 0.0, speed, -speed, 0.0]
    # A hand stops what it catches within some ten milliseconds.
    up = np.cumsum(smoothed(np.interp(time, instants, speeds), _rate(time), 0.01)) / _rate(time)
    up -= up[-1] * ramp((time - caught - 0.2) / 1.5)
    axis = about_z(rng.uniform(0.0, 2.0 * np.pi)).apply([1.0, 0.0, 0.0])
    angle = 2.0 * np.pi * _THROW_TURNS * ramp((time - thrown + 0.1) / (caught - thrown + 0.2))
    return _in_same_field(up[:, None] * [0.0, 0.0, 1.0], angle[:, None] * axis)


def _bus(rng: np.random.Generator, time: FloatArray, attitude_LB: Rotation) -> MomentMotion:
    """Stand in a bus of steel that starts, drives through a bend and back, and stops."""
    motion, rate = _standing(rng, time, attitude_LB), _rate(time)
    rising, stop = 5.0 + _BUS_SPEED / _BUS_ACCELERATION, float(time[-1]) - 5.0
    speeds = [0.0, _BUS_SPEED, _BUS_SPEED, 0.0]
    speed = smoothed(np.interp(time, [5.0, rising, stop - rising + 5.0, stop], speeds), rate, 0.4)
    bend = ramp((time - rising) / 10.0) - ramp((time - rising - 15.0) / 10.0)
    heading = rng.uniform(0.0, 2.0 * np.pi) + bend
    way = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(time))])
    vibration = band_noise(rng, len(time), rate, 2.0, 15.0, 3) / (2.0 * np.pi * 8.5) ** 2
    moving = (speed / _BUS_SPEED)[:, None]
    offset = np.cumsum(speed[:, None] * way, axis=0) / rate + _BUS_VIBRATION * moving * vibration
    turns = Rotation.from_rotvec(bend[:, None] * [0.0, 0.0, 1.0])
    turns *= Rotation.from_rotvec(motion.turn_L)
    inside = _within(time, 3.0)
    return MomentMotion(
        motion.offset_L + offset,
        turns.as_rotvec(),
        inside * (0.6 + 0.5 * bend),
        1.0 - 0.35 * inside,
    )


MOMENTS = (
    Moment("shake 10 s", 10.0, _shake),
    Moment("shake 25 s", 25.0, _shake),
    Moment("drop", 10.0, _drop),
    Moment("throw", 8.0, _throw),
    Moment("table", 20.0, _laid_down),
    Moment("standing", 60.0, _standing),
    Moment("lift", 24.0, _lift),
    Moment("bus", 60.0, _bus),
)
"""All moments."""
