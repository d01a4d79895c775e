"""The hierarchical bootstrap of errors: ratios of networks with their intervals, and ranks.

Errors within a recording, a person or a place are correlated: treating windows as independent would
make any difference look certain. The hierarchical bootstrap (Davison, Hinkley: Bootstrap Methods
and their Application, 1997, section 3.8) draws groups, then recordings in each group, then blocks
of 30 s in each recording, all with replacement. Every replicate draws the same for all networks, so
that difficulty common to them cancels. Sets are not resampled; they and their groups have equal
weights, and so have the seeds of a network.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from stario.sequences.sequence import FloatArray

REPLICATES = 1000
CONFIDENCE = 0.95
_BOUNDS = (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE))
"""Percentiles of the replicates that bound an interval."""

_MIN_BLOCKS = 5
"""Minimum number of blocks for an interval: that of one has no width, and that of two recordings
with a block each holds the true ratio only half of the time."""

_UNITS = ("set", "group", "recording")


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


def paired_ratio(blocks: pd.DataFrame, ours: str, theirs: str) -> Interval | None:
    """Return the ratio of two networks' errors over the recordings that both have errors on.

    A recording without any error, such as of a device at rest, has no ratio. Blocks have the sum of
    the squared errors (`squares`), their `count`, and the labels `set`, `group`, `recording`,
    `block` (number in the recording), `network` and `seed`.
    """
    pair = blocks[blocks["network"].isin([ours, theirs])]
    total = pair.groupby([*_UNITS, "network", "seed"])["squares"].transform("sum")
    found = ranks(pair[total > 0.0], theirs).set_index("network")["ratio"]
    return found.get(ours) if theirs in found else None


def ranks(blocks: pd.DataFrame, against: str) -> pd.DataFrame:
    """Rank networks by the geometric mean of their errors over the recordings common to all.

    Returns:
        Each `network` with its `rank`, 1 for the smallest error, the interval's bounds `rank_low`
        and `rank_high`, and the `ratio` of its error to that of `against`, an `Interval`; None
        without `against`. No rows if no recording is common to all.
    """
    table = blocks.set_index([*_UNITS, "block", "network", "seed"])[["squares", "count"]]
    runs = table.unstack(["network", "seed"], sort=False).dropna()
    if runs.empty:
        return pd.DataFrame(columns=["network", "rank", "rank_low", "rank_high", "ratio"])
    rng = np.random.default_rng(0)
    of_sets = [_resampled(part, _UNITS[1:], rng) for _, part in runs.groupby("set", sort=False)]
    logs = pd.DataFrame(np.mean(of_sets, axis=0), columns=runs["squares"].columns)
    by_name = logs.T.groupby(level="network", sort=False).mean()  # (N, 1 + R), first the whole
    places = by_name.rank(method="first").astype(int).to_numpy()
    low, high = np.percentile(places[:, 1:], _BOUNDS, axis=1, method="nearest")
    ratios: list[Interval | None] = [None] * len(by_name)
    if against in by_name.index:
        apart = (by_name - by_name.loc[against]).to_numpy()
        bounds = np.full((2, len(apart)), np.nan)
        if len(runs) >= _MIN_BLOCKS:
            bounds = np.percentile(apart[:, 1:], _BOUNDS, axis=1)
        found = np.exp(np.vstack([apart[:, 0], bounds])).T
        ratios = [Interval(*each) for each in found.tolist()]
    columns = {"network": by_name.index, "rank": places[:, 0], "rank_low": low, "rank_high": high}
    return pd.DataFrame({**columns, "ratio": ratios})


def _resampled(part: pd.DataFrame, units: Sequence[str], rng: np.random.Generator) -> FloatArray:
    """Return mean log errors (1 + R, runs): of all, then of the replicates.

    Replicates draw from the members by the first of the units, whose members are drawn likewise;
    without units, from the blocks.
    """
    if not units:
        squares, count = part["squares"].to_numpy(), part["count"].to_numpy()
        rows = rng.integers(len(part), size=(REPLICATES, len(part)))
        rows = np.vstack([np.arange(len(part)), rows])
        sums = np.maximum(squares[rows].sum(axis=1), 1e-12)
        return np.asarray(0.5 * np.log(sums / count[rows].sum(axis=1)))
    members = part.groupby(units[0], sort=False)
    values = np.stack([_resampled(member, units[1:], rng) for _, member in members])
    rows = rng.integers(len(values), size=(len(values), REPLICATES))
    drawn = np.take_along_axis(values[:, 1:], rows[..., None], axis=0)
    return np.asarray(np.concatenate([values[:, :1], drawn], axis=1).mean(axis=0))
