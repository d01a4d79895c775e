"""Windows for the networks: one second at 200 Hz in a gravity-aligned frame, and their targets.

A window that starts at t_i holds the 200 samples at t_i + k / 200 s, gyroscope then accelerometer,
each rotated from the body into a gravity-aligned frame; its target is the displacement from t_i to
t_j = t_i + 1 s in that frame (TLIO, Liu et al. 2020, section IV). For training the attitude is
levelled by the IMU as at inference, with the heading of the ground truth; or it is the true one, as
in the papers.

The networks receive windows in frame H, in which the device's heading is zero: a given motion of a
device then gives the same window whatever its heading. The heading is that of the twist about the
vertical, averaged over the window (`mean_heading`); it is singular only for a device that is upside
down throughout, for which any heading is acceptable.
"""

from __future__ import annotations

from collections.abc import Sized
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import (
    check_choice,
    check_type,
    even_grid,
    integral,
    interpolated,
    runs,
    samples_in,
)
from stario.sequences.attitude.levelling import levelled_attitudes
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.clean_samples import spike_free_samples, unbroken
from stario.sequences.errors import InputError
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, Trajectory
from stario.sequences.time_order import MAX_IMU_GAP

WINDOW_RATE = 200.0
"""Sampling rate of a window [Hz]."""

WINDOW_SAMPLES = 200
"""Number of samples in a window."""

WINDOW_SECONDS = WINDOW_SAMPLES / WINDOW_RATE
"""Length of a window [s]."""

Attitude = Literal["levelled", "true"]
"""Attitude that rotates training windows into the world frame; see `world_streams`."""


@dataclass(frozen=True, eq=False, repr=False)
class WorldStream:
    """Unbroken stretch of a recording at 200 Hz in the world frame, ready to be cut into windows.

    Attributes:
        name: name of the recording.
        imu_W: (N, 6) float32, gyroscope [rad/s] and specific force [m/s^2] rotated into W.
        position_W: (N, 3) float32 [m], relative to the stretch's start.
        facing_W: (N, 2) float32, facing direction of the device, from `facing`.
    """

    name: str
    imu_W: NDArray[np.float32]
    position_W: NDArray[np.float32]
    facing_W: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.imu_W)

    def __repr__(self) -> str:
        return f"WorldStream({len(self)} samples of {self.name})"

    def part(self, start: int, stop: int) -> WorldStream:
        """Return samples [start, stop); empty if there are none."""
        part = slice(start, max(stop, start))
        return WorldStream(self.name, self.imu_W[part], self.position_W[part], self.facing_W[part])


@dataclass(frozen=True, eq=False)
class LevelledImu:
    """IMU samples at 200 Hz in a gravity-aligned frame.

    Attributes:
        time: (M,) [s]; even except at long gaps, of which whole seconds are omitted: a clock that
            jumps by decades must not cost memory.
        imu: (M, 6) float32, gyroscope [rad/s] and specific force [m/s^2].
        facing: (M, 2) float32, facing direction of the device, from `facing`.
        usable: (M,) bool, whether neither the IMU nor, if it is used, the ground truth has a gap.
    """

    time: FloatArray
    imu: NDArray[np.float32]
    facing: NDArray[np.float32]
    usable: BoolArray


def facing(R_NB: FloatArray) -> FloatArray:
    """Return the facing direction of a device (..., 2), not normalised, from attitudes (..., 3, 3).

    Its angle is the attitude's twist about the vertical. Its length is 1 for a level device and
    falls to 0 for one upside down, whose heading is undefined.
    """
    return 0.5 * np.stack(
        [R_NB[..., 0, 0] + R_NB[..., 1, 1], R_NB[..., 1, 0] - R_NB[..., 0, 1]], axis=-1
    )


HEADING_STEP = 20
"""Samples between the attitudes over which a window's heading is averaged."""

VELOCITY_WEIGHTS = (np.arange(WINDOW_SAMPLES) + 0.5) / (WINDOW_SAMPLES * WINDOW_RATE)
"""Weights of the accelerations in a window [s]. The weighted sum, plus that over the next window
with reversed weights, is the change of mean velocity from one second to the next."""


def mean_heading(facing_N: FloatArray | NDArray[np.float32]) -> FloatArray:
    """Return headings (B,) [rad] of windows from facing directions (B, 10, 2) at ten instants."""
    total = np.asarray(facing_N, dtype=np.float64).sum(axis=-2)
    return np.asarray(np.arctan2(total[..., 1], total[..., 0]))


def rotated_windows(windows: NDArray[np.float32], yaw: FloatArray) -> NDArray[np.float32]:
    """Rotate windows (B, 6, 200) about the vertical by `yaw` (B,) [rad]."""
    R = about_z(yaw).as_matrix().astype(np.float32)
    vectors = windows.reshape(len(windows), 2, 3, WINDOW_SAMPLES)
    turned: NDArray[np.float32] = (R[:, None] @ vectors).reshape(windows.shape)
    return turned


def resample(time: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """Resample values (N, K) at `time` to the even `grid` (M,) at 200 Hz within it.

    Faster sensors are averaged over each grid step, so that noise and vibration above 100 Hz do
    not alias; slower ones are interpolated linearly.
    """
    step = 1.0 / WINDOW_RATE
    steps = time[1:] - time[:-1]
    if len(time) < 2 or np.sort(steps)[len(steps) // 2] > 0.67 * step:
        return interpolated(grid, time, values)
    total = integral(time, values)
    edges = np.clip(np.append(grid - 0.5 * step, grid[-1] + 0.5 * step), time[0], time[-1])
    return np.asarray(np.diff(interpolated(edges, time, total), axis=0) / np.diff(edges)[:, None])


def world_streams(sequence: ImuSequence, attitude: Attitude = "levelled") -> list[WorldStream]:
    """Cut a recording with ground truth into unbroken 200 Hz stretches in the world frame.

    No stretch spans a gap of the IMU (`MAX_IMU_GAP`) or of the truth (`MAX_TRUTH_GAP`); stretches
    shorter than two windows are skipped.

    Args:
        sequence: the recording.
        attitude: "levelled" (by the IMU, with the true heading) or "true". Under a true attitude,
            a misalignment of device or truth tilts the mean specific force: a network learns the
            facing direction from that cue, which is missing at inference.

    Raises:
        InputError: the recording has no truth, its rate is not between 50 Hz and 1 kHz, or an
            argument has the wrong type or value.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    check_choice("attitude", attitude, get_args(Attitude))
    if sequence.truth is None:
        raise InputError(f"{sequence.name}: truth", "none", "a true trajectory for training")
    truth, known = sequence.truth, sequence.truth.valid
    world = imu_in_world(sequence, truth, attitude)
    position_W = interpolated(world.time, truth.time[known], truth.position_W[known])
    return [
        WorldStream(
            name=sequence.name,
            imu_W=world.imu[start:stop],
            position_W=(position_W[start:stop] - position_W[start]).astype(np.float32),
            facing_W=world.facing[start:stop],
        )
        for start, stop in runs(world.usable)
        if stop - start >= 2 * WINDOW_SAMPLES
    ]


def imu_in_world(sequence: ImuSequence, truth: Trajectory, attitude: Attitude) -> LevelledImu:
    """Return the IMU at 200 Hz in the world frame, with `attitude` as for `world_streams`.

    Raises:
        InputError: as for `clean_samples`.
    """
    time, gyro, accel = spike_free_samples(sequence)
    pose = truth.at(time)
    attitude_WB = pose.attitude_WB
    if attitude == "levelled":
        attitude_WB = _levelled(time, gyro, accel, attitude_WB, pose.valid)
    omitted = np.cumsum(np.maximum(np.floor(np.diff(time, prepend=time[0])) - 1.0, 0.0))
    even_time = time - omitted
    even = even_grid(even_time[0], even_time[-1], 1.0 / WINDOW_RATE)
    grid = even + omitted[np.searchsorted(even_time, even, side="right") - 1]
    columns = [attitude_WB.apply(gyro), attitude_WB.apply(accel), facing(attitude_WB.as_matrix())]
    values = resample(even_time, np.concatenate(columns, axis=1), even).astype(np.float32)
    right = np.clip(np.searchsorted(even_time, even), 1, len(even_time) - 1)
    in_gap = even_time[right] - even_time[right - 1] > MAX_IMU_GAP
    return LevelledImu(grid, values[:, :6], values[:, 6:], ~in_gap & truth.covers(grid))


def _levelled(
    time: FloatArray, gyro: FloatArray, accel: FloatArray, true_WB: Rotation, known: BoolArray
) -> Rotation:
    """Return attitudes levelled by the IMU and rotated about the vertical to the true heading.

    Within a window the heading follows the gyroscope, as at inference: the rotation is averaged
    over a second.
    """
    R_NB = np.empty((len(time), 3, 3))
    parts = [slice(start, stop) for start, stop in unbroken(time)]
    for part in parts:
        R_NB[part] = levelled_attitudes(time[part], gyro[part], accel[part])
    levelled_NB = Rotation.from_matrix(R_NB)
    turn = yaw_of(true_WB * levelled_NB.inv())
    second = samples_in(WINDOW_SECONDS, time)
    changes = np.flatnonzero(np.diff(known.astype(np.int8))) + 1
    edges = np.union1d([part.start for part in parts], changes)
    for start, stop in pairwise([*edges.tolist(), len(time)]):
        part = slice(start, stop)
        turn[part] = uniform_filter1d(np.unwrap(turn[part]), second, mode="nearest")
    return about_z(turn) * levelled_NB


def window_starts(samples: Sized, stride: int) -> NDArray[np.int64]:
    """Return the first samples (M,) of windows every `stride` of some samples."""
    return np.arange(0, len(samples) - WINDOW_SAMPLES, stride)


def cut_windows(imu: NDArray[np.float32], starts: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the windows (M, 6, 200) of samples (N, 6) that start at samples `starts` (M,)."""
    rows = starts[:, None] + np.arange(WINDOW_SAMPLES)
    return np.ascontiguousarray(imu[rows].transpose(0, 2, 1))


def headings_at(facing: NDArray[np.float32], starts: NDArray[np.int64]) -> FloatArray:
    """Return the device's heading (M,) [rad] in the windows that start at samples `starts`.

    Args:
        facing: (N, 2) facing directions along the stream, from the function of that name.
        starts: (M,) first samples of the windows.
    """
    return mean_heading(facing[starts[:, None] + np.arange(0, WINDOW_SAMPLES, HEADING_STEP)])
