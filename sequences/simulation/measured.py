"""Stride cycles in recordings of people who walk: what `strides.npz` is made of.

In every steady window the phase of the step is that of the force's strongest motion about the step
rate, and the amplitudes of the harmonics are fitted by least squares. Windows, and the recordings
of a way of carrying, are then aligned: shifted in phase, and the recordings mirrored, until they
agree best with their mean. So steps of the left foot are told from those of the right, and devices
on one side of the body from those on the other, without anybody having noted which it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.signal import butter, hilbert, sosfiltfilt
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import even_grid, interpolated
from stario.sequences.attitude.rotations import about_z
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.strides import (
    HARMONICS,
    MIRRORED,
    STEP_RATE_POWER,
    WANDERING,
    ComplexArray,
    StrideCycle,
    on_other_side,
)

_RATE = 100.0
"""Rate of the samples [Hz]."""

_WINDOW, _EDGE, _EVERY = 250, 60, 60
"""Samples of a window, of those around it that phases need, and from one window to the next."""

_SPEEDS, _UNSTEADY, _TURNED = (0.4, 2.0), 0.5, 1.6
"""Speeds of a window [m/s], largest range of the speed per mean, and of the course [rad]."""

_FEWEST, _SLOWEST = 10, 0.5
"""Fewest windows of a recording, and least median speed [m/s]: slower is not quite a walk."""

_STEP_RATES = (0.65, 1.5)
"""Step rates within a window relative to those of people at the same speed (1.75 Hz at 1 m/s)."""

_HARMONICS = np.arange(1, HARMONICS + 1)
_WEIGHT = np.array([1.0, 1.0, 1.0, 11.0, 11.0, 11.0]) / (1.0 + (_HARMONICS[:, None] / 8.0) ** 2)
"""Weight of harmonics in an agreement: 1 m/s^2 counts as 0.3 rad/s, fast ones count less."""

_SHIFTS = np.exp(1j * np.outer(2.0 * np.pi * np.arange(360) / 360.0, _HARMONICS))


def measured_stride(sequence: ImuSequence, poses: Trajectory) -> StrideCycle | None:
    """Return the mean stride of a recorded person.

    Args:
        sequence: recording of a person who carries a device in one way.
        poses: its ground truth with attitudes, or poses estimated from it, at their true scale.

    Returns:
        The stride at the median speed; None if too little of the recording is a steady walk.
    """
    walks = _steady_walks(sequence, poses)
    found = [stride for walk in walks if (stride := _stride(*walk)) is not None]
    speeds = np.array([stride.speed for stride in found])
    if len(found) < _FEWEST or np.median(speeds) < _SLOWEST:
        return None
    aligned, _ = _aligned([stride.amplitude for stride in found], mirrored=False)
    mean = aligned.mean(axis=0)
    # What is fast comes a little earlier or later in each stride: its size is that within strides.
    # Half of what the simulator adds to that from stride to stride remains in a window's fit.
    added = 1.0 + 0.5 * (WANDERING * _HARMONICS[:, None]) ** 2
    size = np.sqrt(np.mean(np.abs(aligned) ** 2, axis=0) / added)
    return StrideCycle(
        speed=float(np.median(speeds)),
        step_rate=float(np.median([stride.step_rate for stride in found])),
        amplitude=mean * np.minimum(size / np.abs(mean), 2.0),
        quat_xyzw=Rotation.from_quat([stride.quat_xyzw for stride in found]).mean().as_quat(),
    )


def on_one_side(people: list[StrideCycle]) -> list[StrideCycle]:
    """Return the strides of people with a device in one way, all as if on the same side."""
    aligned, other = _aligned([person.amplitude for person in people], mirrored=True)
    sides = [
        on_other_side(each) if turn else each for each, turn in zip(people, other, strict=True)
    ]
    return [replace(person, amplitude=a) for person, a in zip(sides, aligned, strict=True)]


def _steady_walks(
    sequence: ImuSequence, poses: Trajectory
) -> Iterator[tuple[FloatArray, float, FloatArray]]:
    """Yield force less gravity and angular rate (M, 6) in H', speed [m/s], attitude (4,)."""
    start, stop = (pick(sequence.time[k], poses.time[k]) for pick, k in ((max, 0), (min, -1)))
    time = even_grid(float(start), float(stop), 1.0 / _RATE)
    if len(time) < 2 * _WINDOW:
        return
    at = poses.at(time)
    motion = np.hstack([sequence.accel, sequence.gyro])
    if sequence.rate > _RATE:
        motion = sosfiltfilt(butter(4, 0.4 * _RATE, fs=sequence.rate, output="sos"), motion, axis=0)
    motion = interpolated(time, sequence.time, motion)
    slow = butter(2, 0.5, fs=_RATE, output="sos")
    velocity = _RATE * np.gradient(sosfiltfilt(slow, at.position_W[:, :2], axis=0), axis=0)
    speed, course = np.hypot(*velocity.T), np.unwrap(np.arctan2(*velocity.T[::-1]))
    R_HB = about_z(-course) * at.attitude_WB
    motion = np.hstack([R_HB.apply(motion[:, :3]), R_HB.apply(motion[:, 3:])])
    motion[:, 2] -= STANDARD_GRAVITY
    for first in range(_EDGE, len(time) - _WINDOW - _EDGE, _EVERY):
        window = slice(first, first + _WINDOW)
        mean = float(speed[window].mean())
        steady = np.ptp(speed[window]) < _UNSTEADY * mean and np.ptp(course[window]) < _TURNED
        if steady and _SPEEDS[0] < mean < _SPEEDS[1] and at.valid[window].all():
            attitude = R_HB[window].mean().as_quat()
            yield motion[first - _EDGE : first + _WINDOW + _EDGE], mean, attitude


def _stride(motion: FloatArray, speed: float, quat_xyzw: FloatArray) -> StrideCycle | None:
    """Return the stride in a window; None if its step rate is no person's at that speed."""
    inner = slice(_EDGE, -_EDGE)
    time = (np.arange(_WINDOW) - 0.5 * _WINDOW) / _RATE
    force = motion[:, :3] - motion[:, :3].mean(axis=0)
    power = np.abs(np.fft.rfft(force * np.hanning(len(force))[:, None], 4096, axis=0)) ** 2
    f, usual = np.fft.rfftfreq(4096, 1.0 / _RATE), 1.75 * speed**STEP_RATE_POWER
    possible = (f > _STEP_RATES[0] * usual) & (f < _STEP_RATES[1] * usual)
    about = f[possible][np.argmax(power[possible].sum(axis=1))]
    band = butter(2, [0.6 * about, 1.45 * about], "bandpass", fs=_RATE, output="sos")
    strongest = np.linalg.svd(hilbert(sosfiltfilt(band, force, axis=0), axis=0), False)[0][:, 0]
    phase = np.polyfit(time, np.unwrap(np.angle(strongest))[inner], 3)
    step_rates = np.polyval(np.polyder(phase), time) / (2.0 * np.pi * usual)
    if not _STEP_RATES[0] < step_rates.min() <= step_rates.max() < _STEP_RATES[1]:
        return None
    waves = np.exp(1j * np.outer(np.polyval(phase, time) / 2.0, _HARMONICS))
    basis = np.hstack([np.ones((_WINDOW, 1)), time[:, None], waves.real, -waves.imag])
    fitted = np.linalg.lstsq(basis, motion[inner], rcond=None)[0][2:]
    amplitude = fitted[:HARMONICS] + 1j * fitted[HARMONICS:]
    return StrideCycle(speed, usual * float(step_rates.mean()), amplitude, quat_xyzw)


def _aligned(amplitudes: list[ComplexArray], mirrored: bool) -> tuple[ComplexArray, list[bool]]:
    """Return amplitudes (K, HARMONICS, 6), shifted and mirrored to agree best, and which were."""
    found = np.stack(amplitudes)
    size = np.sqrt(np.sum(_WEIGHT * np.abs(found) ** 2, axis=(1, 2), keepdims=True))
    mean = found[len(found) // 2]
    for _ in range(8):
        aligned, other = zip(*(_closest(each, mean, mirrored) for each in found), strict=True)
        mean = (np.stack(aligned) / size).mean(axis=0)
    return np.stack(aligned), list(other)


def _closest(
    amplitude: ComplexArray, mean: ComplexArray, mirrored: bool
) -> tuple[ComplexArray, bool]:
    """Return amplitudes shifted to agree best with a mean, and whether as their mirror image."""
    sides = [amplitude, amplitude * MIRRORED] if mirrored else [amplitude]
    agreement = [(_SHIFTS @ np.sum(_WEIGHT * each * mean.conj(), axis=1)).real for each in sides]
    side = int(np.argmax([np.max(each) for each in agreement]))
    return np.asarray(sides[side] * _SHIFTS[np.argmax(agreement[side])][:, None]), bool(side)
