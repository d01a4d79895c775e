"""From raw samples to epochs: what stands before network and filter, alike in stream and batch.

Samples are checked, brought into strictly increasing time and cut at an even grid of times, with
the IMU interpolated exactly there (so that nothing is integrated twice or left out). Each epoch
carries its samples; at the times of a network update also the window that ends there, once a
second of unbroken samples is there.
Nothing here depends on the filter: batch runs may therefore hand all windows to the
network at once and still give the streamed track.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stario.fusion.attitude import LevelledAttitude, start_from_gravity
from stario.fusion.config import NavigatorConfig
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.windows import (
    MAX_IMU_GAP,
    WINDOW_RATE,
    WINDOW_SECONDS,
    resample,
)

START_SECONDS = 1.0
"""Length of the stretch whose mean specific force levels the first attitude [s]."""

_ABSURD = 1e5
"""No sensor reads this much in any unit used here; also catches infinities."""

Sample = tuple[float, float, float, float, float, float, float]
"""Time [s], gyroscope xyz [rad/s], specific force xyz [m/s^2]."""


@dataclass(frozen=True, eq=False)
class Epoch:
    """The stretch between two times of the grid.

    Attributes:
        time: (n + 1,) sample times, first and last are the grid's [s].
        gyro: (n + 1, 3) [rad/s] in B, interpolated at both ends.
        accel: (n + 1, 3) [m/s^2] in B, likewise.
        gap: True where no samples arrived for longer than is bridged; the samples then say nothing.
        attitudes: (n + 1, 3, 3) levelled attitude R_NB at the samples.
        R_NB: (3, 3) levelled attitude at the end, gravity's correction applied.
        update: whether windows begin and end at this epoch's end.
        window: (6, 200) the network's input that ends here, None where there is none.
        R_NB_window: (3, 3) levelled attitude at the window's start.
    """

    time: FloatArray
    gyro: FloatArray
    accel: FloatArray
    gap: bool
    attitudes: FloatArray
    R_NB: FloatArray
    update: bool = False
    window: NDArray[np.float32] | None = None
    R_NB_window: FloatArray | None = None

    @property
    def start(self) -> float:
        """Its first time [s]."""
        return float(self.time[0])

    @property
    def stop(self) -> float:
        """Its last time [s]."""
        return float(self.time[-1])


@dataclass(frozen=True, eq=False)
class Start:
    """Where the filter begins: the first sample's time, and what `GravityStart` knows of it."""

    time: float
    R_WB: FloatArray
    still: bool
    force: float


@dataclass
class IntakeCounts:
    """What became of the samples.

    Attributes:
        used: samples taken in.
        not_finite: dropped for a value that is not a number, infinite or absurdly large.
        duplicate: dropped for repeating the newest time.
        out_of_order: dropped for a time before the newest.
        gaps: (start, length) [s] of the stretches without samples that were not bridged.
    """

    used: int = 0
    not_finite: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    gaps: list[tuple[float, float]] = field(default_factory=list)

    def samples(self) -> dict[str, int]:
        """Samples by what became of them."""
        return {k: v for k, v in vars(self).items() if k != "gaps"}


class Intake:
    """Collects samples and yields epochs.

    Args:
        config: update rate and levelling.
    """

    def __init__(self, config: NavigatorConfig) -> None:
        self._config = config
        rate = config.filter.output_rate
        self._period = 1.0 / rate
        self._blocks = round(rate * WINDOW_SECONDS)  # epochs in a window
        self._block_grid = np.arange(round(WINDOW_RATE / rate)) / WINDOW_RATE
        self._samples: list[Sample] = []
        self._attitude: LevelledAttitude | None = None
        self._origin, self._index = 0.0, 0
        self._next = -math.inf
        self._newest = -math.inf
        self._window: deque[NDArray[np.float32]] = deque(maxlen=self._blocks)
        self._starts: deque[FloatArray] = deque(maxlen=self._blocks)
        self.counts = IntakeCounts()
        self.start: Start | None = None

    def push(self, sample: Sample) -> list[Epoch]:
        """Take one sample in; returns the epochs it completes (mostly none, seldom several)."""
        time = sample[0]
        if not (math.isfinite(time) and sum(map(abs, sample[1:])) < _ABSURD):
            self.counts.not_finite += 1
            return []
        if time <= self._newest:
            if time == self._newest:
                self.counts.duplicate += 1
            else:
                self.counts.out_of_order += 1
            return []
        gap = time - self._newest > MAX_IMU_GAP and bool(self._samples)
        self._newest = time
        self.counts.used += 1
        if gap:
            return self._bridge_gap(sample)
        self._samples.append(sample)
        if time < self._next:
            return []
        return self._begin() if self._attitude is None else self._complete()

    def _begin(self) -> list[Epoch]:
        """Level the first attitude once its stretch is there, then catch up."""
        first = self._samples[0][0]
        if self._newest < first + START_SECONDS:
            self._next = first + START_SECONDS
            return []
        table = np.array(self._samples)
        gravity = start_from_gravity(table[:, 0], table[:, 1:4], table[:, 4:7])
        self.start = Start(first, gravity.R_WB, gravity.still, gravity.force)
        self._attitude = LevelledAttitude(gravity.R_WB, self._config.levelling_rate)
        self._restart_grid(first)
        return self._complete()

    def _bridge_gap(self, sample: Sample) -> list[Epoch]:
        """End the epoch in progress, span the gap by one of its own, start the grid anew."""
        before = self._samples
        self._samples = [sample]
        self.counts.gaps.append((before[-1][0], sample[0] - before[-1][0]))
        if self._attitude is None:
            self._next = -math.inf
            return []
        epochs = []
        if len(before) > 1:
            epochs.append(_epoch(np.array(before), self._attitude))
        self._window.clear()
        self._starts.clear()
        self._attitude.restart()
        epochs.append(_epoch(np.array([before[-1], sample]), self._attitude, gap=True))
        self._restart_grid(sample[0])
        return epochs

    def _restart_grid(self, origin: float) -> None:
        self._origin, self._index = origin, 1
        self._next = origin + self._period

    def _complete(self) -> list[Epoch]:
        epochs = []
        while self._newest >= self._next:
            epochs.append(self._with_window(self._cut()))
        return epochs

    def _cut(self) -> FloatArray:
        """Samples of one period, the last one interpolated at its end; the rest stays."""
        stop = self._next
        later = next(k for k, sample in enumerate(self._samples) if sample[0] >= stop)
        end = _interpolated(self._samples[later - 1], self._samples[later], stop)
        inside, rest = self._samples[:later], self._samples[later:]
        self._samples = rest if rest[0][0] == stop else [end, *rest]
        self._index += 1
        self._next = self._origin + self._index * self._period
        return np.array([*inside, end])

    def _with_window(self, table: FloatArray) -> Epoch:
        attitude = self._attitude
        assert attitude is not None  # no epoch is cut before the start
        self._starts.append(attitude.R_NB)
        # _cut() has counted this epoch already.
        update = (self._index - 1) % self._config.filter.epochs_per_update == 0
        epoch = replace(_epoch(table, attitude), update=update)
        imu_N = _turned(epoch.attitudes, epoch.gyro, epoch.accel)
        grid = epoch.start + self._block_grid
        self._window.append(resample(epoch.time, imu_N, grid).astype(np.float32).T)
        if not update or len(self._window) < self._blocks:
            return epoch
        window = np.concatenate(self._window, axis=1)
        return replace(epoch, window=window, R_NB_window=self._starts[0])


def all_epochs(sequence: ImuSequence, config: NavigatorConfig) -> tuple[list[Epoch], Intake]:
    """Every epoch of a recording, and the intake with its counts and start."""
    intake = Intake(config)
    epochs: list[Epoch] = []
    for sample in np.column_stack([sequence.time, sequence.gyro, sequence.accel]).tolist():
        epochs += intake.push(tuple(sample))
    return epochs, intake


def _epoch(table: FloatArray, attitude: LevelledAttitude, gap: bool = False) -> Epoch:
    time, gyro, accel = table[:, 0], table[:, 1:4], table[:, 4:7]
    if gap:
        attitudes = np.stack([attitude.R_NB, attitude.R_NB])
    else:
        attitudes = attitude.advance(time, gyro, accel)
    return Epoch(time, gyro, accel, gap, attitudes, attitude.R_NB)


def _turned(R: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Both vectors of each sample (n, 3) turned by R (n, 3, 3), side by side (n, 6)."""
    rows: FloatArray = np.stack([gyro, accel], axis=1) @ R.transpose(0, 2, 1)
    return rows.reshape(-1, 6)


def _interpolated(before: Sample, after: Sample, time: float) -> Sample:
    weight = (time - before[0]) / (after[0] - before[0])
    values = [b + weight * (a - b) for b, a in zip(before[1:], after[1:], strict=True)]
    return (time, *values)  # type: ignore[return-value]  # seven numbers, as in a sample
