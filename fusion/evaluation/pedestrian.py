"""Pedestrian dead reckoning without a network: steps, their lengths, their directions.

A classical baseline that shows whether a network is worth using on a recording:

- steps are the peaks of the levelled vertical acceleration;
- a step is K (a_max - a_min)^(1/4) long (Weinberg, Using the ADXL202 in Pedometer and Personal
  Navigation Applications, Analog Devices AN-602, 2002), with one K for everyone;
- its direction is the principal axis of the horizontal acceleration in the device's heading frame
  (Kunze et al., Which Way Am I Facing, ISWC 2009; compared with others by Combettes and Renaudin,
  IPIN 2015), rotated by the gyroscope's yaw. Of the axis's two ends, the backward one is that along
  which the acceleration lags the vertical one by a quarter of a step, as it does in walking.
"""

from __future__ import annotations

from functools import cache
from time import perf_counter

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, find_peaks, hilbert, sosfiltfilt
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.displacement_error import Piece, planar
from stario.fusion.imu.direction import Complex
from stario.fusion.imu.inference import Predictor, StatefulInference
from stario.fusion.values.state import Track
from stario.sequences.attitude.rotations import about_z
from stario.sequences.levelled_stream import (
    TICK_SAMPLES,
    TICKS_PER_SECOND,
    LevelledStream,
    levelled_streams,
)
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.windows import WINDOW_RATE

WEINBERG_CONSTANT = 0.373
"""K [m / (m/s^2)^(1/4)], fitted to the paths of 107 training recordings; 0.25 to 0.65 by person."""

NAME = "pdr"

_STEP_BAND = (0.8, 3.0)
"""Frequency band of steps [Hz]; strides and sideways sway are below, impacts above."""

_MIN_PROMINENCE = 0.6
"""Minimum prominence of a peak that counts as a step [m/s^2]."""

_MIN_STEP_SECONDS, _MAX_STEP_SECONDS = 0.25, 1.5
"""Minimum and maximum time between steps [s]; a longer one is a pause."""

_AXIS_SECONDS = 5.0
"""Time over which the walking direction relative to the device is averaged [s]."""

_SIGMA = 0.3
"""Standard deviation of a one-second displacement [m]: the method's error where it works."""

Indices = np.ndarray[tuple[int], np.dtype[np.int64]]


class PedestrianDeadReckoning:
    """Baseline judged like a network, by the displacement over the second from each tick."""

    def piece(self, stream: LevelledStream) -> Piece:
        """Return an unbroken stretch with the displacements of its steps."""
        track, count = pedestrian_path(stream), stream.window_count
        # The window that begins at the last tick ends one sample after the stretch.
        at_tick = np.append(track, track[-1])[::TICK_SAMPLES]
        moved = at_tick[TICKS_PER_SECOND : TICKS_PER_SECOND + count] - at_tick[:count]
        displacement = np.stack([moved.real, moved.imag, np.zeros(count)], axis=1)
        return Piece(stream, displacement, np.tile(_SIGMA**2 * np.eye(3), (count, 1, 1)))


Model = Predictor | PedestrianDeadReckoning


@cache
def model_named(name: str) -> Model:
    """Return the network with these weights, loaded once, or pedestrian dead reckoning."""
    from stario.network.model import load_model

    return PedestrianDeadReckoning() if name == NAME else load_model(name)


def piece_of(model: Model, stream: LevelledStream) -> Piece:
    """Return an unbroken stretch with the displacements of steps, or of a network as it begins."""
    if isinstance(model, PedestrianDeadReckoning):
        return model.piece(stream)
    network = StatefulInference(model, TICKS_PER_SECOND)
    return Piece(stream, *network.predict(stream.windows(), stream.headings))


def pedestrian_track(sequence: ImuSequence) -> Track:
    """Compute a recording's track, levelled from the IMU; position and heading stay across gaps.

    Raises:
        InputError: there is no unbroken stretch of 2 s, or the rate is not accepted.
    """
    began = perf_counter()
    streams = levelled_streams(sequence)
    paths, attitudes, end, facing = [], [], 0j, 0j
    for stream in streams:
        faces = planar(stream.facing_N)
        # Each has its own initial yaw. The rotation during a gap is unknown and taken as zero.
        turn = float(np.angle(facing * np.conj(faces[0])))
        path = end + np.exp(1j * turn) * pedestrian_path(stream)
        paths.append(path[::TICK_SAMPLES])
        attitudes.append(about_z(turn) * Rotation.from_matrix(stream.R_NB))
        end, facing = path[-1], np.exp(1j * turn) * faces[-1]
    xy = np.concatenate(paths)
    trajectory = Trajectory(
        time=np.concatenate([stream.ticks for stream in streams]),
        position_W=np.stack([xy.real, xy.imag, np.zeros(len(xy))], axis=1),
        attitude_WB=Rotation.concatenate(attitudes),
    )
    return Track(trajectory, seconds_filter=perf_counter() - began)


def steps_of(stream: LevelledStream) -> tuple[Indices, Indices, Complex]:
    """Detect steps: samples (S,) at which each begins and ends, and its displacement x + iy [m].

    A step begins where the previous one ended, except after a pause.
    """
    band = butter(2, _STEP_BAND, "bandpass", fs=WINDOW_RATE, output="sos")
    accel_N = sosfiltfilt(band, stream.imu_N[:, 3:].astype(np.float64), axis=0)
    vertical = accel_N[:, 2]
    peaks, _ = find_peaks(
        vertical, prominence=_MIN_PROMINENCE, distance=round(_MIN_STEP_SECONDS * WINDOW_RATE)
    )
    regular = np.diff(peaks) <= _MAX_STEP_SECONDS * WINDOW_RATE
    begin, end = peaks[:-1][regular], peaks[1:][regular]
    spread = np.array([np.ptp(vertical[a:b]) for a, b in zip(begin, end, strict=True)])
    heading = _unit(planar(stream.facing_N))
    forward_H = _forward(planar(accel_N), vertical, heading)
    direction_N = (heading * forward_H)[(begin + end) // 2]
    return begin, end, WEINBERG_CONSTANT * spread**0.25 * direction_N


def pedestrian_path(stream: LevelledStream) -> Complex:
    """Return the horizontal position x + iy (N,) [m] in N at each sample, 0 at the first."""
    speed = np.zeros(len(stream), dtype=complex)
    for begin, end, step in zip(*steps_of(stream), strict=True):
        speed[begin:end] = step / (end - begin)
    return np.concatenate([[0.0], np.cumsum(speed)[:-1]])


def _forward(horizontal_N: Complex, vertical: FloatArray, heading: Complex) -> Complex:
    """Return the walking direction (N,) in the heading frame: principal axis, sign by phase."""
    horizontal_H = horizontal_N * np.conj(heading)
    samples = round(_AXIS_SECONDS * WINDOW_RATE)
    # The square doubles angles, so that both ends of an axis add up.
    axis = np.sqrt(_unit(uniform_filter1d(horizontal_H**2, samples, mode="nearest")))
    lagging = uniform_filter1d(-horizontal_H * np.imag(hilbert(vertical)), samples, mode="nearest")
    return np.asarray(np.where((np.conj(axis) * lagging).real < 0.0, -axis, axis))


def _unit(values: Complex) -> Complex:
    return np.asarray(values / np.maximum(np.abs(values), 1e-12))
