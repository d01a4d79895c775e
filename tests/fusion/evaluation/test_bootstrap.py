"""Intervals of error ratios and ranks: their width, what is drawn, and the verdict on them."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from stario.fusion.evaluation.bootstrap import Interval, block_rows, paired_ratio, ranks
from stario.fusion.evaluation.groups import POOLED, verdict
from stario.fusion.evaluation.scores import joined

RNG = np.random.default_rng(0)
Blocks = tuple[np.ndarray, np.ndarray]


def table_of(groups: dict[str, list[Blocks]]) -> pd.DataFrame:
    """Errors of two networks; each block has one error."""
    return joined(
        block_rows(
            np.stack([sums, np.ones(len(sums))], axis=1),
            set="set", group=group, recording=f"{group} {k}", network=network, seed=0,
        )
        for group, recordings in groups.items()
        for k, pair in enumerate(recordings)
        for network, sums in zip(("ours", "theirs"), pair, strict=True)
    )  # fmt: skip


def interval_of(**groups: list[Blocks]) -> Interval:
    found = paired_ratio(table_of(groups), "ours", "theirs")
    assert found is not None
    return found


def recordings(ratios: np.ndarray) -> list[Blocks]:
    """A recording of five blocks for each ratio of errors."""
    theirs = RNG.uniform(1.0, 2.0, (len(ratios), 5))
    return [(ratio**2 * blocks, blocks) for ratio, blocks in zip(ratios, theirs, strict=True)]


def test_the_interval_of_a_ratio_widens_as_groups_differ():
    def groups(ratios):
        return {f"g{k}": recordings(np.full(4, ratio)) for k, ratio in enumerate(ratios)}

    equal = interval_of(**groups([0.8] * 6))
    assert (equal.ratio, equal.low, equal.high) == pytest.approx((0.8, 0.8, 0.8))
    spread = interval_of(**groups([0.5, 0.6, 0.8, 0.8, 1.0, 1.28]))
    assert spread.ratio == pytest.approx(0.793, abs=0.01)
    assert spread.low < 0.72 < 0.9 < spread.high
    assert paired_ratio(table_of({"g": recordings(np.ones(1))}), "ours", "nobody") is None


def test_the_interval_over_recordings_of_a_group_is_that_of_a_mean_with_95_percent():
    logs = RNG.normal(0.0, 0.5, 60)
    found = interval_of(g=recordings(np.exp(logs)))
    assert found.ratio == pytest.approx(np.exp(logs.mean()))
    half = 1.96 * logs.std() / np.sqrt(len(logs))
    assert np.log([found.low, found.high]) - logs.mean() == pytest.approx([-half, half], rel=0.15)


def test_a_single_recording_has_an_interval_from_its_blocks():
    theirs = np.ones(12)
    even = interval_of(g=[(0.25 * theirs, theirs)])
    assert (even.low, even.high) == pytest.approx((0.5, 0.5))
    uneven = interval_of(g=[(0.25 * np.geomspace(0.1, 10.0, 12), theirs)])
    assert uneven.low < 0.8 * uneven.ratio < 1.2 * uneven.ratio < uneven.high


def test_a_few_blocks_have_no_interval():
    """A single block would have one without width: certainty from nothing."""
    theirs = np.ones(4)
    few = interval_of(g=[(0.25 * theirs, theirs)])
    assert few.ratio == pytest.approx(0.5)
    assert np.isnan([few.low, few.high]).all()
    assert f"{few:.3f}" == "0.500 [too few data]"
    two_walks = interval_of(g=[(0.2 * np.ones(1), np.ones(1)), (0.3 * np.ones(1), np.ones(1))])
    assert np.isnan([two_walks.low, two_walks.high]).all()


BETTER = Interval(0.8, 0.7, 0.9)


def rows_with(groups: list[Interval], pooled: Interval) -> pd.DataFrame:
    names = [f"g{k}" for k in range(len(groups))]
    whole = [False] * len(groups) + [True]
    columns = {"group": [*names, POOLED], "ratio_10s": [*groups, pooled], "pooled": whole}
    return pd.DataFrame(columns)


def test_two_groups_are_too_few_for_a_verdict():
    assert verdict(rows_with([BETTER] * 2, BETTER)).startswith("not decided")
    assert verdict(rows_with([BETTER] * 3, BETTER)).startswith("accepted")


@pytest.mark.parametrize(
    ("worst", "pooled", "accepted"),
    [
        (Interval(1.09, 0.9, 1.3), BETTER, True),
        (Interval(1.11, 0.9, 1.3), BETTER, False),
        (BETTER, Interval(0.9, 0.8, 1.01), False),
    ],
)
def test_a_pooled_gain_by_chance_or_a_group_much_worse_is_not_accepted(worst, pooled, accepted):
    words = verdict(rows_with([BETTER, BETTER, worst], pooled))
    assert words.startswith("accepted" if accepted else "not accepted")


Errors = dict[tuple[str, str, str], np.ndarray]
"""Blocks by set, group and recording."""


def ranked(networks: dict[str, list[Errors]], against: str) -> dict[str, dict[str, Any]]:
    found = ranks(
        joined(
            block_rows(sums, set=s, group=g, recording=f"{s} {k}", network=network, seed=seed)
            for network, runs in networks.items()
            for seed, run in enumerate(runs)
            for (s, g, k), sums in run.items()
        ),
        against,
    )
    return {str(row["network"]): row for row in found.to_dict("records")}


def errors(scale: float, noise: float = 0.0, seed: int = 0) -> Errors:
    """Errors on twelve recordings of two sets, easy and hard, with noise of a network's own."""
    common, rng = np.random.default_rng(9), np.random.default_rng(seed)
    found = {}
    for k in range(12):
        sums = common.lognormal(0.0, 1.5, 6) * scale**2 * np.exp(noise * rng.standard_normal(6))
        found[f"set {k % 2}", "", str(k)] = np.stack([sums, np.full(6, 1.0)], axis=1)
    return found


def part(errors: Errors, recordings: slice) -> Errors:
    return {key: errors[key] for key in list(errors)[recordings]}


def test_twice_the_error_is_certain_however_much_recordings_differ_in_difficulty():
    found = ranked({"StarIO": [errors(1.0)], "worse": [errors(2.0)]}, "StarIO")
    assert found["StarIO"]["ratio"] is None
    ratio = found["worse"]["ratio"]
    assert (ratio.ratio, ratio.low, ratio.high) == pytest.approx((2.0, 2.0, 2.0))
    bounds = [(row["rank"], row["rank_low"], row["rank_high"]) for row in found.values()]
    assert bounds == [(1, 1, 1), (2, 2, 2)]


def test_networks_that_differ_by_chance_alone_may_have_either_rank():
    runs = {name: [errors(1.0, 0.7, seed)] for seed, name in enumerate(["StarIO", "a", "b"])}
    found = ranked(runs, "StarIO")
    assert all(row["rank_low"] < row["rank_high"] for row in found.values())
    assert all(r.low < 1.0 < r.high for n in "ab" for r in [found[n]["ratio"]])
    assert ranked(runs, "StarIO") == found


def test_seeds_are_averaged_over_common_recordings_only():
    halves = [part(errors(scale), slice(6)) for scale in (1.0, 2.0)]
    found = ranked({"StarIO": [errors(1.0)], "two": halves}, "StarIO")
    assert found["two"]["ratio"].ratio == pytest.approx(np.sqrt(2.0))
    apart = {"a": [part(errors(1.0), slice(6))], "b": [part(errors(1.0), slice(6, 12))]}
    assert ranked(apart, "a") == {}


def test_sets_have_equal_weights_however_many_recordings_they_have():
    """Eight times the error on the two recordings of one set, none on the six of the other."""
    other = part(errors(8.0), slice(0, 3, 2)) | part(errors(1.0), slice(1, None, 2))
    found = ranked({"StarIO": [errors(1.0)], "other": [other]}, "StarIO")["other"]["ratio"]
    assert found.ratio == pytest.approx(np.sqrt(8.0))


def test_groups_are_drawn_before_their_recordings():
    """A network that is worse with one of two people may be worse or equal with the next ones."""
    keys = [
        ("set", person, f"{person} {k}") for person, n in (("a", 9), ("b", 3)) for k in range(n)
    ]
    one = {key: np.ones((4, 2)) for key in keys}
    other = {key: np.array([[4.0 if key[1] == "a" else 1.0, 1.0]] * 4) for key in keys}
    found = ranked({"StarIO": [one], "other": [other]}, "StarIO")["other"]["ratio"]
    assert (found.ratio, found.low, found.high) == pytest.approx((np.sqrt(2.0), 1.0, 2.0))
