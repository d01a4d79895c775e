"""Intervals of error ratios: their width, what is drawn, and the verdict that rests on them."""

from __future__ import annotations

import numpy as np
import pytest

from stario.fusion.evaluation.judging.bootstrap import Blocks, Groups, Interval, paired_ratio
from stario.fusion.evaluation.judging.judge import POOLED, Row
from stario.fusion.evaluation.judging.table import verdict

RNG = np.random.default_rng(0)


def interval_of(**groups: list[Blocks]) -> Interval:
    found = paired_ratio({"set": groups})
    assert found is not None
    return found


def recordings(ratios: np.ndarray) -> list[Blocks]:
    """A recording of five blocks for each ratio of errors."""
    theirs = RNG.uniform(1.0, 2.0, (len(ratios), 5))
    return [(ratio**2 * blocks, blocks) for ratio, blocks in zip(ratios, theirs, strict=True)]


def test_the_interval_of_a_ratio_widens_as_groups_differ() -> None:
    def groups(ratios: list[float]) -> Groups:
        return {f"g{k}": recordings(np.full(4, ratio)) for k, ratio in enumerate(ratios)}

    equal = interval_of(**groups([0.8] * 6))
    assert (equal.ratio, equal.low, equal.high) == pytest.approx((0.8, 0.8, 0.8))
    spread = interval_of(**groups([0.5, 0.6, 0.8, 0.8, 1.0, 1.28]))
    assert spread.ratio == pytest.approx(0.793, abs=0.01)
    assert spread.low < 0.72 < 0.9 < spread.high
    assert paired_ratio({}) is None


def test_the_interval_over_recordings_of_a_group_is_that_of_a_mean_with_95_percent() -> None:
    logs = RNG.normal(0.0, 0.5, 60)
    found = interval_of(g=recordings(np.exp(logs)))
    assert found.ratio == pytest.approx(np.exp(logs.mean()))
    half = 1.96 * logs.std() / np.sqrt(len(logs))
    assert np.log([found.low, found.high]) - logs.mean() == pytest.approx([-half, half], rel=0.15)


def test_a_single_recording_has_an_interval_from_its_blocks() -> None:
    theirs = np.ones(12)
    even = interval_of(g=[(0.25 * theirs, theirs)])
    assert (even.low, even.high) == pytest.approx((0.5, 0.5))
    uneven = interval_of(g=[(0.25 * np.geomspace(0.1, 10.0, 12), theirs)])
    assert uneven.low < 0.8 * uneven.ratio < 1.2 * uneven.ratio < uneven.high


def test_a_few_blocks_have_no_interval() -> None:
    """A single block would have one without width: certainty from nothing."""
    theirs = np.ones(4)
    few = interval_of(g=[(0.25 * theirs, theirs)])
    assert few.ratio == pytest.approx(0.5)
    assert np.isnan([few.low, few.high]).all()
    assert f"{few:.3f}" == "0.500 [too few data]"
    two_walks = interval_of(g=[(0.2 * np.ones(1), np.ones(1)), (0.3 * np.ones(1), np.ones(1))])
    assert np.isnan([two_walks.low, two_walks.high]).all()


BETTER = Interval(0.8, 0.7, 0.9)


def rows_with(groups: list[Interval], pooled: Interval) -> list[Row]:
    ratios = [(f"g{k}", ratio, False) for k, ratio in enumerate(groups)] + [(POOLED, pooled, True)]
    return [Row(name, 5, 1.0, {}, {"rms_10s_m": ratio}, whole) for name, ratio, whole in ratios]


def test_two_groups_are_too_few_for_a_verdict() -> None:
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
def test_a_pooled_gain_by_chance_or_a_group_much_worse_is_not_accepted(
    worst: Interval, pooled: Interval, accepted: bool
) -> None:
    words = verdict(rows_with([BETTER, BETTER, worst], pooled))
    assert words.startswith("accepted" if accepted else "not accepted")
