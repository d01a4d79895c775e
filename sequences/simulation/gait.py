"""How a walking person moves, and what heel strikes excite, in the heading frame H.

H has x forward, y left, z up and its origin on the floor below the person. A gait repeats with the
stride (two steps). With phi the phase of the step, and so phi / 2 that of the stride, the trunk
rises, falls and surges with phi and sways with phi / 2; each heel strike excites ringing in what
carries the device: the thigh, the hip, the arm, a strap.

The phase offsets between these motions are those of real people, with some spread, never arbitrary:
they distinguish forward from backward and the sides from both. The trunk is highest at mid-stance
(phi = 0), slowest there too (kinetic energy has become potential), and farthest over the leg that
stands; every heel strike brakes it (Cavagna et al., 1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stario.sequences.sequence import FloatArray

_STRIKE_HARMONICS = 10

_STRIKE_LEVER = 0.1
"""Distance [m] from the point about which a device turns as it rings: angular rates in the bands of
the ringing are about 0.3 rad/s per m/s^2, wherever a phone is carried."""

_STRIKE_LAG = 0.9
"""Phase [rad] between the trunk's lowest point and the blow: the other leg has taken the weight."""

TRUNK_BOUNCE, TRUNK_SURGE, HELD_SURGE, SWAY = 2.0, 1.0, 0.45, 0.42
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


def hardly_growing(effort: FloatArray) -> FloatArray:
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
    hardly = hardly_growing(gait.effort)
    shift = rng.uniform(-np.pi, np.pi, 4)
    shift[2] = np.pi + rng.normal(0.2, 0.3)  # slowest about the highest point
    z = rise * bounce * gait.effort * (np.cos(phi) + limp * np.cos(phi / 2.0 + shift[0]))
    # Over the standing leg at mid-stance. A stride takes two steps: a quarter of the frequency^2.
    y = 4.0 * side * SWAY * hardly * (np.cos(phi / 2.0) + 0.08 * np.sin(1.5 * phi + shift[1]))
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
