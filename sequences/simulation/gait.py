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

_STRIKE_HARMONICS = 20
"""Harmonics of the stride in the ringing."""

_PARITY = np.array([0, 1, 0, 1, 0, 1])
"""Harmonics of the stride, even or odd, that equal legs excite along x, y, z and about them."""

_STRAY = np.array([1.2, 1.2, 0.4, 1.2, 1.2, 1.2])
"""Largest stray [rad] of a harmonic's phases along x, y, z and about them: as coherent are axes."""

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


Ratio = tuple[float, float]
"""How large one oscillation is per another, and by how much it leads [deg]."""


@dataclass(frozen=True)
class Strike:
    """What a heel strike excites in a device: an oscillator.

    Attributes:
        strength: root mean square of its vertical acceleration at effort 1 and vigor 1 [m/s^2].
        resonance: undamped frequency [Hz].
        damping: damping ratio.
        forward: acceleration forward per acceleration up.
        sideways: acceleration to the sides per acceleration up, without phase.
        roll, yaw: angular rates about x and z of H per acceleration to the left [rad/s per m/s^2].
        pitch: angular rate about y of H per acceleration up [rad/s per m/s^2].
        unequal: how much of it repeats with the stride only, or, to the sides, with the step: 0 in
            the middle of a person with equal legs, where the sides alternate; 1 at one leg.
    """

    strength: float
    resonance: float
    damping: float
    forward: Ratio
    sideways: float
    roll: Ratio
    pitch: Ratio
    yaw: Ratio
    unequal: float


def hardly_growing(effort: FloatArray) -> FloatArray:
    """Return the strength of what a walk starts and a faster one hardly changes; 1 at effort 1."""
    return np.asarray((1.0 + _SLOW) * effort / (effort + _SLOW))


def trunk(gait: Gait, bounce: float, surge: float, sway: float = SWAY) -> FloatArray:
    """Return the trunk's motion (N, 3) in H [m]: bounce and surge per step, sway per stride.

    Its acceleration, not its height, grows with the effort: slow steps are short, not rare. Surge
    and sway hardly grow: phones show as much of them at 0.5 as at 1.3 m/s.

    Args:
        gait: the gait.
        bounce: root mean square of the vertical acceleration at effort 1 [m/s^2].
        surge: that of the acceleration forward and back [m/s^2].
        sway: that of the acceleration to the sides [m/s^2].
    """
    rng, phi = gait.rng, gait.phase
    rise, side, ahead, limp = rng.uniform([0.85, 0.7, 0.75, 0.0], [1.15, 1.3, 1.25, 0.25])
    per_acceleration = np.sqrt(2.0) / (2.0 * np.pi * gait.step_rate) ** 2
    hardly = hardly_growing(gait.effort)
    shift = rng.uniform(-np.pi, np.pi, 4)
    shift[2] = np.pi + rng.normal(-0.2, 0.4)  # slowest about the highest point
    z = rise * bounce * gait.effort * (np.cos(phi) + limp * np.cos(phi / 2.0 + shift[0]))
    # Over the standing leg at mid-stance. A stride takes two steps: a quarter of the frequency^2.
    y = 4.0 * side * sway * hardly * (np.cos(phi / 2.0) + 0.08 * np.sin(1.5 * phi + shift[1]))
    x = ahead * surge * hardly * (np.sin(phi + shift[2]) + 0.8 * np.sin(phi / 2.0 + shift[3]))
    return np.stack([per_acceleration * x, per_acceleration * y, per_acceleration * z], axis=1)


def heel_strikes(gait: Gait, strike: Strike) -> CarryMotion:
    """Return the ringing that heel strikes excite in the device.

    The oscillator is excited by every step: harmonic n of the stride gets the oscillator's response
    at n times its frequency. The device turns with it.
    """
    rng = gait.rng
    resonance = strike.resonance * rng.uniform(0.85, 1.15)
    forward, roll, pitch, yaw = strike.forward, strike.roll, strike.pitch, strike.yaw
    sideways = (strike.sideways, 90.0 * rng.choice([-1.0, 1.0]))
    size, lead = np.transpose([forward, sideways, (1.0, 0.0), roll, pitch, yaw])
    # Roll and yaw go with the sway. An angle follows its rate, an offset opposes its acceleration.
    size[[3, 5]], lead[[3, 5]] = size[[3, 5]] * size[1], lead[[3, 5]] + lead[1]
    size, lead = rng.uniform(0.8, 1.2, 6) * size, np.radians(lead + np.repeat([0.0, 90.0], 3))
    typical = float(np.median(gait.step_rate))
    n = np.arange(2, _STRIKE_HARMONICS + 1)
    n = n[0.5 * n * typical < 0.4 * gait.rate]
    ratio = 0.5 * n * typical / resonance
    response = 1.0 / (1.0 - ratio**2 + 2j * strike.damping * ratio)
    # Both legs push alike up and forward and in turn to the sides, but for what is unequal.
    share = np.where(n[:, None] % 2 == _PARITY, 1.0, strike.unequal)
    share[0, _PARITY == 0] = 0.0  # the trunk's bounce and surge
    response *= np.sqrt(2.0) * strike.strength / np.linalg.norm(response * share[:, 2])
    offset, turn = np.zeros((2, len(gait), 3))
    strength = (gait.vigor * gait.effort)[:, None]
    for k, gain, each in zip(0.5 * n, response, size * share, strict=True):
        angle = k * (gait.phase - np.pi - _STRIKE_LAG)[:, None] + np.angle(gain)
        angle = angle + lead + rng.uniform(-_STRAY, _STRAY)
        omega = 2.0 * np.pi * k * gait.step_rate[:, None]
        ring = np.abs(gain) * strength * np.cos(angle) * each / omega
        offset += ring[:, :3] / omega
        turn += ring[:, 3:]
    return CarryMotion(offset, turn)
