"""Carrying modes: how a device moves relative to a walking person, in the heading frame H.

H has x forward, y left, z up and its origin on the floor below the person. Every carrying mode
gives the device's offset in H [m] and its rotation from a neutral attitude as a rotation vector in
H [rad]. A gait repeats with the stride (two steps). With phi the phase of the step, and so phi / 2
that of the stride, the trunk rises, falls and surges with phi and sways with phi / 2; each heel
strike excites ringing in what carries the device: the thigh, the hip, the arm, a strap.

The phase offsets between these motions are those of real people, with some spread, never arbitrary:
they distinguish forward from backward and the sides from both. The trunk is highest at mid-stance
(phi = 0), slowest there too (kinetic energy has become potential), and farthest over the leg that
stands; every heel strike brakes it (Cavagna et al., 1976).

Bounce, surge, strength, resonance and damping of each mode are those that `stario check simulation`
finds in recordings carried so: phones in pockets, read, swung and at the ear (tyrex), in bags
(RIDI), in a hand in front (KIPD, RIDI, rfbr) and flat on it (Indoor Location).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import FloatArray
from stario.sequences.simulation.routes import band_noise, drift, smoothed

_STRIKE_HARMONICS = 10

_STRIKE_LEVER = 0.1
"""Distance [m] from the point about which a device turns as it rings: angular rates in the bands of
the ringing are about 0.3 rad/s per m/s^2, wherever a phone is carried."""

_STRIKE_LAG = 0.9
"""Phase [rad] between the trunk's lowest point and the blow: the other leg has taken the weight."""

_TRUNK_BOUNCE, _TRUNK_SURGE, _HELD_SURGE, _SWAY = 2.0, 1.0, 0.45, 0.42
"""Typical root mean square [m/s^2] at effort 1 of the trunk's vertical acceleration, of that
forward and back (arms take half of it), and of that to the sides: by the true attitudes of RIDI,
KIPD, rfbr, tyrex and OxIOD 1.0 to 1.4 on the body, 0.3 to 0.65 in a hand; 0.2 to 0.5 to the
sides."""

_SLOW = 0.2
"""Effort of a slow walk, at which surge and sway have half of the size that they grow to."""


@dataclass(frozen=True, eq=False)
class Gait:
    """Quantities of a walk that the carrying modes depend on.

    Attributes:
        rng: random generator for all draws.
        rate: sampling rate [Hz].
        phase: (N,) phase of the step [rad], 2 pi per step.
        step_rate: (N,) step rate [Hz].
        effort: (N,) strength of the gait, from 0 standing to about 1 at a brisk walk of 1.4 m/s.
        speed: (N,) speed over the floor [m/s].
        height: height of the person [m].
        vigor: 1 is typical; heel strikes scale with it, limb swings with its square root.
    """

    rng: np.random.Generator
    rate: float
    phase: FloatArray
    step_rate: FloatArray
    effort: FloatArray
    speed: FloatArray
    height: float
    vigor: float

    def __len__(self) -> int:
        return len(self.phase)


@dataclass(frozen=True, eq=False)
class CarryMotion:
    """Offset (N, 3) [m] in H and rotation vector (N, 3) [rad] in H from the neutral attitude."""

    offset_H: FloatArray
    turn_H: FloatArray


@dataclass(frozen=True)
class Strike:
    """What a heel strike excites in a device: an oscillator.

    Attributes:
        strength: root mean square of its vertical acceleration at effort 1 and vigor 1 [m/s^2].
        resonance: undamped frequency [Hz].
        damping: damping ratio.
        forward: acceleration forward and back per acceleration up and down.
        sideways: acceleration to the sides per acceleration up and down.
        one_sided: whether the device is at one leg, which pushes it to one side; in the middle the
            sides alternate from step to step.
    """

    strength: float
    resonance: float
    damping: float
    forward: float
    sideways: float
    one_sided: bool = False


_ARM = (5.5, 0.3)
"""Resonance [Hz] and damping ratio of a device at the end of an arm."""


def _hardly_growing(effort: FloatArray) -> FloatArray:
    """Return the strength of what a walk starts and a faster one hardly changes; 1 at effort 1."""
    return np.asarray((1.0 + _SLOW) * effort / (effort + _SLOW))


def trunk(gait: Gait, bounce: float, surge: float) -> FloatArray:
    """Return the trunk's motion (N, 3) in H [m]: bounce and surge per step, sway per stride.

    Its acceleration, not its height, grows with the effort: slow steps are short, not rare. Surge
    and sway hardly grow: phones show as much of them at 0.5 as at 1.3 m/s.

    Args:
        gait: the gait.
        bounce: root mean square of the vertical acceleration at effort 1 [m/s^2].
        surge: that of the acceleration forward and back [m/s^2].
    """
    rng, phi = gait.rng, gait.phase
    rise, side, ahead, limp = rng.uniform([0.85, 0.5, 0.6, 0.0], [1.15, 1.4, 1.4, 0.25])
    per_acceleration = np.sqrt(2.0) / (2.0 * np.pi * gait.step_rate) ** 2
    hardly = _hardly_growing(gait.effort)
    shift = rng.uniform(-np.pi, np.pi, 4)
    shift[2] = np.pi + rng.normal(0.2, 0.3)  # slowest about the highest point
    z = rise * bounce * gait.effort * (np.cos(phi) + limp * np.cos(phi / 2.0 + shift[0]))
    # Over the standing leg at mid-stance. A stride takes two steps: a quarter of the frequency^2.
    y = 4.0 * side * _SWAY * hardly * (np.cos(phi / 2.0) + 0.08 * np.sin(1.5 * phi + shift[1]))
    x = ahead * surge * hardly * (np.sin(phi + shift[2]) + 0.8 * np.sin(phi / 2.0 + shift[3]))
    return np.stack([per_acceleration * x, per_acceleration * y, per_acceleration * z], axis=1)


def heel_strikes(gait: Gait, strike: Strike) -> CarryMotion:
    """Return the ringing that heel strikes excite in the device.

    The oscillator is excited once per step: harmonic n of the step gets the oscillator's response
    at n times the step rate. The device turns with it about a point nearby.
    """
    rng = gait.rng
    resonance = strike.resonance * rng.uniform(0.85, 1.15)
    share = rng.uniform(0.7, 1.3, 3) * np.array([strike.forward, strike.sideways, 1.0])
    # A blow that comes from below and in front swings the device in a circle rather than in a line.
    ahead = np.array([np.pi / 2.0, rng.choice([-1.0, 1.0]) * np.pi / 2.0, 0.0])
    turn_axis = rng.standard_normal(3)
    turn_axis /= np.linalg.norm(turn_axis)
    typical = float(np.median(gait.step_rate))
    n = np.arange(2, _STRIKE_HARMONICS + 1)
    n = n[n * typical < 0.4 * gait.rate]
    ratio = n * typical / resonance
    response = 1.0 / (1.0 - ratio**2 + 2j * strike.damping * ratio)
    response *= np.sqrt(2.0) * strike.strength / np.sqrt(np.sum(np.abs(response) ** 2))
    offset, turn = np.zeros((2, len(gait), 3))
    for k, gain in zip(n, response, strict=True):
        amplitude = np.abs(gain) / (2.0 * np.pi * k * gait.step_rate) ** 2
        order = np.array([k, k if strike.one_sided else k - 0.5, k, k])
        angle = order * (gait.phase - np.pi - _STRIKE_LAG)[:, None] + np.angle(gain)
        stray = rng.uniform(-0.4, 0.4, 4) + np.append(ahead, 0.0)
        ring = (gait.vigor * amplitude * gait.effort)[:, None] * np.cos(angle + stray)
        offset += ring[:, :3] * share
        turn += ring[:, 3:] * turn_axis / _STRIKE_LEVER
    return CarryMotion(offset, turn)


def _held(gait: Gait, bounce: float, strike: Strike, tremor: float, wobble: float) -> CarryMotion:
    """Return the motion of a device held steady: trunk, heel strikes, gait wobble, hand tremor.

    `tremor` [rad/s] is the angular rate of the tremor, `wobble` [rad] the rotation with the gait.
    """
    rng, n = gait.rng, len(gait)
    ring = heel_strikes(gait, strike)
    offset = trunk(gait, bounce, _HELD_SURGE) + ring.offset_H
    offset += 0.012 * drift(rng, n, gait.rate, 0.6, 3)
    turn = ring.turn_H + 0.08 * drift(rng, n, gait.rate, 0.7, 3)
    turn += 0.8 * tremor / (2.0 * np.pi * 3.0) * band_noise(rng, n, gait.rate, 1.5, 5.0, 3)
    turn += tremor / (2.0 * np.pi * 8.0) * band_noise(rng, n, gait.rate, 5.0, 11.0, 3)
    turn += _wobble(gait, wobble)
    # The tremor about the wrist also displaces the device: about 0.1 m/s^2.
    offset += 0.12 / (2.0 * np.pi * 8.0) ** 2 * band_noise(rng, n, gait.rate, 5.0, 11.0, 3)
    return CarryMotion(offset, turn)


def _wobble(gait: Gait, wobble: float) -> FloatArray:
    """Return the turning (N, 3) [rad] of a held device with the gait, of a size [rad].

    With the stride, roll and yaw follow the sway from side to side; with the step, pitch does the
    bounce (KIPD, rfbr, RIDI and tyrex by their true attitudes).
    """
    rng, phi = gait.rng, gait.phase[:, None]
    shift, size = rng.uniform(-0.7, 0.7, (2, 3)), rng.uniform(0.3, 1.0, (2, 3))
    size *= [[0.8, 0.3, -1.6], [0.3, 1.0, 0.3]]
    size[1, ::2] *= rng.choice([-1.0, 1.0], 2)  # to the left as often as to the right
    stride = np.sin(phi / 2.0 + shift[0] + [0.0, 0.0, 0.6]) * size[0]
    step = np.cos(phi + shift[1]) * size[1]
    effort = gait.effort[:, None]
    return np.asarray(wobble * (_hardly_growing(effort) * stride + effort * step))


def _handheld(gait: Gait) -> CarryMotion:
    """Return the motion of a device held in front, not quite as lively as the trunk."""
    rng = gait.rng
    strike, wobble = Strike(rng.uniform(0.3, 0.6), *_ARM, 1.5, 0.6), rng.uniform(0.02, 0.04)
    motion = _held(gait, rng.uniform(1.3, 1.8), strike, rng.uniform(0.05, 0.15), wobble)
    return _displaced(motion, rng.uniform(0.2, 0.45), rng.uniform(-0.2, 0.2), 0.7 * gait.height)


def _in_front(gait: Gait) -> CarryMotion:
    """Return the motion of a device laid flat on a hand, which bounces more than the trunk."""
    rng = gait.rng
    strike, wobble = Strike(rng.uniform(1.1, 2.1), *_ARM, 0.8, 0.6), rng.uniform(0.03, 0.07)
    motion = _held(gait, rng.uniform(2.9, 4.3), strike, rng.uniform(0.05, 0.15), wobble)
    return _displaced(motion, rng.uniform(0.2, 0.45), rng.uniform(-0.2, 0.2), 0.7 * gait.height)


def _texting(gait: Gait) -> CarryMotion:
    """Return the motion of a device that is read: the arms keep it steadier than the trunk."""
    rng = gait.rng
    strike = Strike(rng.uniform(0.75, 1.7), *_ARM, 0.4, 0.3)
    wobble, tremor = rng.uniform(0.05, 0.12), rng.uniform(0.02, 0.07)
    motion = _held(gait, rng.uniform(0.75, 1.25), strike, tremor, wobble)
    return _displaced(motion, rng.uniform(0.2, 0.4), rng.uniform(-0.1, 0.1), 0.72 * gait.height)


def _displaced(motion: CarryMotion, x: float, y: float, z: float) -> CarryMotion:
    return CarryMotion(motion.offset_H + np.array([x, y, z]), motion.turn_H)


def _call(gait: Gait) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    strike = Strike(rng.uniform(0.7, 1.35), *_ARM, 0.4, 0.4)
    wobble, tremor = rng.uniform(0.06, 0.12), rng.uniform(0.03, 0.1)
    motion = _held(gait, rng.uniform(0.9, 1.4), strike, tremor, wobble)
    head = 0.4 * drift(rng, n, gait.rate, 1.0)
    arm = np.array([0.05, rng.choice([-1.0, 1.0]) * 0.1, 0.0])
    offset = motion.offset_H + np.array([0.0, 0.0, 0.93 * gait.height]) + _about(2, head, arm)
    turn = motion.turn_H + np.stack([0 * head, 0 * head, head], axis=1)
    return CarryMotion(offset, turn)


def _swinging(gait: Gait) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    amplitude = np.radians(rng.uniform(24.0, 42.0)) * np.sqrt(gait.vigor)
    forward = np.radians(rng.uniform(8.0, 24.0))
    angle = _pendulum(gait, amplitude, forward, harmonic=0.02)
    side = rng.choice([-1.0, 1.0])
    # Elbow and shoulder give: the hand swings about a point below the shoulder.
    arm = np.array([0.0, 0.0, -0.27 * gait.height])
    pivot = np.array([0.0, side * 0.13 * gait.height, 0.7 * gait.height])
    ring = heel_strikes(gait, Strike(rng.uniform(0.9, 1.5), 5.5, 0.4, 0.9, 0.5))
    # Forward the hand also comes inward: the plane of the swing is turned.
    inward = Rotation.from_rotvec([0.0, 0.0, -side * rng.uniform(0.15, 0.4)])
    offset = (
        pivot
        + inward.apply(_about(1, -angle, arm))
        + trunk(gait, rng.uniform(1.7, 2.8), _TRUNK_SURGE)
    )
    offset += ring.offset_H + 0.008 * drift(rng, n, gait.rate, 0.5, 3)
    twist = rng.uniform(0.1, 0.5) * angle + 0.08 * drift(rng, n, gait.rate, 0.7)
    roll = 0.08 * drift(rng, n, gait.rate, 0.7)
    turn = inward.apply(np.stack([roll, -angle, twist], axis=1))
    return CarryMotion(offset, turn + ring.turn_H)


def _pocket(gait: Gait) -> CarryMotion:
    """Return the motion of a device in a front pocket: it swings and shakes with the thigh."""
    rng = gait.rng
    amplitude = np.radians(rng.uniform(11.0, 18.0))
    place = (0.08, -rng.uniform(0.05, 0.12) * gait.height)
    strike = Strike(rng.uniform(2.2, 4.0), 8.5, 0.25, 0.7, 0.7, True)
    return _on_thigh(gait, amplitude, place, rng.uniform(1.2, 2.0), _TRUNK_SURGE, strike)


def _back_pocket(gait: Gait) -> CarryMotion:
    """Return the motion of a device in a back pocket: it turns with pelvis and thigh."""
    rng = gait.rng
    amplitude = np.radians(rng.uniform(9.0, 14.0))
    place = (-0.1, -rng.uniform(0.0, 0.04) * gait.height)
    strike = Strike(rng.uniform(2.3, 4.1), 7.0, 0.3, 0.7, 0.7, True)
    return _on_thigh(gait, amplitude, place, rng.uniform(1.0, 1.6), _HELD_SURGE, strike)


def _on_thigh(
    gait: Gait,
    amplitude: float,
    place: tuple[float, float],
    bounce: float,
    surge: float,
    strike: Strike,
) -> CarryMotion:
    """Return the motion of a device at a place (x, z) [m] from the hip that swings with a leg."""
    rng, n = gait.rng, len(gait)
    forward = np.radians(rng.uniform(0.0, 12.0))
    angle = _pendulum(gait, amplitude * np.sqrt(gait.vigor), forward, harmonic=0.3)
    hip = np.array([0.0, rng.choice([-1.0, 1.0]) * 0.1, 0.52 * gait.height])
    ring = heel_strikes(gait, strike)
    offset = hip + _about(1, -angle, np.array([place[0], 0.0, place[1]]))
    offset += trunk(gait, bounce, surge) + ring.offset_H
    shift = rng.uniform(-0.7, 0.7, 2)
    yaw = 0.2 * gait.effort * np.cos(gait.phase / 2.0 + shift[0])
    roll = 0.06 * gait.effort * np.cos(gait.phase + shift[1]) + 0.03 * drift(rng, n, gait.rate, 1.0)
    return CarryMotion(offset, np.stack([roll, -angle, yaw], axis=1) + ring.turn_H)


def _bag(gait: Gait) -> CarryMotion:
    rng, n = gait.rng, len(gait)
    hang, sway = rng.uniform([0.0, 0.06], [0.4, 0.16])
    shift = rng.uniform(-0.7, 0.7, 3)
    stride = np.cos(gait.phase[:, None] / 2.0 + shift)
    turn = sway * gait.effort[:, None] * stride * np.array([1.0, 0.5, 0.8])
    step = 0.03 * rng.choice([-1.0, 1.0], 3)
    turn += step * gait.effort[:, None] * np.cos(gait.phase[:, None] + shift[::-1])
    turn += 0.04 * drift(rng, n, gait.rate, 1.0, 3)
    body = np.array([rng.choice([-0.15, 0.12]), rng.uniform(-0.15, 0.15), 0.75 * gait.height])
    strap = np.array([0.0, 0.0, -hang])
    # A bag knocks against the body: its ringing is damped most.
    ring = heel_strikes(gait, Strike(rng.uniform(0.8, 1.7), 6.5, 0.5, 1.3, 1.6))
    offset = body + np.cross(turn, strap) + strap + trunk(gait, rng.uniform(1.5, 2.4), _TRUNK_SURGE)
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
    strike = Strike(rng.uniform(0.2, 0.6), *_ARM, 0.8, 0.6)
    motion = _held(gait, _TRUNK_BOUNCE, strike, rng.uniform(0.03, 0.1), rng.uniform(0.01, 0.03))
    reach = np.array([0.2, 0.25, 0.2]) * rng.uniform(0.3, 1.1)
    waved = drift(rng, n, gait.rate, rng.uniform(0.25, 0.5), 3)
    lively = 0.5 * (1.0 + np.tanh(1.5 + 1.5 * drift(rng, n, gait.rate, 3.0, 1)))
    looks = _looks(gait, np.array([0.5, 0.5, 0.9]) * rng.uniform(0.5, 1.2))
    offset = np.array([0.3, 0.0, 0.75 * gait.height]) + reach * np.tanh(waved) * lively
    return CarryMotion(motion.offset_H + offset, motion.turn_H + looks)


CARRIES: dict[str, Callable[[Gait], CarryMotion]] = {
    "handheld": _handheld,
    "in-front": _in_front,
    "texting": _texting,
    "call": _call,
    "swinging": _swinging,
    "pocket": _pocket,
    "back-pocket": _back_pocket,
    "bag": _bag,
    "trolley": _trolley,
    "rig": _rig,
}
"""Function of every carrying mode, by name."""


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
    overtone = harmonic * np.cos(2.0 * stride + rng.uniform(0.8, 1.6))
    restless = 0.03 * drift(rng, n, gait.rate, 0.6)
    return np.asarray(forward + size * (np.sin(stride) + overtone) + restless)


def _about(axis: int, angle: FloatArray, lever: FloatArray) -> FloatArray:
    """Return the vector `lever` (3,) rotated by `angle` (N,) [rad] about an axis of H: (N, 3)."""
    e = np.eye(3)[axis]
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.asarray(c * lever + s * np.cross(e, lever) + (1.0 - c) * e * np.dot(e, lever))
