"""Ranks of networks and ratios of their errors, with intervals by a paired bootstrap.

Every replicate draws the same groups (people, places), the same recordings in each and the same
blocks of 30 s in these for all networks, so that difficulty common to all of them cancels. Sets
have equal weights and are not resampled; the groups of a set have equal weights.
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

Recordings = Mapping[tuple[str, str, str], FloatArray]
"""(B, 2) sums of squares and counts per block, by a recording's set, group and name."""

Strata = Mapping[str, Mapping[str, Sequence[str]]]
"""Names of recordings by set and group."""


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


def _common(networks: Mapping[str, Sequence[Recordings]]) -> Strata:
    """Return the names of the recordings that every network has errors on, by set and group."""
    runs = [set(run) for seeds in networks.values() for run in seeds]
    strata: dict[str, dict[str, list[str]]] = {}
    for stratum, group, name in sorted(set.intersection(*runs)) if runs else []:
        strata.setdefault(stratum, {}).setdefault(group, []).append(name)
    return strata


def _score(run: Recordings, common: Strata) -> float:
    """Return the mean over sets, of the mean over groups, of the mean log error of recordings."""
    means = [
        np.mean([
            np.mean([_log_error(run[stratum, group, name].sum(axis=0)) for name in names])
            for group, names in groups.items()
        ])
        for stratum, groups in common.items()
    ]  # fmt: skip
    return float(np.mean(means))


def _replicates(run: Recordings, common: Strata) -> FloatArray:
    """Return the score of every replicate (R,); draws depend only on the recordings.

    Seeds begin with their level: NumPy ignores zeros at the end, so [0, 0] and [0] are one seed.
    """
    strata = []
    for s, (stratum, groups) in enumerate(common.items()):
        means = []
        for g, (group, names) in enumerate(groups.items()):
            errors = [
                _of_draws(run[stratum, group, name], np.random.default_rng([1, s, g, k]))
                for k, name in enumerate(names)
            ]
            means.append(means_of_draws(np.stack(errors), np.random.default_rng([2, s, g])))
        strata.append(means_of_draws(np.stack(means), np.random.default_rng([3, s])))
    return np.asarray(np.mean(strata, axis=0))


def _of_draws(blocks: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the log errors (R,) of a recording's blocks (B, 2) drawn with replacement."""
    rows = rng.integers(len(blocks), size=(REPLICATES, len(blocks)))
    return _log_error(blocks[rows].sum(axis=1))


def _log_error(sums: FloatArray) -> FloatArray:
    """Return the log of the root mean square from (..., 2) sums of squares and counts."""
    return np.asarray(0.5 * np.log(np.maximum(sums[..., 0], 1e-12) / sums[..., 1]))
