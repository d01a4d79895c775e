"""Stride cycles: how devices that people carry move within a stride, as recordings show it.

The motion of a carried device repeats with the stride (two steps). In a frame H' with x along the
walk, y to the left and z up, its specific force less gravity and its angular rate are

    a(theta) = Re sum_n A_n exp(i n theta),    w(theta) = Re sum_n W_n exp(i n theta),

with theta the phase of the stride. `strides.npz` holds the amplitudes of people of several sets of
recordings, by way of carrying, with the speed and the step rate that they had: what leads what, and
by how much, is that of a person, and no model of bodies, arms, straps and pockets stands between.
`measured_stride` finds them in a recording; `examples/measure_strides.py` made the file. Recordings
of people who walk sideways or backward have the same cycles along the way they go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import FloatArray
from stario.sequences.simulation.routes import drift

ComplexArray = NDArray[np.complex128]

HARMONICS = 20
"""Harmonics of the stride: up to about 18 Hz."""

STEP_RATE_POWER = 0.4
"""Exponent of the speed in the step rate: the medians of tyrex, RIDI and KIPD are 1.25, 1.5, 1.65,
1.8, 1.9 and 2.0 Hz at 0.45, 0.7, 0.9, 1.1, 1.3 and 1.5 m/s."""

_RISE_POWER, _FAST_POWER = 2.0, 1.2
"""Exponents of the speed in accelerations up, and in what is above harmonic 3. Above a leg that
does not bend the body rises by the square of a step's length, so that its acceleration grows with
the square of the speed; among recorded people it does with 2.0 to 2.4 in hands, pockets and back
pockets. Fast harmonics grow with 0.5 to 1.1 in hands and 1.2 to 2.2 in pockets."""

_STEADY = 3
"""Highest harmonic of all others, which grow with the speed's root: 0.3 to 0.6 within the sets."""

_NEARBY = 0.2
"""Deviation of the logarithm of the speed within which people of a speed are drawn."""

WANDERING = 0.085
"""Deviation of a harmonic n from stride to stride, per n: what does not repeat is 0.1 to
0.3 of the steps' band, 0.45 of 3 to 6 Hz, 0.5 of 6 to 10 and 0.7 of 10 to 20 Hz in all ways."""

_WANDER_TIME = 0.4
"""Correlation time of that deviation [s]."""

MIRRORED = np.array([1, -1, 1, -1, 1, -1])
"""Signs of force and angular rate of the mirror image, to the other side of the body."""

_HALF_TURNS = Rotation.from_euler("x", np.pi), Rotation.from_euler("y", np.pi)
"""About x and y: reflections of a device's x and of H's y, each of them times -1."""


@dataclass(frozen=True, eq=False)
class StrideCycle:
    """A person's stride with a device.

    Attributes:
        speed: speed of the walk [m/s].
        step_rate: step rate [Hz].
        amplitude: (HARMONICS, 6) complex amplitudes of the specific force [m/s^2] and of the
            angular rate [rad/s] in H'.
        quat_xyzw: (4,) mean attitude of the device's axes in H'.
    """

    speed: float
    step_rate: float
    amplitude: ComplexArray
    quat_xyzw: FloatArray


@dataclass(frozen=True, eq=False)
class Gait:
    """A walk's steps, and what the motion of a device depends on.

    Attributes:
        rng: random generator for all draws.
        rate: sampling rate [Hz].
        phase: (N,) phase of the stride [rad], 2 pi per two steps.
        step_rate: (N,) step rate [Hz].
        pace: (N,) speed of the feet [m/s], on stairs and in turns on the spot as well.
        speed: (N,) speed over the floor [m/s].
        course: (N, 2) direction of the walk in the heading frame H, smaller where none is known.
        height: height of the person [m].
    """

    rng: np.random.Generator
    rate: float
    phase: FloatArray
    step_rate: FloatArray
    pace: FloatArray
    speed: FloatArray
    course: FloatArray
    height: float

    def __len__(self) -> int:
        return len(self.phase)


@dataclass(frozen=True, eq=False)
class CarryMotion:
    """How a device moves.

    Attributes:
        offset_H: (N, 3) offset in H [m].
        turn_H: (N, 3) rotation vector in H from the neutral attitude [rad].
        neutral_HB: the neutral attitude.
    """

    offset_H: FloatArray
    turn_H: FloatArray
    neutral_HB: Rotation


@cache
def stride_cycles(way: str) -> list[StrideCycle]:
    """Return the recorded people of a way of carrying, with the device on one side of all."""
    with np.load(str(files(__package__).joinpath("strides.npz")), allow_pickle=False) as found:
        chosen = found["way"] == way
        amplitude = found["amplitude"][chosen].astype(np.float64) @ [1.0, 1j]
        speed, steps, quat = (found[key][chosen] for key in ("speed", "step_rate", "quat_xyzw"))
        values = zip(speed.tolist(), steps.tolist(), amplitude, quat, strict=True)
        return [StrideCycle(*each) for each in values]


def step_rate(person: StrideCycle, speed: FloatArray) -> FloatArray:
    """Return a person's step rate (N,) [Hz] at a speed (N,) [m/s]."""
    return np.asarray(person.step_rate * (speed / person.speed) ** STEP_RATE_POWER)


def on_other_side(person: StrideCycle) -> StrideCycle:
    """Return a person with the device on the other side of the body.

    A device is its own mirror image, left for right: its attitude is reflected on both sides.
    """
    about_x, about_y = _HALF_TURNS
    R_HB = about_y * Rotation.from_quat(person.quat_xyzw) * about_x
    return replace(person, amplitude=person.amplitude * MIRRORED, quat_xyzw=R_HB.as_quat())


def drawn_cycle(rng: np.random.Generator, way: str, speed: float) -> StrideCycle:
    """Draw one of the people of a way of carrying, rather one who walked about as fast."""
    cycles = stride_cycles(way)
    off = np.array([abs(np.log(speed / cycle.speed)) for cycle in cycles])
    odds = np.exp(-0.5 * ((off - off.min()) / _NEARBY) ** 2)
    return cycles[rng.choice(len(cycles), p=odds / odds.sum())]


def stride_motion(gait: Gait, person: StrideCycle) -> CarryMotion:
    """Return a device's motion with a person's stride.

    An offset opposes its acceleration by n^2 omega^2, an angle follows its rate by n omega.
    """
    rng = gait.rng
    omega = np.pi * gait.step_rate
    ratio = gait.pace / person.speed
    faster, steadier = ratio**_FAST_POWER, 2.0 * ratio / (1.0 + ratio)
    growth = np.stack([steadier, steadier, ratio**_RISE_POWER, steadier, steadier, steadier])
    motion = np.zeros((6, len(gait)))
    for n, size in enumerate(person.amplitude, start=1):
        real, imaginary = (
            np.sqrt(0.5) * WANDERING * n * drift(rng, len(gait), gait.rate, _WANDER_TIME, 2).T
        )
        wave = (1.0 + real + 1j * imaginary) * np.exp(1j * n * gait.phase) / (n * omega)
        wave = np.stack([wave / (n * omega)] * 3 + [1j * wave] * 3)
        motion -= (wave * size[:, None]).real * (growth if n <= _STEADY else faster)
    offset, turn = (_along(gait.course, part.T) for part in (motion[:3], motion[3:]))
    return CarryMotion(offset, turn, Rotation.from_quat(person.quat_xyzw))


def _along(course: FloatArray, vector: FloatArray) -> FloatArray:
    """Return vectors (N, 3) of the frame H' in H."""
    c, s = course.T
    x, y, z = vector.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)
