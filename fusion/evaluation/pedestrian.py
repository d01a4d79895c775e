"""Pedestrian dead reckoning without a network: steps, their lengths, their directions.

A classical baseline that says at a glance whether a network is worth its name on a recording:

- steps are the peaks of the levelled vertical acceleration;
- a step is K (a_max - a_min)^(1/4) long (Weinberg, Using the ADXL202 in Pedometer and Personal
  Navigation Applications, Analog Devices AN-602, 2002), with one K for everybody;
- it goes along the principal axis of the horizontal acceleration in the device's heading frame
  (Kunze et al., Which Way Am I Facing, ISWC 2009; compared with others by Combettes and Renaudin,
  IPIN 2015), turned by the gyroscope's yaw. Of the axis' two ends the one counts against which the
  acceleration lags a quarter of a step behind the vertical one, as walking has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, find_peaks, hilbert, sosfiltfilt
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.judging.network_alone import UPDATES, Answers
from stario.fusion.evaluation.judging.prepared import Prepared
from stario.fusion.state import Track
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.levelled_stream import TICK_SAMPLES, LevelledStream, levelled_streams
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.windows import WINDOW_RATE

WEINBERG_CONSTANT = 0.373
"""K [m / (m/s^2)^(1/4)], fitted to the paths of 107 training recordings; 0.25 to 0.65 by person."""

NAME = "pdr"

_STEP_BAND = (0.8, 3.0)
"""Frequencies of steps [Hz]; strides and the sway from side to side are below, impacts above."""

_LEAST_PROMINENCE = 0.6
"""Of a peak that counts as a step [m/s^2]."""

_SHORTEST_STEP, _LONGEST_STEP = 0.25, 1.5
"""Times between steps [s]; after longer ones somebody stood."""

_AXIS_SECONDS = 5.0
"""Stretch over which the walking direction against the device is averaged [s]."""

_SIGMA = 0.3
"""Of a second's displacement [m]: what the method errs by where it works."""

Complex = np.ndarray[tuple[int], np.dtype[np.complex128]]


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps of a stretch.

    Attributes:
        end: (S,) samples at which each ends; it begins where the one before ended.
        begin: (S,) samples at which each begins.
        spread: (S,) difference of the largest and smallest vertical acceleration [m/s^2].
        direction_N: (S,) unit direction x + iy in N.
    """

    begin: np.ndarray[tuple[int], np.dtype[np.int64]]
    end: np.ndarray[tuple[int], np.dtype[np.int64]]
    spread: FloatArray
    direction_N: Complex

    def lengths(self, constant: float = WEINBERG_CONSTANT) -> FloatArray:
        """Step lengths (S,) [m] by Weinberg's rule."""
        return np.asarray(constant * self.spread**0.25)


class PedestrianDeadReckoning:
    """Judged like a network: answers with the displacement over the second from each tick."""

    def answers(self, prepared: Prepared) -> list[Answers]:
        """The answers on each piece of a recording, in N."""
        return [_answers(piece.stream) for piece in prepared.pieces]


def pedestrian_track(sequence: ImuSequence) -> Track:
    """The track of a recording, levelled from the IMU; it stands during gaps and keeps its heading.

    Raises:
        InputError: there is no unbroken stretch of 2 s, or the rate is not accepted.
    """
    began = perf_counter()
    streams = levelled_streams(sequence)
    if not streams:
        raise InputError(f"{sequence.name}: samples", "no unbroken stretch", "one of 2 s")
    places, attitudes, end, facing = [], [], 0j, 0j
    for stream in streams:
        faces = stream.facing_N[:, 0] + 1j * stream.facing_N[:, 1]
        # Each begins at a yaw of its own: nobody saw what was turned in the gap, so nothing was.
        turn = float(np.angle(facing * np.conj(faces[0])))
        place = end + np.exp(1j * turn) * pedestrian_path(stream)
        places.append(place[::TICK_SAMPLES])
        attitudes.append(about_z(turn) * Rotation.from_matrix(stream.R_NB))
        end, facing = place[-1], np.exp(1j * turn) * faces[-1]
    xy = np.concatenate(places)
    trajectory = Trajectory(
        time=np.concatenate([stream.ticks for stream in streams]),
        position_W=np.stack([xy.real, xy.imag, np.zeros(len(xy))], axis=1),
        attitude_WB=Rotation.concatenate(attitudes),
    )
    return Track(trajectory, seconds_filter=perf_counter() - began)


def steps_of(stream: LevelledStream) -> Steps:
    """Detect steps and their directions."""
    band = butter(2, _STEP_BAND, "bandpass", fs=WINDOW_RATE, output="sos")
    accel_N = sosfiltfilt(band, stream.imu_N[:, 3:].astype(np.float64), axis=0)
    vertical = accel_N[:, 2]
    peaks, _ = find_peaks(
        vertical, prominence=_LEAST_PROMINENCE, distance=round(_SHORTEST_STEP * WINDOW_RATE)
    )
    whole = np.diff(peaks) <= _LONGEST_STEP * WINDOW_RATE
    begin, end = peaks[:-1][whole], peaks[1:][whole]
    spread = np.array([np.ptp(vertical[a:b]) for a, b in zip(begin, end, strict=True)])
    heading = _unit(stream.facing_N[:, 0] + 1j * stream.facing_N[:, 1])
    forward_H = _forward(accel_N[:, 0] + 1j * accel_N[:, 1], vertical, heading)
    middle = (begin + end) // 2
    return Steps(begin, end, spread, (heading * forward_H)[middle])


def pedestrian_path(stream: LevelledStream, constant: float = WEINBERG_CONSTANT) -> Complex:
    """Horizontal position x + iy (N,) [m] in N at each sample, from 0 at the first."""
    steps = steps_of(stream)
    speed = np.zeros(len(stream), dtype=complex)
    moved = steps.lengths(constant) * steps.direction_N
    for begin, end, step in zip(steps.begin, steps.end, moved, strict=True):
        speed[begin:end] = step / (end - begin)
    return np.concatenate([[0.0], np.cumsum(speed)[:-1]])


def _forward(horizontal_N: Complex, vertical: FloatArray, heading: Complex) -> Complex:
    """Walking direction (N,) in the device's heading frame: principal axis, end by the phase."""
    horizontal_H = horizontal_N * np.conj(heading)
    samples = round(_AXIS_SECONDS * WINDOW_RATE)
    # The square doubles angles: both ends of an axis add up.
    axis = np.sqrt(_unit(_mean(horizontal_H**2, samples)))
    lagging = _mean(-horizontal_H * np.imag(hilbert(vertical)), samples)
    return np.asarray(np.where((np.conj(axis) * lagging).real < 0.0, -axis, axis))


def _answers(stream: LevelledStream) -> Answers:
    track = pedestrian_path(stream)
    # The window that begins with the last tick ends one sample behind the stretch.
    at_tick = np.append(track, track[-1])[::TICK_SAMPLES]
    count = stream.window_count
    moved = at_tick[UPDATES : UPDATES + count] - at_tick[:count]
    displacement = np.stack([moved.real, moved.imag, np.zeros(count)], axis=1)
    return Answers(displacement, np.tile(_SIGMA**2 * np.eye(3), (count, 1, 1)))


def _mean(values: Complex, samples: int) -> Complex:
    parts = (uniform_filter1d(part, samples, mode="nearest") for part in (values.real, values.imag))
    real, imaginary = parts
    return np.asarray(real + 1j * imaginary)


def _unit(values: Complex) -> Complex:
    return np.asarray(values / np.maximum(np.abs(values), 1e-12))
