"""Carrying modes: how a device moves relative to a walking person, in the heading frame H.

Every carrying mode gives the device's offset in H [m] and its rotation from a neutral attitude as a
rotation vector in H [rad]; person and frame are those of `gait`.

Bounce, surge, strength, resonance and damping of each mode are those that `stario check simulation`
finds in recordings carried so: phones in pockets, read, swung and at the ear (tyrex), in bags
(RIDI), in a hand in front (KIPD, RIDI, rfbr) and flat on it (Indoor Location).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import FloatArray
from stario.sequences.simulation.gait import (
    HELD_SURGE,
    SWAY,
    TRUNK_BOUNCE,
    TRUNK_SURGE,
    CarryMotion,
    Gait,
    Strike,
    hardly_growing,
    heel_strikes,
    trunk,
)
from stario.sequences.simulation.routes import band_noise, drift, smoothed

_STRIKES = {
    "handheld": Strike(
        0.5, 5.5, 0.3, (1.8, 132.0), 0.87, (0.25, 82.0), (0.41, 24.0), (0.37, 61.0), 0.4
    ),
    "in-front": Strike(
        1.85, 5.5, 0.3, (0.34, -77.0), 0.25, (0.36, 24.0), (0.17, 59.0), (0.22, -99.0), 0.4
    ),
    "texting": Strike(
        1.5, 5.5, 0.3, (0.41, -166.0), 0.39, (0.6, 49.0), (0.29, 28.0), (0.35, -67.0), 0.4
    ),
    "call": Strike(
        1.35, 5.5, 0.3, (0.65, 33.0), 0.49, (0.3, 50.0), (0.22, -63.0), (0.44, 169.0), 0.4
    ),
    "swinging": Strike(
        1.1, 5.5, 0.4, (0.8, -164.0), 0.59, (0.44, -103.0), (0.26, 86.0), (0.59, -168.0), 0.4
    ),
    "pocket": Strike(
        3.3, 8.5, 0.25, (0.67, -60.0), 0.7, (0.22, -28.0), (0.16, 58.0), (0.31, -95.0), 0.8
    ),
    "back-pocket": Strike(
        3.6, 7.0, 0.3, (0.68, 152.0), 0.73, (0.27, 67.0), (0.15, -84.0), (0.26, 115.0), 0.8
    ),
    "bag": Strike(
        1.25, 6.5, 0.5, (1.5, -142.0), 1.55, (0.27, 103.0), (0.33, -75.0), (0.22, 79.0), 0.7
    ),
    "rig": Strike(0.4, 5.5, 0.3, (0.8, 132.0), 0.6, (0.25, 82.0), (0.3, 24.0), (0.37, 61.0), 0.4),
}
"""What heel strikes excite in each way of carrying: strength, resonance and damping, then forward,
sideways, roll, pitch and yaw as `check simulation` and true attitudes show them from 3 to 10 Hz."""


def _held(
    gait: Gait,
    bounce: float,
    strike: Strike,
    tremor: float,
    wobble: float,
    pitch: float,
    surge: float = HELD_SURGE,
) -> CarryMotion:
    """Return the motion of a device held steady: trunk, heel strikes, gait wobble, hand tremor.

    `tremor` [rad/s] is the angular rate of the tremor, `wobble` [rad] the rotation with the stride,
    `pitch` the rate of pitch with the step per bounce [rad/s per m/s^2], `surge` the trunk's.
    """
    rng, n = gait.rng, len(gait)
    ring = heel_strikes(gait, strike)
    offset = trunk(gait, bounce, surge) + ring.offset_H
    offset += 0.012 * drift(rng, n, gait.rate, 0.6, 3)
    turn = ring.turn_H + 0.08 * drift(rng, n, gait.rate, 0.7, 3)
    turn += 0.8 * tremor / (2.0 * np.pi * 3.0) * band_noise(rng, n, gait.rate, 1.5, 5.0, 3)
    turn += tremor / (2.0 * np.pi * 8.0) * band_noise(rng, n, gait.rate, 5.0, 11.0, 3)
    turn += _wobble(gait, wobble, pitch * bounce)
    # The tremor about the wrist also displaces the device: about 0.1 m/s^2.
    offset += 0.12 / (2.0 * np.pi * 8.0) ** 2 * band_noise(rng, n, gait.rate, 5.0, 11.0, 3)
    return CarryMotion(offset, turn)


def _wobble(gait: Gait, wobble: float, pitch: float) -> FloatArray:
    """Return the turning (N, 3) [rad] of a held device with the gait.

    With the stride, roll and yaw follow the sway from side to side, by `wobble` [rad]. With the
    step, the rate of pitch, of size `pitch` [rad/s], leads the acceleration up by a quarter, as a
    forearm does that turns about the elbow; negative, it lags behind (by the true attitudes of
    KIPD, rfbr, RIDI and tyrex).
    """
    rng, phi = gait.rng, gait.phase[:, None]
    shift, size = rng.uniform(-0.7, 0.7, 4), rng.uniform(0.7, 1.3, 4)
    stride = np.sin(phi / 2.0 + shift[:3] + [0.0, 0.0, 0.6]) * size[:3] * [0.5, 0.2, -1.0]
    turn = wobble * hardly_growing(gait.effort)[:, None] * stride
    nod = size[3] * pitch * gait.effort * np.cos(gait.phase + shift[3])
    turn[:, 1] -= nod / (np.sqrt(2.0) * np.pi * gait.step_rate)
    return np.asarray(turn)


def _in_hand(
    gait: Gait,
    carry: str,
    bounce: float,
    tremor: float,
    wobble: float,
    pitch: float,
    reach: tuple[float, float, float] = (0.45, 0.2, 0.7),
    surge: float = HELD_SURGE,
) -> CarryMotion:
    """Return the motion of a device in one or two hands; other arguments as `_held`.

    `reach` is how far ahead and aside it is at most [m], and how high, in heights of the person.
    """
    rng, (ahead, aside, up) = gait.rng, reach
    motion = _held(gait, bounce, _STRIKES[carry], tremor, wobble, pitch, surge)
    place = [rng.uniform(0.2, ahead), rng.uniform(-aside, aside), up * gait.height]
    return CarryMotion(motion.offset_H + np.array(place), motion.turn_H)


def _call(gait: Gait) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    motion = _held(gait, 1.05, _STRIKES["call"], 0.06, 0.11, 0.05, 0.5)
    head = 0.4 * drift(rng, n, gait.rate, 1.0)
    arm = np.array([0.05, rng.choice([-1.0, 1.0]) * 0.1, 0.0])
    offset = motion.offset_H + np.array([0.0, 0.0, 0.93 * gait.height]) + _about(2, head, arm)
    turn = motion.turn_H + np.stack([0 * head, 0 * head, head], axis=1)
    return CarryMotion(offset, turn)


def _swinging(gait: Gait) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    amplitude = np.radians(33.0) * np.sqrt(gait.vigor)
    forward = np.radians(rng.uniform(8.0, 24.0))
    angle = _pendulum(gait, amplitude, forward, harmonic=0.12)
    side = rng.choice([-1.0, 1.0])
    # Elbow and shoulder give: the hand swings about a point below the shoulder.
    arm = np.array([0.0, 0.0, -0.27 * gait.height])
    pivot = np.array([0.0, side * 0.13 * gait.height, 0.7 * gait.height])
    ring = heel_strikes(gait, _STRIKES["swinging"])
    # Forward the hand also comes inward: the plane of the swing is turned.
    inward = Rotation.from_rotvec([0.0, 0.0, -side * rng.uniform(0.15, 0.4)])
    offset = pivot + inward.apply(_about(1, -angle, arm)) + trunk(gait, 3.0, TRUNK_SURGE)
    offset += ring.offset_H + 0.008 * drift(rng, n, gait.rate, 0.5, 3)
    twist = rng.uniform(0.1, 0.5) * angle + 0.08 * drift(rng, n, gait.rate, 0.7)
    roll = 0.08 * drift(rng, n, gait.rate, 0.7)
    turn = inward.apply(np.stack([roll, -angle, twist], axis=1))
    return CarryMotion(offset, turn + ring.turn_H)


def _on_thigh(
    gait: Gait,
    carry: str,
    swing: float,
    ahead: float,
    depths: tuple[float, float],
    bounce: float,
    surge: float,
    sway: float,
    pelvis: float,
) -> CarryMotion:
    """Return the motion of a device in trousers: it swings and shakes with the thigh.

    It swings by `swing` [deg], and is `ahead` of the hip [m] and below it by `depths`, in heights
    of the person; `pelvis` [rad] is the lag of its yaw behind the stride.
    """
    rng, n = gait.rng, len(gait)
    amplitude, below = np.radians(swing), -rng.uniform(*depths) * gait.height
    forward = np.radians(rng.uniform(0.0, 12.0))
    angle = _pendulum(gait, amplitude * np.sqrt(gait.vigor), forward, harmonic=0.3)
    hip = np.array([0.0, -0.1, 0.52 * gait.height])
    ring = heel_strikes(gait, _STRIKES[carry])
    shift = rng.uniform(-0.7, 0.7, 2)
    stride = gait.phase / 2.0 + shift[0] - pelvis
    yaw = 0.3 * gait.effort * np.cos(stride)
    roll = 0.1 * gait.effort * np.cos(stride - 2.3 + shift[1])
    roll += 0.03 * drift(rng, n, gait.rate, 1.0)
    offset = _about(2, yaw, hip) + _about(1, -angle, np.array([ahead, 0.0, below]))
    offset += trunk(gait, bounce, surge, sway * SWAY) + ring.offset_H
    # All of this is for the right leg; the left one does the mirror image.
    side = rng.choice([-1.0, 1.0])
    turn = np.stack([roll, -angle, yaw], axis=1) + ring.turn_H
    return CarryMotion(offset * [1.0, side, 1.0], turn * [side, 1.0, side])


def _bag(gait: Gait) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    hang, sway = rng.uniform([0.0, 0.06], [0.4, 0.16])
    shift = rng.uniform(-0.7, 0.7, 3)
    stride = np.cos(gait.phase[:, None] / 2.0 + shift)
    turn = sway * gait.effort[:, None] * stride * np.array([-0.9, 0.7, -1.1])
    turn[:, 1] += 0.03 * gait.effort * np.cos(gait.phase - 1.6 + shift[0])
    turn += 0.04 * drift(rng, n, gait.rate, 1.0, 3)
    body = np.array([rng.choice([-0.15, 0.12]), rng.uniform(-0.15, 0.15), 0.75 * gait.height])
    strap = np.array([0.0, 0.0, -hang])
    # A bag knocks against the body: its ringing is damped most.
    ring = heel_strikes(gait, _STRIKES["bag"])
    offset = body + np.cross(turn, strap) + strap + trunk(gait, 1.85, 0.75, 2.0 * SWAY)
    return CarryMotion(offset + ring.offset_H, turn + ring.turn_H)


def _trolley(gait: Gait) -> CarryMotion:
    """Return a trolley's motion: wheel rumble at 10 to 30 Hz, growing with speed, little gait."""
    rng, n = gait.rng, len(gait)
    rolling = np.clip(gait.speed / 0.8, 0.0, 2.0)[:, None]
    centre = min(rng.uniform(12.0, 22.0), 0.25 * gait.rate)
    strength = rng.uniform(0.2, 0.6)
    rumble = band_noise(rng, n, gait.rate, 0.75 * centre, 1.3 * centre, 6)
    rough = 1.0 + 0.3 * drift(rng, n, gait.rate, 0.5, 1)
    rumble = rumble * rolling * rough * strength
    axes = np.array([0.5, 0.5, 1.0])
    offset = rumble[:, :3] * axes / (2.0 * np.pi * centre) ** 2
    turn = 0.06 * rumble[:, 3:] / (2.0 * np.pi * centre)
    turn += 0.004 * drift(rng, n, gait.rate, 0.8, 3)
    place = np.array([0.6, 0.0, rng.uniform(0.4, 1.0)])
    # The push pulses slightly with the steps of the person behind.
    offset[:, 0] += 0.003 * gait.effort * np.cos(gait.phase)
    return CarryMotion(offset + place, turn)


def _rig(gait: Gait) -> CarryMotion:
    """Return a rig's motion: quick turns to random directions, arms waved by up to their length."""
    rng, n = gait.rng, len(gait)
    motion = _held(gait, TRUNK_BOUNCE, _STRIKES["rig"], rng.uniform(0.03, 0.1), 0.02, -0.08)
    reach = np.array([0.2, 0.25, 0.2]) * rng.uniform(0.3, 1.1)
    waved = drift(rng, n, gait.rate, rng.uniform(0.25, 0.5), 3)
    lively = 0.5 * (1.0 + np.tanh(1.5 + 1.5 * drift(rng, n, gait.rate, 3.0, 1)))
    looks = _looks(gait, np.array([0.5, 0.5, 0.9]) * rng.uniform(0.5, 1.2))
    offset = np.array([0.3, 0.0, 0.75 * gait.height]) + reach * np.tanh(waved) * lively
    return CarryMotion(motion.offset_H + offset, motion.turn_H + looks)


CARRIES: dict[str, Callable[[Gait], CarryMotion]] = {
    "handheld": partial(
        _in_hand, carry="handheld", bounce=1.5, tremor=0.1, wobble=0.03, pitch=-0.08
    ),
    "in-front": partial(
        _in_hand, carry="in-front", bounce=3.3, tremor=0.1, wobble=0.05, pitch=0.15
    ),
    "texting": partial(
        _in_hand, carry="texting", bounce=1.15, tremor=0.04, wobble=0.1, pitch=0.12,
        reach=(0.4, 0.1, 0.72), surge=0.6,
    ),
    "call": _call,
    "swinging": _swinging,
    "pocket": partial(
        _on_thigh, carry="pocket", swing=14.5, ahead=0.08, depths=(0.05, 0.12), bounce=1.5,
        surge=TRUNK_SURGE, sway=1.5, pelvis=0.0,
    ),
    "back-pocket": partial(
        _on_thigh, carry="back-pocket", swing=11.5, ahead=-0.1, depths=(0.02, 0.06), bounce=1.4,
        surge=1.2, sway=2.0, pelvis=2.1,
    ),
    "bag": _bag,
    "trolley": _trolley,
    "rig": _rig,
}  # fmt: skip
"""Function of every carrying mode, by name: on a flat hand a device bounces more than the trunk,
one that is read less; in a back pocket it turns with the pelvis as well."""


def _looks(gait: Gait, spread: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3) [rad] that rest at random values and move between them."""
    rng, n = gait.rng, len(gait)
    pause = rng.uniform(0.5, 1.6)
    targets = rng.normal(0.0, 1.0, (int(n / gait.rate / 0.25) + 2, 3)) * spread
    targets = np.clip(targets, -1.8 * spread, 1.8 * spread)
    rests = np.cumsum(rng.exponential(pause, len(targets)) + 0.25)
    held = targets[np.minimum(np.searchsorted(rests, np.arange(n) / gait.rate), len(targets) - 1)]
    return smoothed(held, gait.rate, rng.uniform(0.18, 0.3))


def _pendulum(gait: Gait, amplitude: float, forward: float, harmonic: float) -> FloatArray:
    """Return a limb's angle (N,) [rad]: it swings with the stride about a resting `forward`."""
    rng, n = gait.rng, len(gait)
    size = (
        amplitude
        * gait.effort
        / np.sqrt(gait.effort + 0.1)
        * (1.0 + 0.1 * drift(rng, n, gait.rate, 1.0))
    )
    stride = gait.phase / 2.0 + rng.uniform(-0.4, 0.4)
    overtones = harmonic * np.cos(2.0 * stride + rng.uniform(0.8, 1.6))
    overtones += 0.35 * harmonic * np.cos(3.0 * stride + rng.uniform(0.0, 2.0 * np.pi))
    restless = 0.03 * drift(rng, n, gait.rate, 0.6)
    return np.asarray(forward + size * (np.sin(stride) + overtones) + restless)


def _about(axis: int, angle: FloatArray, lever: FloatArray) -> FloatArray:
    """Return the vector `lever` (3,) rotated by `angle` (N,) [rad] about an axis of H: (N, 3)."""
    e = np.eye(3)[axis]
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.asarray(c * lever + s * np.cross(e, lever) + (1.0 - c) * e * np.dot(e, lever))
