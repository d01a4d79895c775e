"""Ranks of networks and ratios of their errors, with intervals by a paired bootstrap.

Every replicate draws recordings, and blocks of 30 s in each, alike for all networks, so that what
is hard for all of them cancels. Sets of recordings count alike and are not drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.evaluation.judging.bootstrap import CONFIDENCE, REPLICATES, Interval
from stario.sequences.sequence import FloatArray

Recordings = Sequence[tuple[str, str, FloatArray]]
"""Of each recording: the set that it belongs to, its name, (B, 2) sums of squares and counts."""


@dataclass(frozen=True)
class Rank:
    """Where a network stands.

    Attributes:
        rank: 1 for the smallest error.
        low: of the interval.
        high: of the interval.
        ratio: of its error to that of the network that all are compared with; None of itself.
    """

    rank: int
    low: int
    high: int
    ratio: Interval | None


def ranks(
    networks: Mapping[str, Sequence[Recordings]], against: str, seed: int = 0
) -> dict[str, Rank]:
    """Rank networks by the geometric mean of their errors over the recordings common to all.

    Args:
        networks: by name, of each seed of the training its errors on every recording.
        against: the network that ratios are to; there are none where it is missing.
        seed: of the bootstrap.

    Returns:
        By name; empty where no recording is common to all.
    """
    common = _common(networks)
    if not common:
        return {}
    names = list(networks)
    whole = np.array([np.mean([_score(one, common) for one in networks[n]]) for n in names])
    drawn = np.stack(
        [np.mean([_drawn(one, common, seed) for one in networks[n]], axis=0) for n in names]
    )
    tail = 50.0 * (1.0 - CONFIDENCE)
    places = drawn.argsort(axis=0).argsort(axis=0) + 1
    low, high = np.percentile(places, [tail, 100.0 - tail], axis=1, method="nearest")
    rank = whole.argsort().argsort() + 1
    found = {}
    for k, name in enumerate(names):
        ratio = None
        if against in networks and name != against:
            other = names.index(against)
            bounds = np.percentile(drawn[k] - drawn[other], [tail, 100.0 - tail])
            values = np.exp([whole[k] - whole[other], *bounds])
            ratio = Interval(*(float(value) for value in values))
        found[name] = Rank(int(rank[k]), int(low[k]), int(high[k]), ratio)
    return found


def _common(networks: Mapping[str, Sequence[Recordings]]) -> dict[str, list[str]]:
    """Names of the recordings that every network has errors on, by their set."""
    runs = [one for seeds in networks.values() for one in seeds]
    known = [{(stratum, name) for stratum, name, _ in one} for one in runs]
    strata: dict[str, list[str]] = {}
    for stratum, name in sorted(set.intersection(*known)) if known else []:
        strata.setdefault(stratum, []).append(name)
    return strata


def _score(run: Recordings, common: Mapping[str, Sequence[str]]) -> float:
    """Mean over sets of the mean log error over their recordings."""
    blocks = {(stratum, name): value for stratum, name, value in run}
    means = [
        np.mean([_log_error(blocks[stratum, name].sum(axis=0)) for name in names])
        for stratum, names in common.items()
    ]
    return float(np.mean(means))


def _drawn(run: Recordings, common: Mapping[str, Sequence[str]], seed: int) -> FloatArray:
    """The same of every replicate (R,); the draws depend on seed and recordings alone."""
    blocks = {(stratum, name): value for stratum, name, value in run}
    strata = []
    for s, (stratum, names) in enumerate(common.items()):
        errors = []
        for k, name in enumerate(names):
            value = blocks[stratum, name]
            rng = np.random.default_rng([seed, s, k])
            rows = rng.integers(len(value), size=(REPLICATES, len(value)))
            errors.append(_log_error(value[rows].sum(axis=1)))
        rng = np.random.default_rng([seed, s])
        rows = rng.integers(len(names), size=(len(names), REPLICATES))
        strata.append(np.take_along_axis(np.stack(errors), rows, axis=0).mean(axis=0))
    return np.asarray(np.mean(strata, axis=0))


def _log_error(sums: FloatArray) -> FloatArray:
    """Log of the root mean square of (..., 2) sums of squares and counts."""
    return np.asarray(0.5 * np.log(np.maximum(sums[..., 0], 1e-12) / sums[..., 1]))
