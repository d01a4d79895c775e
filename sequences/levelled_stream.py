"""Input of a network at inference: a recording at 200 Hz in frame N, levelled by the IMU alone.

N is gravity-aligned; its yaw is zero at the start and drifts with the gyroscope
(`stario.sequences.attitude.levelling`). No ground truth is needed, so recordings with poses,
positions or waypoints are treated in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import even_grid
from stario.sequences.attitude.levelling import levelled_attitudes
from stario.sequences.attitude.stacks import slerp
from stario.sequences.clean_samples import spike_free_samples, unbroken
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.windows import (
    WINDOW_RATE,
    WINDOW_SAMPLES,
    cut_windows,
    facing,
    headings_at,
    resample,
)

TICK_SAMPLES = 100
"""Samples from one tick of a stream to the next; windows start at ticks."""

TICK_SECONDS = TICK_SAMPLES / WINDOW_RATE
"""Time from one tick to the next [s]."""

TICKS_PER_SECOND = round(WINDOW_RATE) // TICK_SAMPLES


@dataclass(frozen=True, eq=False)
class LevelledStream:
    """Unbroken stretch of a recording at 200 Hz in N, ready to be cut into windows.

    Attributes:
        start: time of the first sample [s].
        imu_N: (N, 6) float32, gyroscope [rad/s] and specific force [m/s^2] in N.
        facing_N: (N, 2) float32, facing direction of the device, from `stario.sequences.windows`.
        R_NB: (K, 3, 3) attitudes at the ticks, one every `TICK_SECONDS` from `start`.
    """

    start: float
    imu_N: NDArray[np.float32]
    facing_N: NDArray[np.float32]
    R_NB: FloatArray

    def __len__(self) -> int:
        return len(self.imu_N)

    @property
    def ticks(self) -> FloatArray:
        """Times (K,) of the ticks [s]."""
        return np.asarray(self.start + TICK_SECONDS * np.arange(len(self.R_NB)))

    @property
    def window_count(self) -> int:
        """Number of complete one-second windows that start at a tick."""
        return max(0, (len(self) - WINDOW_SAMPLES) // TICK_SAMPLES + 1)

    @property
    def headings(self) -> FloatArray:
        """Heading (M,) [rad] of the device in N, for each window."""
        return headings_at(self.facing_N, self._starts)

    @property
    def _starts(self) -> NDArray[np.int64]:
        return TICK_SAMPLES * np.arange(self.window_count)

    def windows(self) -> NDArray[np.float32]:
        """Return windows (M, 6, 200) in N that start at the first M ticks."""
        return cut_windows(self.imu_N, self._starts)


def levelled_streams(sequence: ImuSequence, min_seconds: float = 2.0) -> list[LevelledStream]:
    """Return the unbroken stretches of a recording, each levelled from its own start.

    Args:
        sequence: the recording; its ground truth is not used.
        min_seconds: minimum length of a stretch [s].

    Raises:
        InputError: too few samples, no stretch is long enough, or the rate is not between 50 Hz
            and 1 kHz.
    """
    time, gyro, accel = spike_free_samples(sequence)
    streams = []
    for begin, end in unbroken(time):
        if time[end - 1] - time[begin] < min_seconds:
            continue
        part = slice(begin, end)
        R_NB = levelled_attitudes(time[part], gyro[part], accel[part])
        vectors = np.stack([gyro[part], accel[part]], axis=1)
        imu = (vectors @ R_NB.transpose(0, 2, 1)).reshape(-1, 6)
        values = np.concatenate([imu, facing(R_NB)], axis=1)
        grid = even_grid(time[begin], time[end - 1], 1.0 / WINDOW_RATE)
        at_ticks = slerp(time[part], Rotation.from_matrix(R_NB), grid[::TICK_SAMPLES])
        even = resample(time[part], values, grid).astype(np.float32)
        imu_N, facing_N = (np.ascontiguousarray(part) for part in np.split(even, [6], axis=1))
        streams.append(LevelledStream(float(time[begin]), imu_N, facing_N, at_ticks.as_matrix()))
    if not streams:
        found, expected = "no unbroken stretch", f"one of {min_seconds:g} s"
        raise InputError(f"{sequence.name}: samples", found, expected)
    return streams
