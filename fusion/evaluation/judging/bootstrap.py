"""Confidence interval of a paired ratio of errors, by a hierarchical bootstrap.

Errors within a recording, a person or a place are correlated: treating windows as independent would
make any difference look certain. The hierarchical bootstrap (Davison, Hinkley: Bootstrap Methods
and their Application, 1997, section 3.8) draws groups, then recordings in each group, then blocks
of 30 s in each recording, all with replacement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stario.sequences.sequence import FloatArray

REPLICATES = 1000
CONFIDENCE = 0.95
BOUNDS = (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE))
"""Percentiles of the replicates that bound an interval."""

_MIN_BLOCKS = 5
"""Minimum number of blocks for an interval: that of one has no width, and that of two recordings
with a block each holds the true ratio only half of the time."""

Blocks = tuple[FloatArray, FloatArray]
"""Sums of squared errors of a recording's blocks: evaluated network (B,) and baseline (B,)."""

Groups = Mapping[str, Sequence[Blocks]]
"""Recordings of each group."""


@dataclass(frozen=True)
class Interval:
    """Geometric mean of the ratios of root mean square errors to the baseline's, and its bounds.

    The bounds are NaN if there is too little to draw from.
    """

    ratio: float
    low: float
    high: float

    def __format__(self, form: str) -> str:
        if not math.isfinite(self.low):
            return f"{self.ratio:{form}} [too few data]"
        return f"{self.ratio:{form}} [{self.low:{form}}, {self.high:{form}}]"


def paired_ratio(strata: Mapping[str, Groups]) -> Interval | None:
    """Return the mean ratio of errors over equally weighted strata of equally weighted groups.

    Strata, such as data sets, are not resampled. None if there is no recording.
    """
    if not strata:
        return None
    rng = np.random.default_rng(0)
    results = [_stratum(groups, rng) for groups in strata.values()]
    means, replicates = zip(*results, strict=True)
    found = interval(float(np.mean(means)), np.mean(replicates, axis=0))
    recordings = [one for groups in strata.values() for group in groups.values() for one in group]
    if sum(len(evaluated) for evaluated, _ in recordings) < _MIN_BLOCKS:
        return Interval(found.ratio, math.nan, math.nan)
    return found


def interval(log_ratio: float, replicates: FloatArray) -> Interval:
    """Return the interval of a ratio from its logarithm and that of each replicate (R,)."""
    return Interval(*np.exp([log_ratio, *np.percentile(replicates, BOUNDS)]).tolist())


def _stratum(groups: Groups, rng: np.random.Generator) -> tuple[float, FloatArray]:
    """Return the mean log ratio over groups, and its replicates (R,)."""
    means, replicates = zip(*(_group(part, rng) for part in groups.values()), strict=True)
    return float(np.mean(means)), means_of_draws(np.stack(replicates), rng)


def _group(recordings: Sequence[Blocks], rng: np.random.Generator) -> tuple[float, FloatArray]:
    ratios = [0.5 * np.log(evaluated.sum() / baseline.sum()) for evaluated, baseline in recordings]
    replicates = np.stack([_recording(*blocks, rng) for blocks in recordings])
    return float(np.mean(ratios)), means_of_draws(replicates, rng)


def _recording(evaluated: FloatArray, baseline: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return log ratios (R,) of a recording, its blocks drawn with replacement."""
    rows = rng.integers(len(evaluated), size=(REPLICATES, len(evaluated)))
    return np.asarray(0.5 * np.log(evaluated[rows].sum(axis=1) / baseline[rows].sum(axis=1)))


def means_of_draws(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return for each replicate the mean of n members drawn from values (n, R) with replacement."""
    rows = rng.integers(len(values), size=values.shape)
    return np.asarray(np.take_along_axis(values, rows, axis=0).mean(axis=0))
