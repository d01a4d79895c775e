from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import pytest

from stario.fusion.evaluation.bootstrap import Interval, paired_ratio, ranks
from stario.fusion.evaluation.groups import verdict
from stario.fusion.evaluation.scores import POOLED, joined

Errors = dict[tuple[str, str, str], np.ndarray]
"""Squared errors (B,), one of each block, by set, group and recording."""


def table_of(networks: dict[str, list[Errors]]) -> pd.DataFrame:
    return joined(
        pd.DataFrame({"squares": squares, "count": 1.0, "block": range(len(squares))}).assign(
            set=s, group=group, recording=name, network=network, seed=seed,
        )
        for network, runs in networks.items()
        for seed, run in enumerate(runs)
        for (s, group, name), squares in run.items()
    )  # fmt: skip


def ranked(networks: dict[str, list[Errors]]) -> dict[str, dict[str, Any]]:
    found = ranks(table_of(networks), "StarIO")
    return {str(row["network"]): row for row in found.to_dict("records")}


def interval_of(pairs: Sequence[tuple[Any, Any]], groups: Sequence[str] | None = None) -> Interval:
    """Interval of errors of ours and of theirs, a pair for each recording, all of one group."""
    names = [("set", "" if groups is None else groups[k], str(k)) for k in range(len(pairs))]
    ours, theirs = (
        [{name: np.asarray(pair[side]) for name, pair in zip(names, pairs, strict=True)}]
        for side in (0, 1)
    )
    found = paired_ratio(table_of({"ours": ours, "theirs": theirs}), "ours", "theirs")
    assert found is not None
    return found


def recordings(ratios: Sequence[float]) -> list[tuple[Any, Any]]:
    theirs = np.random.default_rng(0).uniform(1.0, 2.0, (len(ratios), 5))
    return [(ratio**2 * blocks, blocks) for ratio, blocks in zip(ratios, theirs, strict=True)]


def test_the_interval_of_a_ratio_widens_as_groups_differ():
    groups = np.repeat([*"abcdef"], 4)
    equal = interval_of(recordings([0.8] * 24), groups)
    assert (equal.ratio, equal.low, equal.high) == pytest.approx((0.8, 0.8, 0.8))
    spread = interval_of(recordings(np.repeat([0.5, 0.6, 0.8, 0.8, 1.0, 1.28], 4)), groups)
    assert spread.ratio == pytest.approx(0.793, abs=0.01)
    assert spread.low < 0.72 < 0.9 < spread.high
    one = table_of({"ours": [{("s", "g", "r"): np.ones(5)}]})
    assert paired_ratio(one, "ours", "nobody") is None


def test_the_interval_over_recordings_of_a_group_is_that_of_a_mean_with_95_percent():
    logs = np.random.default_rng(1).normal(0.0, 0.5, 60)
    found = interval_of(recordings(np.exp(logs)))
    assert found.ratio == pytest.approx(np.exp(logs.mean()))
    half = 1.96 * logs.std() / np.sqrt(len(logs))
    assert np.log([found.low, found.high]) - logs.mean() == pytest.approx([-half, half], rel=0.15)


def test_a_single_recording_has_an_interval_from_its_blocks():
    even = interval_of([(0.25 * np.ones(12), np.ones(12))])
    assert (even.low, even.high) == pytest.approx((0.5, 0.5))
    uneven = interval_of([(0.25 * np.geomspace(0.1, 10.0, 12), np.ones(12))])
    assert uneven.low < 0.8 * uneven.ratio < 1.2 * uneven.ratio < uneven.high


def test_a_few_blocks_have_no_interval():
    """A single block would have one without width: certainty from nothing."""
    few = interval_of([(0.25 * np.ones(4), np.ones(4))])
    two_walks = interval_of([([0.2], [1.0]), ([0.3], [1.0])])
    assert f"{few:.3f}" == "0.500 [too few data]"
    assert np.isnan([few.low, few.high, two_walks.low, two_walks.high]).all()


BETTER = Interval(0.8, 0.7, 0.9)
WORSE, MUCH_WORSE = Interval(1.09, 0.9, 1.3), Interval(1.11, 0.9, 1.3)


@pytest.mark.parametrize(
    ("groups", "pooled", "words"),
    [
        ([BETTER] * 2, BETTER, "not decided"),
        ([BETTER] * 3, BETTER, "accepted"),
        ([BETTER, BETTER, WORSE], BETTER, "accepted"),
        ([BETTER, BETTER, MUCH_WORSE], BETTER, "not accepted"),
        ([BETTER] * 3, Interval(0.9, 0.8, 1.01), "not accepted"),  # perhaps by chance
    ],
)
def test_a_pooled_gain_is_accepted_unless_a_group_is_much_worse(groups, pooled, words):
    names = [*(f"g{k}" for k in range(len(groups))), POOLED]
    rows = {"group": names, "ratio_10s": [*groups, pooled], "pooled": [n == POOLED for n in names]}
    assert verdict(pd.DataFrame(rows)).startswith(words)


def errors(scale: float, noise: float = 0.0, seed: int = 0) -> Errors:
    """Errors on twelve recordings of two sets, easy and hard, with noise of a network's own."""
    common, rng = np.random.default_rng(9), np.random.default_rng(seed)
    return {
        (f"set {k % 2}", "", str(k)): common.lognormal(0.0, 1.5, 6)
        * scale**2
        * np.exp(noise * rng.standard_normal(6))
        for k in range(12)
    }


def part(errors: Errors, recordings: slice) -> Errors:
    return {key: errors[key] for key in list(errors)[recordings]}


def test_twice_the_error_is_certain_however_much_recordings_differ_in_difficulty():
    found = ranked({"StarIO": [errors(1.0)], "worse": [errors(2.0)]})
    for name, ratio in (("StarIO", 1.0), ("worse", 2.0)):
        of = found[name]["ratio"]
        assert (of.ratio, of.low, of.high) == pytest.approx((ratio, ratio, ratio))
    bounds = [(row["rank"], row["rank_low"], row["rank_high"]) for row in found.values()]
    assert bounds == [(1, 1, 1), (2, 2, 2)]


def test_networks_that_differ_by_chance_alone_may_have_either_rank():
    runs = {name: [errors(1.0, 0.7, seed)] for seed, name in enumerate(["StarIO", "a", "b"])}
    found = ranked(runs)
    assert all(row["rank_low"] < row["rank_high"] for row in found.values())
    assert all(r.low < 1.0 < r.high for n in "ab" for r in [found[n]["ratio"]])
    assert ranked(runs) == found


def test_seeds_are_averaged_over_common_recordings_only():
    halves = [part(errors(scale), slice(6)) for scale in (1.0, 2.0)]
    found = ranked({"StarIO": [errors(1.0)], "two": halves})
    assert found["two"]["ratio"].ratio == pytest.approx(np.sqrt(2.0))
    apart = {"a": [part(errors(1.0), slice(6))], "b": [part(errors(1.0), slice(6, 12))]}
    assert ranked(apart) == {}


def test_sets_have_equal_weights_however_many_recordings_they_have():
    other = part(errors(8.0), slice(0, 3, 2)) | part(errors(1.0), slice(1, None, 2))
    found = ranked({"StarIO": [errors(1.0)], "other": [other]})["other"]["ratio"]
    assert found.ratio == pytest.approx(np.sqrt(8.0))


def test_groups_are_drawn_before_their_recordings():
    """A network that is worse with one of two people may be worse or equal with the next ones."""
    people = [*9 * "a", *3 * "b"]
    pairs = [(np.full(4, 4.0 if person == "a" else 1.0), np.ones(4)) for person in people]
    found = interval_of(pairs, people)
    assert (found.ratio, found.low, found.high) == pytest.approx((np.sqrt(2.0), 1.0, 2.0))
