"""A walk from the street through a house with stairs and a lift, with all that a phone measures.

The first part is on the street, half of it between houses. In the house the person walks along
corridors, climbs stairs of two flights for each floor, and rides a lift.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stario.sequences.arrays import generator
from stario.sequences.errors import InputError
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import ImuSequence, PositionTrack, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, ImuErrors, simulate_imu
from stario.sequences.simulation.magnetometer import INDOOR_FIELD
from stario.sequences.simulation.outside_sensors import (
    PLACE,
    latlon_at,
    simulate_barometer,
    simulate_satellites,
)
from stario.sequences.simulation.routes import TREAD, Command, corridor, route_along
from stario.sequences.simulation.walks import WalkStyle, carried_along, check_amount

FLOOR_HEIGHT = 3.0
"""Height of a floor [m]."""

LOWEST, HIGHEST = -2, 4
"""Floors of the house; the street is at 0."""

SHORTEST = 120.0
"""Shortest walk [s]: long enough for a change of floors."""

_RISERS = 18
"""Number of stairs of a floor, in two flights."""

_STREET_SHARE = 0.25
"""Part of the walk that is on the street."""

_STREAM = 0x686F7573
"""Seed of the house's separate draws."""

_RATE = 100.0
"""Rate of the poses [Hz]."""

HANDHELD = WalkStyle()
"""A typical person with the device in the hand."""

Way = Literal["street", "stairs", "lift"]


@dataclass(frozen=True)
class Stay:
    """A stay on one floor.

    Attributes:
        start: its first instant [s].
        stop: its last instant, at the foot of the stairs or as the lift starts [s].
        floor: the floor, 0 at the level of the street.
        way: the way on which the person came there.
    """

    start: float
    stop: float
    floor: int
    way: Way


@dataclass(frozen=True)
class HouseWalk:
    """A simulated walk through a house.

    Attributes:
        sequence: IMU, magnetometer, barometer, satellites and true poses; `positions` are
            waypoints at the first and last instant of each stay in the house, with floors and
            coordinates.
        stays: the stays on floors, in order; the first is that on the street.
    """

    sequence: ImuSequence
    stays: list[Stay]


@dataclass
class _Plan:
    """Commands of a walk under construction, its stays and the doors passed."""

    commands: list[Command] = field(default_factory=list)
    stays: list[Stay] = field(default_factory=list)
    doors: list[float] = field(default_factory=list)

    @property
    def time(self) -> float:
        return sum(command.duration for command in self.commands)


def simulate_house(
    seed: int,
    duration: float = 180.0,
    rate: float = 200.0,
    style: WalkStyle | None = HANDHELD,
    errors: ImuErrors = PHONE_IMU,
    name: str = "house",
) -> HouseWalk:
    """Simulate a walk from the street through a house.

    Args:
        seed: seed of every draw; the same seed gives the same walk.
        duration: duration [s], at least `SHORTEST`.
        rate: sampling rate of the IMU [Hz].
        style: person and carrying mode; None draws them.
        errors: errors of the IMU.
        name: name of the recording.

    Raises:
        InputError: the duration is too short or too long, the device is on a trolley, or the seed
            is not an integer >= 0.
    """
    if not duration >= SHORTEST:
        raise InputError("duration", f"{duration:g} s", f"at least {SHORTEST:g} s")
    check_amount(duration, max(rate, _RATE))
    rng = generator(seed, _STREAM)
    if style is None:
        style = WalkStyle.random(rng, without=("trolley",))
    if style.carry == "trolley":
        raise InputError("carry", "trolley", "a device that a person carries on stairs")
    place = replace(PLACE, yaw=PLACE.yaw - float(rng.uniform(-np.pi, np.pi)))
    plan = _plan(rng, duration, style.preferred_speed)
    route = route_along(rng, plan.commands, round(duration * _RATE) + 1, _RATE, walls=True)
    walk = carried_along(rng, route, _RATE, style)
    sequence = simulate_imu(walk, rate, errors, seed, name=name, magnetic_field=INDOOR_FIELD)
    entered = plan.stays[0].stop
    between_houses, indoors = walk.time > 0.5 * entered, walk.time > entered
    sequence = replace(
        sequence,
        positions=_waypoints(walk, plan.stays[1:], place),
        barometer=simulate_barometer(walk, np.array(plan.doors), seed),
        satellites=simulate_satellites(walk, place, between_houses, indoors, seed),
    )
    return HouseWalk(sequence, plan.stays)


def _plan(rng: np.random.Generator, duration: float, preferred_speed: float) -> _Plan:
    """Return the plan of a walk that ends with a stay."""
    plan = _Plan()
    _stay(rng, plan, preferred_speed, 0, "street", _STREET_SHARE * duration)
    plan.doors.append(plan.time)
    way: Way = "stairs" if rng.random() < 0.5 else "lift"
    floor, came = 0, plan.stays[0].way
    while True:
        start = plan.time
        _stay(rng, plan, preferred_speed, floor, came, float(rng.uniform(8.0, 20.0)))
        target = _next_floor(rng, floor, way)
        passage = _stairs(rng, target - floor) if way == "stairs" else _lift(rng, target - floor)
        seconds = sum(command.duration for command in passage)
        if plan.time + seconds > duration - 10.0:
            break
        plan.doors += [plan.time, plan.time + seconds]
        plan.commands += passage
        floor, came, way = target, way, "lift" if way == "stairs" else "stairs"
    plan.stays.pop()
    _stay(rng, plan, preferred_speed, floor, came, duration - plan.time)
    plan.stays[-1] = Stay(start, duration, floor, came)
    return plan


def _stay(
    rng: np.random.Generator, plan: _Plan, speed: float, floor: int, way: Way, seconds: float
) -> None:
    """Add a stay of at least so many seconds."""
    start = plan.time
    while plan.time < start + seconds:
        plan.commands += corridor(rng, speed)
    plan.stays.append(Stay(start, plan.time, floor, way))


def _next_floor(rng: np.random.Generator, floor: int, way: Way) -> int:
    most = 2 if way == "stairs" else HIGHEST - LOWEST
    floors = [k for k in range(LOWEST, HIGHEST + 1) if 0 < abs(k - floor) <= most]
    return int(rng.choice(floors))


def _stairs(rng: np.random.Generator, floors: int) -> list[Command]:
    """Return the commands for stairs with a landing, where the person turns, after each flight."""
    pace, side = rng.uniform(1.4, 1.9), float(rng.choice([-1.0, 1.0]))
    climb = np.sign(floors) * FLOOR_HEIGHT / _RISERS * pace
    flight = Command(0.5 * _RISERS / pace, TREAD * pace, climb=float(climb))
    landing = Command(np.pi / 1.6, 0.5, 1.6 * side)
    return [Command(0.5, 0.5), *[flight, landing] * (2 * abs(floors))]


def _lift(rng: np.random.Generator, floors: int) -> list[Command]:
    """Return the commands for waiting, a ride that gathers speed within a second, and leaving."""
    speed, ramp = rng.uniform(0.8, 1.6), 0.3
    speeds = [share * speed * np.sign(floors) for share in (0.25, 0.5, 0.75)]
    ride = abs(floors) * FLOOR_HEIGHT / speed - 3.0 * ramp
    return [
        Command(rng.uniform(3.0, 6.0), 0.0),
        *(Command(ramp, 0.0, lift=v) for v in speeds),
        Command(ride, 0.0, lift=speed * float(np.sign(floors))),
        *(Command(ramp, 0.0, lift=v) for v in speeds[::-1]),
        Command(rng.uniform(1.5, 3.0), 0.0),
    ]


def _waypoints(walk: Trajectory, stays: list[Stay], place: Georeference) -> PositionTrack:
    """Return the device's positions at the beginning and the end of each stay."""
    time = np.array([t for stay in stays for t in (stay.start, stay.stop)])
    position_W = walk.at(time).position_W
    floor = np.repeat([float(stay.floor) for stay in stays], 2)
    latlon_deg = latlon_at(place, position_W)
    return PositionTrack(time, position_W, "waypoints", latlon_deg=latlon_deg, floor=floor)
