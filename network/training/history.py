"""The epochs of a training run, and which of them is the best."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stario.network.training.config import TrainingConfig


@dataclass(frozen=True)
class EpochReport:
    """Result of one epoch; errors are mean squared displacement errors [m^2].

    Attributes:
        epoch: number of the epoch, from 1.
        training_error: error on its augmented windows.
        validation_error: the error that selects weights (`ValidationSet.selection_error`).
        validation_by_recording: error of each recording, and of each kind of weak truth [m^2/s].
        windows_per_second: training windows of this process, with full or weak truth.
        drawing_share: share of the time spent drawing them while the network waits.
    """

    epoch: int
    training_error: float
    validation_error: float
    validation_by_recording: dict[str, float]
    windows_per_second: float = 0.0
    drawing_share: float = 0.0


@dataclass
class History:
    """Reports of a run's epochs.

    Attributes:
        config: the recipe.
        reports: one report for each epoch so far.
    """

    config: TrainingConfig
    reports: list[EpochReport] = field(default_factory=list)

    def epochs_since_best(self) -> int:
        """Return the epochs since the smallest validation error; NaN and inf are never smallest.

        Sigma is meaningless until the likelihood is part of the loss: from then on, only epochs
        trained with it count.
        """
        counted = self.reports[self._first_with_sigma - 1 :] or self.reports
        # `np.argmin` treats NaN as the smallest.
        errors = [e if math.isfinite(e := r.validation_error) else math.inf for r in counted]
        return len(errors) - 1 - int(np.argmin(errors))

    def best(self) -> EpochReport:
        """Return the report of the epoch whose weights are kept."""
        return self.reports[-1 - self.epochs_since_best()]

    def should_stop(self) -> bool:
        """Return whether validation has stopped improving; False until sigma is learned."""
        learned = len(self.reports) >= self._first_with_sigma
        return learned and self.epochs_since_best() >= self.config.patience

    @property
    def _first_with_sigma(self) -> int:
        """First epoch that learns sigma in every step; the last epoch of a short run."""
        first = math.ceil(self.config.likelihood_from * self.config.epochs) + 1
        return min(first, self.config.epochs) if self.config.likelihood_from < 1.0 else first
