"""Validation of a network in training on held-out recordings, and calibration of its sigma.

A network predicts which windows are hard better than how hard they are. Its log sigma is therefore
stretched and shifted, sigma = scale * exp(exponent * log_sigma), with the pair of highest
likelihood on the errors of validation windows. No sigma explains the errors of a few windows; the
squared normalised error is clipped so that these do not dominate.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from stario.network.card import Calibration
from stario.network.displacement import DisplacementNetwork
from stario.network.training.augment import UNVARIED
from stario.network.training.config import LEAST_SECONDS, TrainingConfig
from stario.network.training.data import TrainingData
from stario.network.training.legs import LegBatch, LegSampler, by_kind
from stario.network.training.losses import leg_loss
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.legs import LegStream
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import (
    WINDOW_SAMPLES,
    WorldStream,
    cut_windows,
    headings_at,
    rotated_windows,
    window_starts,
)

log = logging.getLogger(__name__)

_STRIDE = 20
"""Samples between the starts of successive windows."""

_DENSE_SAMPLES = 200 * 60 * 15
"""For N times this many samples in total, windows are cut at N times that stride. For recurrent
networks, one minute in N is cut: each window follows one from a second before, as at inference."""

_BATCH = 256
"""Windows per batch."""

_STRETCHES = 48
"""Number of stretches for each kind of weak truth."""

_FLOOR_M = 0.01
_CLIP = 25.0
_MAX_EXPONENT = 4.0

_NOTICEABLE = 0.02
"""Logarithm of a ratio of errors in validation that is worth a warning."""


class ValidationSet:
    """Held-out windows, cut again for each evaluation because all of them would fill the memory.

    Args:
        data: held-out streams.
        config: recipe that determines how stretches of weak truth are drawn.
        is_recurrent: whether the evaluated networks are recurrent.

    Raises:
        InputError: no stream is longer than a second.
    """

    def __init__(
        self, data: TrainingData, config: TrainingConfig, is_recurrent: bool = False
    ) -> None:
        self.streams, self._simulated = data.streams, data.simulated
        self.legs = _drawn_once(data.legs, config)
        # Hours of data are cut sparsely: the variety of motion matters, not the number of windows.
        every = max(1, sum(len(stream) for stream in data.streams) // _DENSE_SAMPLES)
        self.stride = _STRIDE if is_recurrent else _STRIDE * every
        if is_recurrent and every > 1:
            minute = 60 * WINDOW_SAMPLES
            self.streams = [
                stream.part(first, first + minute)
                for stream in data.streams
                for first in range(0, len(stream), every * minute)
            ]
        counts = [len(window_starts(stream, self.stride)) for stream in self.streams]
        if not sum(counts):
            raise InputError("validation", "no window", "stretches longer than a second")
        self.names = np.repeat([stream.name for stream in self.streams], counts)

    @torch.inference_mode()
    def residuals(self, network: DisplacementNetwork) -> tuple[np.ndarray, np.ndarray]:
        """Return errors (M, 3) [m] and log sigmas (M, 3); leave the network in evaluation mode."""
        network.eval()
        errors, log_sigmas = [], []
        # Windows that begin within the same second belong to separate series, as at inference.
        batch = WINDOW_SAMPLES // self.stride if network.is_recurrent else _BATCH
        for stream in self.streams:
            after: list[torch.Tensor] = []
            for cut, target in self._cut(stream, batch):
                windows = torch.from_numpy(cut).to(network.gravity.device)
                before = (state[:, : len(windows)].contiguous() for state in after)
                mean, log_sigma, *after = network(windows, *before)
                errors.append(mean.cpu() - torch.from_numpy(target))
                log_sigmas.append(log_sigma.cpu())
        return torch.cat(errors).double().numpy(), torch.cat(log_sigmas).double().numpy()

    def _cut(
        self, stream: WorldStream, batch: int
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Yield windows (B, 6, 200) and displacements (B, 3) [m] in H, in order of time."""
        starts = window_starts(stream, self.stride)
        for first in range(0, len(starts), batch):
            begin = starts[first : first + batch]
            heading = headings_at(stream.facing_W, begin)
            moved_W = stream.position_W[begin + WINDOW_SAMPLES] - stream.position_W[begin]
            windows = rotated_windows(cut_windows(stream.imu_W, begin), -heading)
            yield windows, about_z(-heading).apply(moved_W).astype(np.float32)

    def errors(
        self, network: DisplacementNetwork, residuals: np.ndarray | None = None
    ) -> dict[str, float]:
        """Return the mean squared error by recording [m^2] and by kind of legs [m^2/s].

        Args:
            network: network to evaluate; left in evaluation mode.
            residuals: (M, 3) [m], if already known.
        """
        found = self.residuals(network)[0] if residuals is None else residuals
        squared = (found**2).sum(axis=1)
        means = {str(n): float(squared[self.names == n].mean()) for n in dict.fromkeys(self.names)}
        return means | {kind: self._leg_error(network, batch) for kind, batch in self.legs.items()}

    def selection_error(self, errors: Mapping[str, float]) -> float:
        """Return the mean of the `errors` that select the weights; 0 if there are none."""
        return float(np.mean(list(self._selecting(errors).values()) or [0.0]))

    def _selecting(self, errors: Mapping[str, float]) -> Mapping[str, float]:
        by_legs = {kind: errors[kind] for kind in self.legs if kind in errors}
        return by_legs if self._simulated and by_legs else errors

    def worse(self, before: Mapping[str, float], after: Mapping[str, float]) -> str:
        """Return in words that the errors that select the weights grew; empty if they did not.

        The geometric mean gives a precise kind of truth the same voice as a noisy one.
        """
        known = self._selecting(before)
        logs = {name: np.log(max(after[name], 1e-12) / max(known[name], 1e-12)) for name in known}
        if not logs or not (mean := float(np.mean(list(logs.values())))) > _NOTICEABLE:
            return ""
        worst = max(logs, key=lambda name: logs[name])
        return (
            f"errors in validation are {np.exp(mean):.3g} times those of the initial weights "
            f"({worst}: {after[worst]:.3g} instead of {known[worst]:.3g}); "
            "keep these, or train with more recordings or a smaller `rate`"
        )

    @torch.inference_mode()
    def _leg_error(self, network: DisplacementNetwork, batch: LegBatch) -> float:
        batch = LegBatch(*(part.to(network.gravity.device) for part in batch))
        windows = batch.windows if network.is_recurrent else batch.windows.flatten(0, 1)
        mean, log_sigma, *_ = network(windows)
        shape = batch.windows.shape[:2]
        return float(leg_loss(mean.view(*shape, 3), log_sigma.view(*shape, 3), batch)[1])


def _drawn_once(legs: Sequence[LegStream], config: TrainingConfig) -> dict[str, LegBatch]:
    """Return the same stretches for every epoch, without augmentation."""
    found = {}
    for kind, members, usual, _ in by_kind(legs, config):
        # The held-out part of a short walk is shorter than a training stretch.
        longest = (max(len(stream) for stream in members) - 1) // WINDOW_SAMPLES
        seconds = min(usual, longest - longest % config.successive)
        if seconds < LEAST_SECONDS:
            continue
        try:
            sampler = LegSampler(members, seconds, UNVARIED, torch.Generator().manual_seed(0))
        except InputError as error:  # an error of 0 without legs would be the smallest
            log.warning("validation skips %s", error)
            continue
        found[kind] = sampler.batch(_STRETCHES)
    return found


def calibrate(error: FloatArray, log_sigma: FloatArray) -> Calibration:
    """Fit a calibration to errors (M, 3) [m] and log sigmas (M, 3).

    x and y share scale and exponent.
    """
    scale_h, exponent_h = _fit(error[:, :2].ravel(), log_sigma[:, :2].ravel())
    scale_z, exponent_z = _fit(error[:, 2], log_sigma[:, 2])
    return Calibration(
        scale=(scale_h, scale_h, scale_z),
        exponent=(exponent_h, exponent_h, exponent_z),
        floor=(_FLOOR_M,) * 3,
    )


def _fit(error: FloatArray, log_sigma: FloatArray) -> tuple[float, float]:
    """Return the scale and exponent that minimise the clipped negative log-likelihood."""

    def cost(parameters: FloatArray) -> float:
        log_scale, exponent = parameters
        variance = np.exp(2.0 * (log_scale + exponent * log_sigma)) + _FLOOR_M**2
        normalised = np.minimum(error**2 / variance, _CLIP)
        return float(np.mean(normalised + np.log(variance)))

    # An uninformative sigma is ignored (exponent 0), never used with its sign reversed.
    bounds = [(-10.0, 10.0), (0.0, _MAX_EXPONENT)]
    log_scale, exponent = minimize(cost, [0.0, 1.0], method="Nelder-Mead", bounds=bounds).x
    return float(np.exp(log_scale)), float(exponent)
