"""Ranks of networks and ratios of their errors, with intervals by a paired bootstrap.

Every replicate draws the same recordings, and the same blocks of 30 s in each, for all networks, so
that difficulty common to all of them cancels. Sets have equal weights and are not resampled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.evaluation.judging.bootstrap import (
    BOUNDS,
    REPLICATES,
    Interval,
    interval,
    means_of_draws,
)
from stario.sequences.sequence import FloatArray

Recordings = Mapping[tuple[str, str], FloatArray]
"""(B, 2) sums of squares and counts per block, by a recording's set and name."""


@dataclass(frozen=True)
class Rank:
    """Rank of a network.

    Attributes:
        rank: 1 for the smallest error.
        low: lower bound of the rank's interval.
        high: upper bound of the rank's interval.
        ratio: its error over the reference network's; None for the reference or without one.
    """

    rank: int
    low: int
    high: int
    ratio: Interval | None


def ranks(networks: Mapping[str, Sequence[Recordings]], against: str) -> dict[str, Rank]:
    """Rank networks by the geometric mean of their errors over the recordings common to all.

    Args:
        networks: errors on every recording for each training seed, by network name.
        against: reference network of the ratios; if it is missing, there are no ratios.

    Returns:
        Ranks by network name; empty if no recording is common to all.
    """
    common = _common(networks)
    if not common:
        return {}
    names = list(networks)
    scores = np.array([np.mean([_score(run, common) for run in networks[n]]) for n in names])
    replicates = np.stack(
        [np.mean([_replicates(run, common) for run in networks[n]], axis=0) for n in names]
    )
    places = replicates.argsort(axis=0).argsort(axis=0) + 1
    low, high = np.percentile(places, BOUNDS, axis=1, method="nearest")
    rank = scores.argsort().argsort() + 1
    found = {}
    for k, name in enumerate(names):
        ratio = None
        if against in networks and name != against:
            other = names.index(against)
            ratio = interval(scores[k] - scores[other], replicates[k] - replicates[other])
        found[name] = Rank(int(rank[k]), int(low[k]), int(high[k]), ratio)
    return found


def _common(networks: Mapping[str, Sequence[Recordings]]) -> dict[str, list[str]]:
    """Return the names of the recordings that every network has errors on, by set."""
    runs = [set(run) for seeds in networks.values() for run in seeds]
    strata: dict[str, list[str]] = {}
    for stratum, name in sorted(set.intersection(*runs)) if runs else []:
        strata.setdefault(stratum, []).append(name)
    return strata


def _score(run: Recordings, common: Mapping[str, Sequence[str]]) -> float:
    """Return the mean over sets of the mean log error over their recordings."""
    means = [
        np.mean([_log_error(run[stratum, name].sum(axis=0)) for name in names])
        for stratum, names in common.items()
    ]
    return float(np.mean(means))


def _replicates(run: Recordings, common: Mapping[str, Sequence[str]]) -> FloatArray:
    """Return the score of every replicate (R,); draws depend only on the recordings."""
    strata = []
    for s, (stratum, names) in enumerate(common.items()):
        errors = []
        for k, name in enumerate(names):
            value = run[stratum, name]
            rng = np.random.default_rng([0, s, k])
            rows = rng.integers(len(value), size=(REPLICATES, len(value)))
            errors.append(_log_error(value[rows].sum(axis=1)))
        strata.append(means_of_draws(np.stack(errors), np.random.default_rng([0, s])))
    return np.asarray(np.mean(strata, axis=0))


def _log_error(sums: FloatArray) -> FloatArray:
    """Return the log of the root mean square from (..., 2) sums of squares and counts."""
    return np.asarray(0.5 * np.log(np.maximum(sums[..., 0], 1e-12) / sums[..., 1]))
