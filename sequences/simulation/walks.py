"""Generated walks of a person with a device, as input to the simulator; a seed defines each walk.

A walk is a route (where the person goes), a gait that follows its speed, and a carrying mode (how
the device moves relative to the person). Step rate and motion at a speed are those of a recorded
person (`strides`), who walks slowly with short steps rather than with few.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import check_choice, generator
from stario.sequences.attitude.rotations import about_z
from stario.sequences.attitude.stacks import composed
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, Trajectory
from stario.sequences.settings import check_number
from stario.sequences.simulation.carrying import CARRYING_MODES, carry_motion, drawn_person
from stario.sequences.simulation.routes import RISER, Route, drift, integral, random_route, smoothed
from stario.sequences.simulation.strides import CarryMotion, Gait, StrideCycle, step_rate

MAX_SAMPLES = 2_000_000
"""Most samples of a simulated recording, which is about half a gigabyte as CSV."""

_SLOWEST_STEP_RATE = 0.8
"""Step rate of a person who barely moves [Hz]."""

_FACING = 0.1
"""Speed ahead [m/s] that a person's steps have when they turn on the spot: those go nowhere."""

_CHANGE = 0.6
"""Standard deviation of the Gaussian that smooths the change of carrying mode [s]."""


@dataclass(frozen=True)
class WalkStyle:
    """A person, and how the person carries the device.

    Attributes:
        carry: carrying mode, one of `CARRYING_MODES`.
        next_carry: carrying mode after a change within the walk; empty for no change.
        height: height of the person [m].
        preferred_speed: preferred speed [m/s].
        mount_rotvec: rotation vector from H (x ahead, y left, z up) to the device's neutral
            attitude [rad], of any size; None for that of the recorded person.

    Raises:
        InputError: a carrying mode is unknown or a value is out of range.
    """

    carry: str = "handheld"
    next_carry: str = ""
    height: float = 1.75
    preferred_speed: float = 1.2
    mount_rotvec: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        check_choice("carry", self.carry, CARRYING_MODES)
        if self.next_carry:
            check_choice("next_carry", self.next_carry, CARRYING_MODES)
        for name, low, high in _RANGES:
            check_number(self, name, low, high)
        mount = self.mount_rotvec
        if mount is not None and (len(mount) != 3 or not all(map(math.isfinite, mount))):
            raise InputError("mount_rotvec", repr(mount), "three finite angles [rad]")

    @staticmethod
    def random(rng: np.random.Generator, without: Collection[str] = ()) -> WalkStyle:
        """Draw a person and a carrying mode, none of `without` (about a third of walks change)."""
        style = _drawn_style(rng)
        while style.carry in without or style.next_carry in without:
            style = _drawn_style(rng)
        return style


def _drawn_style(rng: np.random.Generator) -> WalkStyle:
    carry = str(rng.choice(CARRYING_MODES, p=_ODDS))
    # A device is not put onto a trolley, or taken off it, within a step or two.
    others = [mode for mode in CARRYING_MODES if mode not in (carry, "trolley")]
    changes = carry != "trolley" and rng.random() < 1.0 / 3.0
    return WalkStyle(
        carry=carry,
        next_carry=str(rng.choice(others)) if changes else "",
        height=float(np.clip(rng.normal(1.72, 0.1), 1.45, 2.0)),
        preferred_speed=float(np.clip(rng.normal(1.05, 0.3), 0.5, 1.8)),
    )


_RANGES = (
    ("height", 1.0, 2.5),
    ("preferred_speed", 0.3, 2.2),
)

_ODDS = (0.16, 0.07, 0.07, 0.08, 0.14, 0.08, 0.06, 0.1, 0.1, 0.14)
"""Probability of each carrying mode, in the order of `CARRYING_MODES`."""

_NO_PHONES = ("trolley", "rig")
"""Carrying modes whose ways the weights do not know."""


def generate_walk(
    seed: int,
    duration: float = 60.0,
    rate: float = 100.0,
    style: WalkStyle | None = None,
    corridors: bool = False,
    plain: bool = False,
) -> Trajectory:
    """Generate the trajectory of a carried device.

    Args:
        seed: seed of every draw; the same seed gives the same walk.
        duration: duration [s], minimum 1.
        rate: rate of the poses [Hz], minimum 50, so that harmonics are not aliased.
        style: person and carrying mode; None draws them.
        corridors: whether to walk along the corridors of a floor instead of anywhere.
        plain: whether to take no stairs, which an IMU alone does not notice, and to draw neither a
            trolley nor a rig.

    Returns:
        Poses of the device in a world frame whose origin is the start on the floor.

    Raises:
        InputError: duration, rate or seed out of range, or more than `MAX_SAMPLES` poses.
    """
    if not (math.isfinite(duration) and duration >= 1.0):
        raise InputError("duration", repr(duration), "a finite duration of at least 1 s")
    if not (math.isfinite(rate) and rate >= 50.0):
        raise InputError("rate", repr(rate), "a finite rate of at least 50 Hz")
    check_amount(duration, rate)
    rng = generator(seed)
    if style is None:
        style = WalkStyle.random(rng, without=_NO_PHONES if plain else ())
    count = round(duration * rate) + 1
    wheels = style.carry == "trolley"
    route = random_route(rng, count, rate, style.preferred_speed, wheels, corridors, plain)
    return carried_along(rng, route, rate, style)


def carried_along(
    rng: np.random.Generator, route: Route, rate: float, style: WalkStyle
) -> Trajectory:
    """Return the poses of a device that a person carries along a route sampled at `rate` [Hz]."""
    n = len(route.heading)
    modes = [carry for carry in (style.carry, style.next_carry) if carry]
    people = [drawn_person(rng, carry, style.preferred_speed) for carry in modes]
    later = np.zeros(n)
    if style.next_carry:
        after = np.arange(n) > n * rng.uniform(0.25, 0.75)
        later = smoothed(after.astype(np.float64), rate, _CHANGE)
    gait = _gait(rng, rate, route, style.height, people, later)
    motion = carry_motion(gait, modes[0], people[0])
    if style.next_carry:
        second = carry_motion(gait, modes[1], people[1])
        motion = _changed(motion, second, later[:, None])
    mount = style.mount_rotvec
    neutral_HB = motion.neutral_HB if mount is None else Rotation.from_rotvec(mount)
    R_WH = about_z(route.heading)
    R_HB = composed(Rotation.from_rotvec(motion.turn_H), neutral_HB)
    return Trajectory(
        time=np.arange(n) / rate,
        position_W=route.position_W + R_WH.apply(motion.offset_H),
        attitude_WB=composed(R_WH, R_HB),
    )


def check_amount(duration: float, rate: float) -> None:
    """Raise InputError for more than `MAX_SAMPLES` within a duration [s] at a rate [Hz]."""
    if duration * rate > MAX_SAMPLES:
        most = f"at most {MAX_SAMPLES / rate:.0f} s at {rate:g} Hz ({MAX_SAMPLES} samples)"
        raise InputError("duration", f"{duration:g} s", most)


def _gait(
    rng: np.random.Generator,
    rate: float,
    route: Route,
    height: float,
    people: list[StrideCycle],
    later: FloatArray,
) -> Gait:
    """Return the gait of one recorded person, or of one and, by the weight `later`, another."""
    n = len(route.heading)
    # Turning on the spot takes steps too: the feet move on a circle with a radius of 0.3 m.
    moving = np.hypot(route.speed, 0.3 * route.turn_rate)
    uneven = 1.0 + 0.025 * drift(rng, n, rate, 0.4)
    stairs = np.abs(route.climb) / RISER
    wanted = (1.0 - later) * step_rate(people[0], moving) + later * step_rate(people[-1], moving)
    wanted = np.stack([wanted, stairs, np.full(n, _SLOWEST_STEP_RATE)])
    steps = uneven * np.sum(wanted**8, axis=0) ** 0.125  # the largest of the three, smoothly
    course = np.add(route.velocity_H, [_FACING, 0.0])
    return Gait(
        rng=rng,
        rate=rate,
        phase=rng.uniform(0.0, 2.0 * np.pi) + np.pi * integral(steps, rate),
        step_rate=steps,
        pace=np.hypot(moving, 0.8 * stairs),
        speed=route.speed,
        course=course / np.hypot(0.5 * _FACING, np.hypot(*course.T))[:, None],
        height=height,
    )


def _changed(first: CarryMotion, second: CarryMotion, later: FloatArray) -> CarryMotion:
    """Return the motion of a device that is put elsewhere, and so to another attitude."""
    put = (second.neutral_HB * first.neutral_HB.inv()).as_rotvec()
    turn = Rotation.from_rotvec((1.0 - later) * first.turn_H + later * second.turn_H)
    turn = turn * Rotation.from_rotvec(later * put)
    offset = (1.0 - later) * first.offset_H + later * second.offset_H
    return CarryMotion(offset, turn.as_rotvec(), first.neutral_HB)
