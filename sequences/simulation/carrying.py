"""Carrying modes: how a device moves relative to a walking person, in the heading frame H.

H has x forward, y left, z up and its origin on the floor below the person. Every carrying mode
gives the device's offset in H [m] and its rotation from a neutral attitude as a rotation vector in
H [rad]. What a device in a hand, a pocket or a bag does with the stride is that of recorded people
(`strides`); what a trolley does is measured as well, and a rig, which nobody has recorded, is
described here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import FloatArray
from stario.sequences.simulation.routes import band_noise, drift, smoothed
from stario.sequences.simulation.strides import (
    CarryMotion,
    Gait,
    StrideCycle,
    drawn_cycle,
    on_other_side,
    stride_motion,
)


@dataclass(frozen=True)
class Place:
    """Where a device is carried, and how steadily.

    Attributes:
        least, most: range of where it is, ahead and aside [m] and up, in heights of the person.
        restless: size of its turning that no stride explains [rad], within about a second.
        tremor: angular rate of a hand's tremor [rad/s].
        either_side: whether it is as often on the other side of the body; held flat in front it is
            on the same side in all sixteen recordings.
    """

    least: tuple[float, float, float]
    most: tuple[float, float, float]
    restless: float
    tremor: float = 0.0
    either_side: bool = True


PLACES = {
    "handheld": Place((0.2, -0.2, 0.7), (0.45, 0.2, 0.7), 0.05, 0.05),
    "in-front": Place((0.2, -0.2, 0.7), (0.45, 0.2, 0.7), 0.05, 0.05, either_side=False),
    "texting": Place((0.2, -0.1, 0.72), (0.4, 0.1, 0.72), 0.04, 0.03),
    "call": Place((0.05, -0.1, 0.93), (0.05, 0.1, 0.93), 0.1, 0.03),
    "swinging": Place((-0.05, -0.25, 0.43), (0.05, 0.25, 0.43), 0.1),
    "pocket": Place((0.08, -0.12, 0.4), (0.08, 0.12, 0.47), 0.08),
    "back-pocket": Place((-0.1, -0.12, 0.46), (-0.1, 0.12, 0.5), 0.1),
    "bag": Place((-0.15, -0.2, 0.55), (0.12, 0.2, 0.75), 0.08),
}
"""Places of the ways of carrying that are recorded."""

_RIG = Place((0.3, 0.0, 0.75), (0.3, 0.0, 0.75), 0.05, 0.06)

_RUMBLE_SPEED = 0.73
_RUMBLE = (
    (3.0, 6.0, 0.5, (0.05, 0.07, 0.03), (0.007, 0.004, 0.004)),
    (6.0, 10.0, 0.5, (0.05, 0.11, 0.06), (0.007, 0.004, 0.003)),
    (10.0, 20.0, 1.0, (0.10, 0.11, 0.37), (0.008, 0.029, 0.002)),
    (20.0, 45.0, 1.2, (0.24, 0.10, 0.26), (0.008, 0.038, 0.005)),
)
"""A trolley's rumble at that speed [m/s]: lowest and highest frequency [Hz], exponent of the speed,
root mean squares of acceleration [m/s^2] and angular rate [rad/s] ahead, to the left and up. These
are the medians of 440 stretches of OxIOD's six recordings on a trolley."""

_ON_TROLLEY = (0.04, -0.05, -1.516)
"""Rotation vector of a phone's mean attitude there: flat, its upper end ahead [rad]."""

CARRYING_MODES = (*PLACES, "trolley", "rig")
"""Names of the carrying modes."""


def drawn_person(rng: np.random.Generator, carry: str, speed: float) -> StrideCycle:
    """Draw a person who carries a device so; one with a trolley or a rig walks as with a phone."""
    return drawn_cycle(rng, carry if carry in PLACES else "handheld", speed)


def carry_motion(gait: Gait, carry: str, person: StrideCycle) -> CarryMotion:
    """Return the motion of a device that a person carries."""
    if carry == "trolley":
        return _trolley(gait)
    return _rig(gait, person) if carry == "rig" else _held(gait, PLACES[carry], person)


def _held(gait: Gait, place: Place, person: StrideCycle) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    other = rng.random() > 0.5 and place.either_side
    motion = stride_motion(gait, on_other_side(person) if other else person)
    offset = rng.uniform(place.least, place.most) * [1.0, 1.0, gait.height]
    offset = motion.offset_H + offset + 0.01 * drift(rng, n, gait.rate, 0.6, 3)
    turn = motion.turn_H + place.restless * drift(rng, n, gait.rate, 0.7, 3)
    # A hand trembles at 8 to 10 Hz, about the wrist, which displaces the device too.
    tremor = band_noise(rng, n, gait.rate, 5.0, 11.0, 6) / (2.0 * np.pi * 8.0)
    turn += place.tremor * tremor[:, :3]
    offset += 2.0 * place.tremor * tremor[:, 3:] / (2.0 * np.pi * 8.0)
    return replace(motion, offset_H=offset, turn_H=turn)


def _trolley(gait: Gait) -> CarryMotion:
    """Return a trolley's motion: the rumble of its wheels, which grows with speed, little gait."""
    rng, n = gait.rng, len(gait)
    floor = rng.uniform(0.7, 1.4) * (1.0 + 0.3 * drift(rng, n, gait.rate, 0.5, 1))
    speed = np.clip(gait.speed[:, None] / _RUMBLE_SPEED, 0.0, 2.0)
    offset, turn = np.zeros((n, 3)), 0.004 * drift(rng, n, gait.rate, 0.8, 3)
    for low, high, power, accel, rate in _RUMBLE:
        if high > 0.5 * gait.rate:
            break  # the poses cannot hold it
        noise = floor * speed**power * band_noise(rng, n, gait.rate, low, high, 6)
        to_angle = 1.0 / (2.0 * np.pi * math.sqrt(low * high))
        offset += to_angle**2 * noise[:, :3] * accel
        turn += to_angle * noise[:, 3:] * rate
    place = np.array([0.6, 0.0, rng.uniform(0.4, 1.0)])
    # The push pulses slightly with the steps of the person behind.
    offset[:, 0] += 0.002 * gait.pace * np.cos(2.0 * gait.phase)
    return CarryMotion(offset + place, turn, Rotation.from_rotvec(_ON_TROLLEY))


def _rig(gait: Gait, person: StrideCycle) -> CarryMotion:
    """Return a rig's motion: quick turns to random directions, arms waved by up to their length."""
    rng, n = gait.rng, len(gait)
    motion = _held(gait, _RIG, person)
    reach = np.array([0.2, 0.25, 0.2]) * rng.uniform(0.3, 1.1)
    waved = drift(rng, n, gait.rate, rng.uniform(0.25, 0.5), 3)
    lively = 0.5 * (1.0 + np.tanh(1.5 + 1.5 * drift(rng, n, gait.rate, 3.0, 1)))
    looks = _looks(gait, np.array([0.5, 0.5, 0.9]) * rng.uniform(0.5, 1.2))
    offset = reach * np.tanh(waved) * lively
    return replace(motion, offset_H=motion.offset_H + offset, turn_H=motion.turn_H + looks)


def _looks(gait: Gait, spread: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3) [rad] that rest at random values and move between them."""
    rng, n = gait.rng, len(gait)
    pause = rng.uniform(0.5, 1.6)
    targets = rng.normal(0.0, 1.0, (int(n / gait.rate / 0.25) + 2, 3)) * spread
    targets = np.clip(targets, -1.8 * spread, 1.8 * spread)
    rests = np.cumsum(rng.exponential(pause, len(targets)) + 0.25)
    held = targets[np.minimum(np.searchsorted(rests, np.arange(n) / gait.rate), len(targets) - 1)]
    return smoothed(held, gait.rate, rng.uniform(0.18, 0.3))
