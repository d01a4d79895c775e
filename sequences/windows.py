"""Windows for the networks: one second at 200 Hz in a gravity-aligned frame, and their targets.

A window that starts at t_i holds the 200 samples at t_i + k / 200 s, gyroscope then accelerometer,
each rotated from the body into a gravity-aligned frame; its target is the displacement from t_i to
t_j = t_i + 1 s in that frame (TLIO, Liu et al. 2020, section IV). For training the attitude is
levelled by the IMU as in use, with the heading of the truth; or true, the papers' protocol.

The networks see a window in frame H, in which the device's heading is zero: the same motion of the
same device then looks the same whichever way it points. The heading is that of the twist about the
vertical, averaged over the window (`mean_heading`); it has no singularity but for a device that
lies upside down all the while, where any heading is as good as another.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import interpolated
from stario.sequences.attitude.levelling import levelled_attitudes
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.errors import InputError
from stario.sequences.sequence import ABSURD, BoolArray, FloatArray, ImuSequence, Trajectory
from stario.sequences.sequence import MAX_IMU_GAP as MAX_IMU_GAP
from stario.sequences.time_order import advancing

log = logging.getLogger(__name__)

WINDOW_RATE = 200.0
"""Samples per second of a window [Hz]."""

WINDOW_SAMPLES = 200
"""Samples of a window."""

WINDOW_SECONDS = WINDOW_SAMPLES / WINDOW_RATE
"""Length of a window [s]."""

Attitude = Literal["levelled", "true"]
"""By which training windows are turned into the world; see `world_streams`."""

MIN_RATE, MAX_RATE = 40.0, 1200.0
"""Sampling rates [Hz] that are accepted (50 Hz to 1 kHz, with some slack for jitter)."""


@dataclass(frozen=True, eq=False)
class WorldStream:
    """An unbroken stretch of a recording at 200 Hz in the world frame, ready to cut windows from.

    Attributes:
        name: the recording's.
        imu_W: (N, 6) float32, gyroscope [rad/s] and specific force [m/s^2] rotated into W.
        position_W: (N, 3) float32 [m], relative to the stretch's start.
        facing_W: (N, 2) float32, which way the device faces, as `facing` gives it.
    """

    name: str
    imu_W: NDArray[np.float32]
    position_W: NDArray[np.float32]
    facing_W: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.imu_W)

    def part(self, start: int, stop: int) -> WorldStream:
        """Samples from start to before stop, none where there are none."""
        part = slice(start, max(stop, start))
        return WorldStream(self.name, self.imu_W[part], self.position_W[part], self.facing_W[part])


@dataclass(frozen=True, eq=False)
class LevelledImu:
    """An IMU at 200 Hz in a gravity-aligned frame.

    Attributes:
        time: (M,) [s]; even but for long gaps, of which whole seconds are left out: a clock that
            jumps by decades must not cost memory.
        imu: (M, 6) float32, gyroscope [rad/s] and specific force [m/s^2].
        facing: (M, 2) float32, which way the device faces, as `facing` gives it.
        usable: (M,) where neither the IMU nor, if it was asked for, the truth has a gap.
    """

    time: FloatArray
    imu: NDArray[np.float32]
    facing: NDArray[np.float32]
    usable: BoolArray


def facing(R_NB: FloatArray) -> FloatArray:
    """Which way a device faces (..., 2), from attitudes (..., 3, 3): not normalised.

    Its angle is the attitude's twist about the vertical. Its length is 1 for a level device and
    falls to 0 for one upside down, whose heading is not defined.
    """
    return 0.5 * np.stack(
        [R_NB[..., 0, 0] + R_NB[..., 1, 1], R_NB[..., 1, 0] - R_NB[..., 0, 1]], axis=-1
    )


HEADING_STEP = 20
"""Samples between the attitudes that a window's heading is the mean of."""

VELOCITY_WEIGHTS = (np.arange(WINDOW_SAMPLES) + 0.5) / (WINDOW_SAMPLES * WINDOW_RATE)
"""Of the accelerations in a window [s]: with those in the next, weighted in reverse, they add up to
how the mean velocity changes from the one second to the other."""


def mean_heading(facing_N: FloatArray | NDArray[np.float32]) -> FloatArray:
    """Heading (B,) [rad] of windows from which way the device faces at ten instants (B, 10, 2)."""
    total = np.asarray(facing_N, dtype=np.float64).sum(axis=-2)
    return np.asarray(np.arctan2(total[..., 1], total[..., 0]))


def turned_windows(windows: NDArray[np.float32], yaw: FloatArray) -> NDArray[np.float32]:
    """Windows (B, 6, 200) turned about the vertical by `yaw` (B,) [rad]."""
    R = about_z(yaw).as_matrix().astype(np.float32)
    vectors = windows.reshape(len(windows), 2, 3, WINDOW_SAMPLES)
    turned: NDArray[np.float32] = (R[:, None] @ vectors).reshape(windows.shape)
    return turned


def resample(time: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """Values (N, K) at `time` brought to the even `grid` (M,) at 200 Hz.

    Faster sensors are averaged over each grid step, so that noise and vibration above 100 Hz do
    not alias; slower ones are interpolated linearly.
    """
    step = 1.0 / WINDOW_RATE
    steps = time[1:] - time[:-1]
    if len(time) < 2 or np.sort(steps)[len(steps) // 2] > 0.67 * step:
        return interpolated(grid, time, values)
    areas = 0.5 * steps[:, None] * (values[1:] + values[:-1])
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])
    edges = np.clip(np.append(grid - 0.5 * step, grid[-1] + 0.5 * step), time[0], time[-1])
    widths = np.diff(edges)
    means = np.diff(interpolated(edges, time, integral), axis=0) / np.maximum(widths, 1e-9)[:, None]
    return np.where((widths > 0.25 * step)[:, None], means, interpolated(grid, time, values))


_SHORTEST_SECONDS = 2.0 * WINDOW_SECONDS


def world_streams(
    sequence: ImuSequence,
    attitude: Attitude = "levelled",
) -> list[WorldStream]:
    """Cut a recording with truth into unbroken 200 Hz stretches in the world frame.

    No stretch spans a gap of the IMU (`MAX_IMU_GAP`) or of the truth (`MAX_TRUTH_GAP`); those
    shorter than two windows are left out.

    Args:
        sequence: the recording.
        attitude: "levelled" by the IMU with the true heading, or "true". A device that was mounted
            askew, or a truth that is, shows in the mean specific force under the true attitude:
            a network learns from it which way the device faces, and misses that in use.

    Raises:
        InputError: the recording has no truth or its rate is not between 50 Hz and 1 kHz.
    """
    if sequence.truth is None:
        raise InputError(f"{sequence.name}: truth", "none", "a true trajectory to learn from")
    world = imu_in_world(sequence, sequence.truth, attitude)
    known = sequence.truth.valid
    truth = sequence.truth
    position_W = interpolated(world.time, truth.time[known], truth.position_W[known])
    return [
        WorldStream(
            name=sequence.name,
            imu_W=world.imu[start:stop],
            position_W=(position_W[start:stop] - position_W[start]).astype(np.float32),
            facing_W=world.facing[start:stop],
        )
        for start, stop in runs(world.usable)
        if (stop - start) / WINDOW_RATE >= _SHORTEST_SECONDS
    ]


def imu_in_world(sequence: ImuSequence, truth: Trajectory, attitude: Attitude) -> LevelledImu:
    """The IMU at 200 Hz turned into the world, by an attitude as for `world_streams`.

    Raises:
        InputError: as for `clean_samples`.
    """
    time, gyro, accel = clean_samples(sequence)
    attitude_WB = truth.at(time).attitude_WB
    if attitude == "levelled":
        attitude_WB = _levelled(time, gyro, accel, attitude_WB, truth.covers(time))
    world = _even(time, gyro, accel, attitude_WB)
    return replace(world, usable=world.usable & truth.covers(world.time))


def _even(
    time: FloatArray, gyro: FloatArray, accel: FloatArray, attitude_WB: Rotation
) -> LevelledImu:
    """Samples turned by their attitudes and brought to an even 200 Hz."""
    left_out = np.cumsum(np.maximum(np.floor(np.diff(time, prepend=time[0])) - 1.0, 0.0))
    even_time = time - left_out
    even = np.arange(even_time[0], even_time[-1], 1.0 / WINDOW_RATE)
    grid = even + left_out[np.searchsorted(even_time, even, side="right") - 1]
    columns = [attitude_WB.apply(gyro), attitude_WB.apply(accel), facing(attitude_WB.as_matrix())]
    values = resample(even_time, np.concatenate(columns, axis=1), even).astype(np.float32)
    return LevelledImu(grid, values[:, :6], values[:, 6:], ~_spans_gap(even_time, even))


def _levelled(
    time: FloatArray, gyro: FloatArray, accel: FloatArray, true_WB: Rotation, known: BoolArray
) -> Rotation:
    """Attitudes levelled by the IMU, turned about the vertical to the true ones.

    Within a window the heading is the gyroscope's, as in use: the turn is averaged over a second.
    """
    parts = unbroken(time)
    levelled_NB = Rotation.from_matrix(_levelled_NB(time, gyro, accel))
    turn = yaw_of(true_WB * levelled_NB.inv())
    second = round(WINDOW_SECONDS / float(np.median(np.diff(time))))
    changes = np.flatnonzero(np.diff(known.astype(np.int8))) + 1
    edges = np.union1d([start for start, _ in parts], changes)
    for start, stop in pairwise([*edges.tolist(), len(time)]):
        part = slice(start, stop)
        turn[part] = uniform_filter1d(np.unwrap(turn[part]), second, mode="nearest")
    return about_z(turn) * levelled_NB


def _levelled_NB(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Attitudes (n, 3, 3) levelled by the IMU, each unbroken stretch for itself."""
    R_NB = np.empty((len(time), 3, 3))
    for start, stop in unbroken(time):
        part = slice(start, stop)
        R_NB[part] = levelled_attitudes(time[part], gyro[part], accel[part])
    return R_NB


def clean_samples(sequence: ImuSequence) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time, gyroscope and accelerometer with bad, repeated and out-of-order samples dropped.

    The few that jump ahead of those behind them are dropped as well, and their number is logged.

    Raises:
        InputError: what is left has fewer than two samples or a rate that is not accepted.
    """
    finite = np.isfinite(sequence.time) & (np.abs(sequence.gyro) < ABSURD).all(axis=1)
    finite &= (np.abs(sequence.accel) < ABSURD).all(axis=1)
    index = np.flatnonzero(finite)
    counts = advancing(sequence.time[index])
    ahead = _ahead(sequence.time[index], counts)
    if ahead:
        log.warning("%s: samples ahead of their time left out: %d", sequence.name, ahead)
    index = index[counts]
    if len(index) < 2:
        raise InputError(f"{sequence.name}: samples", f"{len(index)} usable", "at least 2")
    time = sequence.time[index]
    rate = float(1.0 / np.median(np.diff(time)))
    if not MIN_RATE <= rate <= MAX_RATE:
        raise InputError(
            f"{sequence.name}: rate",
            f"{rate:.1f} Hz",
            "50 Hz to 1 kHz",
            "is the time column in seconds?",
        )
    return time, sequence.gyro[index], sequence.accel[index]


def _ahead(time: FloatArray, counts: BoolArray) -> int:
    """How many of the samples that do not count are later than all before that do."""
    newest = np.maximum.accumulate(np.where(counts, time, -np.inf))
    return int((time > newest).sum())


def unbroken(time: FloatArray) -> list[tuple[int, int]]:
    """Stretches [start, stop) of increasing times (N,) [s] without a gap of the IMU."""
    breaks = np.flatnonzero(np.diff(time) > MAX_IMU_GAP) + 1
    return list(pairwise([0, *breaks.tolist(), len(time)]))


def window_starts(stream: WorldStream, stride: int) -> NDArray[np.int64]:
    """First samples (M,) of the windows every `stride` samples."""
    return np.arange(0, len(stream) - WINDOW_SAMPLES, stride)


def windows_at(
    stream: WorldStream, starts: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Windows (M, 6, 200) that begin at samples `starts` (M,), and displacements (M, 3) [m], in W.

    Frame H is that turned by minus `headings_at`.
    """
    rows = starts[:, None] + np.arange(WINDOW_SAMPLES)
    windows = np.ascontiguousarray(stream.imu_W[rows].transpose(0, 2, 1))
    return windows, stream.position_W[starts + WINDOW_SAMPLES] - stream.position_W[starts]


def headings_at(facing: NDArray[np.float32], starts: NDArray[np.int64]) -> FloatArray:
    """The device's heading (M,) [rad] in the windows that begin at samples `starts` (M,).

    Args:
        facing: (N, 2) of the stream, as the function of that name gives it.
        starts: (M,).
    """
    return mean_heading(facing[starts[:, None] + np.arange(0, WINDOW_SAMPLES, HEADING_STEP)])


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Maximal runs [start, stop) of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _spans_gap(time: FloatArray, grid: FloatArray) -> BoolArray:
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    return np.asarray(time[right] - time[right - 1] > MAX_IMU_GAP)
