"""Stretches of weak ground truth drawn for training: windows with the legs between known positions.

`stario.network.training.losses` has the equations.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stario.network.training.augment import Augmentation, Stretches, augmented, heading_of
from stario.network.training.config import TrainingConfig
from stario.sequences.arrays import runs
from stario.sequences.errors import ConfigError, InputError
from stario.sequences.legs import LegStream
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import HEADING_STEP, VELOCITY_WEIGHTS, WINDOW_RATE, WINDOW_SAMPLES

log = logging.getLogger(__name__)

VARIANCE_RATE = 0.05
"""Variance per axis that a second of the network's displacements adds, q [m^2/s]."""

_BANK = 4096
"""Stretches drawn once for a GPU, which then draws among them: 22 hours of them."""

_SETTINGS = {"waypoints": "waypoint", "positions": "track"}
"""How the recipe's settings for stretches of each kind begin: `waypoint_seconds`, for example."""


class LegBatch(NamedTuple):
    """S stretches of K windows with up to M legs each.

    Attributes:
        windows: (S, K, 6, 200) as presented to the network.
        R_NH: (S, K, 3, 3) maps the network's predictions to N and undoes the mirroring.
        velocity_change: (S, K - 2, 2) change of the mean velocity in N over two seconds, by the
            accelerometer, as returned by `velocity_change` [m/s].
        share: (S, M, K) time shared by a leg and a window [s].
        displacement: (S, M, 3) of the legs [m]; zero where there is no leg.
        whitening: (S, M, M) maps residuals to unit variance; zero where there is no leg.
        variance: (S, M) of the legs, due to their ends alone [m^2].
        seconds: (S, M) duration of the legs [s]; 1 where there is no leg.
        known: (S, M) whether there is a leg.
    """

    windows: Tensor
    R_NH: Tensor
    velocity_change: Tensor
    share: Tensor
    displacement: Tensor
    whitening: Tensor
    variance: Tensor
    seconds: Tensor
    known: Tensor


class LegSampler:
    """Sampler of stretches of consecutive windows with two or more legs.

    Args:
        streams: one or more, of one kind; those without two legs within `seconds` are skipped.
        seconds: number of consecutive windows, K.
        augmentation: how windows are varied.
        generator: generator of all draws; shared with the sampler of windows with full truth.

    Raises:
        InputError: no stream has two legs within `seconds`.
    """

    def __init__(
        self,
        streams: Sequence[LegStream],
        seconds: int,
        augmentation: Augmentation,
        generator: torch.Generator,
    ) -> None:
        self._seconds, self.augmentation = seconds, augmentation
        found = [_beginnings(stream, seconds) for stream in streams]
        if not any(found):
            raise _too_far_apart(streams, seconds)
        if not all(found):
            log.warning(
                "%s: skipping %d of %d stretches, which hold no two legs within %d s",
                streams[0].kind, found.count([]), len(found), seconds,
            )  # fmt: skip
        self._runs = [(index, *run) for index, beginnings in enumerate(found) for run in beginnings]
        counts = torch.tensor(self._runs, dtype=torch.float64)[:, 2]
        self._cumulative = (counts / counts.sum()).cumsum(0)
        self._streams, self._generator = list(streams), generator
        device = generator.device
        self._imu_N = Stretches([stream.imu_N for stream in streams], device)
        self._facing_N = Stretches([stream.facing_N for stream in streams], device)
        self._bank: list[Tensor] | None = None
        if device.type == "cuda":
            seeded = torch.Generator().manual_seed(generator.initial_seed())
            self._bank = [part.to(device) for part in self._drawn(_BANK, seeded)]

    def batch(self, size: int) -> LegBatch:
        """Draw stretches that hold two or more legs each."""
        if self._bank is None:
            drawn = self._drawn(size, self._generator)
        else:
            device = self._generator.device
            rows = torch.randint(_BANK, (size,), generator=self._generator, device=device)
            drawn = [part[rows] for part in self._bank]
        stream, begin, *legs = drawn
        length = self._seconds * WINDOW_SAMPLES
        imu_N = self._imu_N.gathered(stream, begin, length)
        facing_N = self._facing_N.gathered(stream, begin, length)[:, ::HEADING_STEP]
        heading = heading_of(facing_N.reshape(size, self._seconds, -1, 2)).flatten()
        change = velocity_change(imu_N[..., 3:5].view(size, self._seconds, WINDOW_SAMPLES, 2))
        imu_N = imu_N.view(-1, WINDOW_SAMPLES, 6)
        imu, R_NH = augmented(imu_N, heading, self.augmentation, self._generator, self._seconds)
        windows = imu.transpose(1, 2).reshape(size, self._seconds, 6, WINDOW_SAMPLES)
        return LegBatch(windows.contiguous(), R_NH.view(size, -1, 3, 3), change, *legs)

    def _drawn(self, size: int, generator: torch.Generator) -> list[Tensor]:
        """Return the streams' numbers and first samples of stretches (S,), and their legs."""
        places = []
        for _ in range(size):
            uniform = torch.rand(2, generator=generator, dtype=torch.float64)
            index = int(torch.searchsorted(self._cumulative, uniform[0]))
            stream, first, count = self._runs[min(index, len(self._runs) - 1)]
            places.append((stream, first + int(uniform[1] * count)))
        length = self._seconds * WINDOW_SAMPLES
        parts = [self._streams[stream].part(begin, begin + length) for stream, begin in places]
        return [*torch.tensor(places).unbind(1), *_padded(parts, self._seconds)]


def _beginnings(stream: LegStream, seconds: int) -> list[tuple[int, int]]:
    """Return the runs of samples, first and count, where a stretch with two legs may begin."""
    begin = np.arange(len(stream) - seconds * WINDOW_SAMPLES) / WINDOW_RATE
    # Counted as in `LegStream.part`: legs are in order of time.
    over = np.searchsorted(stream.stop, begin + seconds, side="right")
    enough = over - np.searchsorted(stream.start, begin) >= 2
    return [(first, stop - first) for first, stop in runs(enough)]


def _too_far_apart(streams: Sequence[LegStream], seconds: int) -> InputError:
    kind = streams[0].kind
    interval = float(np.median(np.concatenate([s.stop - s.start for s in streams])))
    longest = max(len(stream) for stream in streams) / WINDOW_RATE
    needed = math.ceil(2.0 * interval) + 1
    fix = f"set `{_SETTINGS[kind]}_seconds` in the recipe to about {needed}"
    if needed > longest:
        fix = "use longer recordings; `--validation` names those to validate on"
    found = f"one every {interval:.1f} s in stretches of up to {longest:.0f} s"
    return InputError(kind, found, f"two legs within {seconds} s", fix)


def _padded(drawn: Sequence[LegStream], seconds: int) -> list[Tensor]:
    """Return the tensors of a `LegBatch` that describe the legs of stretches."""
    counts = [len(part.start) for part in drawn]
    size, width = len(drawn), max(1, *counts)
    share = np.zeros((size, width, seconds))
    displacement, whitening = np.zeros((size, width, 3)), np.zeros((size, width, width))
    variance, duration = np.zeros((size, width)), np.ones((size, width))
    edges = np.arange(seconds)
    for s, (part, count) in enumerate(zip(drawn, counts, strict=True)):
        start, stop = part.start[:, None], part.stop[:, None]
        overlap = np.minimum(stop, edges + 1.0) - np.maximum(start, edges)
        share[s, :count] = np.maximum(overlap, 0.0)
        displacement[s, :count] = part.displacement
        duration[s, :count] = part.stop - part.start
        C = ends_covariance(part.start, part.stop, part.sigma)
        variance[s, :count] = np.diag(C)
        C += VARIANCE_RATE * np.diag(duration[s, :count])
        whitening[s, :count, :count] = np.linalg.inv(np.linalg.cholesky(C)) if count else 0.0
    known = np.arange(width) < np.array(counts)[:, None]
    arrays = [share, displacement, whitening, variance, duration]
    return [torch.from_numpy(a).float() for a in arrays] + [torch.from_numpy(known)]


def leg_samplers(
    config: TrainingConfig, streams: Sequence[LegStream], generator: torch.Generator
) -> list[tuple[LegSampler, int]]:
    """Return a sampler and the number of stretches per step for each kind of weak truth present.

    Raises:
        InputError: a kind has no stretch that is long enough for two legs.
        ConfigError: the windows in a stretch are not a multiple of `config.successive`.
    """
    samplers = []
    for kind, members, seconds, stretches in by_kind(streams, config):
        if seconds % config.successive:
            expected = f"a multiple of successive={config.successive}"
            raise ConfigError(f"seconds in a stretch with {kind}", str(seconds), expected)
        sampler = LegSampler(members, seconds, config.augmentation, generator)
        samplers.append((sampler, stretches))
    return samplers


def by_kind(
    streams: Sequence[LegStream], config: TrainingConfig
) -> list[tuple[str, list[LegStream], int, int]]:
    """Return name, streams, windows per stretch and stretches per step of each kind present."""
    return [
        (kind, members, getattr(config, f"{name}_seconds"), getattr(config, f"{name}_stretches"))
        for kind, name in _SETTINGS.items()
        if (members := [stream for stream in streams if stream.kind == kind])
    ]


def ends_covariance(start: FloatArray, stop: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return A diag(s^2) A' (M, M) [m^2]: an end shared by two legs has opposite signs in them.

    Args:
        start: (M,) start times of the legs, in order [s].
        stop: (M,) stop times of the legs [s].
        sigma: (M, 2) standard deviations of their ends [m].
    """
    C = np.diag((sigma**2).sum(axis=1))
    joined = np.flatnonzero(np.abs(stop[:-1] - start[1:]) < 1e-6)
    common = sigma[joined, 1] * sigma[joined + 1, 0]
    C[joined, joined + 1] -= common
    C[joined + 1, joined] -= common
    return C


def velocity_change(accel_N: Tensor) -> Tensor:
    """Return the change of the mean velocity from each second to the one after the next [m/s].

    Args:
        accel_N: (S, K, 200, 2) horizontal acceleration in N over K seconds [m/s^2].

    Returns:
        (S, K - 2, 2), minus the mean over the stretch.
    """
    weights = torch.from_numpy(VELOCITY_WEIGHTS).to(accel_N)
    before = torch.einsum("skic,i->skc", accel_N[:, :-1], weights)
    after = torch.einsum("skic,i->skc", accel_N[:, 1:], weights.flip(0))
    change = before + after
    changes = change[:, :-1] + change[:, 1:]
    return changes - changes.mean(dim=1, keepdim=True)
