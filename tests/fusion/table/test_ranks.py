"""Ranks and ratios of networks with known errors."""

from __future__ import annotations

import numpy as np
import pytest

from stario.fusion.table.ranks import ranks
from stario.fusion.table.text import published

Errors = dict[tuple[str, str, str], np.ndarray]


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


def test_twice_the_error_is_certain_however_much_recordings_differ_in_difficulty() -> None:
    found = ranks({"StarIO": [errors(1.0)], "worse": [errors(2.0)]}, "StarIO")
    assert found["StarIO"].ratio is None
    ratio = found["worse"].ratio
    assert ratio is not None
    assert (ratio.ratio, ratio.low, ratio.high) == pytest.approx((2.0, 2.0, 2.0))
    assert [(found[n].rank, found[n].low, found[n].high) for n in found] == [(1, 1, 1), (2, 2, 2)]


def test_networks_that_differ_by_chance_alone_may_have_either_rank() -> None:
    runs = {name: [errors(1.0, 0.7, seed)] for seed, name in enumerate(["StarIO", "a", "b"])}
    found = ranks(runs, "StarIO")
    assert all(rank.low < rank.high for rank in found.values())
    assert all(r.ratio.low < 1.0 < r.ratio.high for r in found.values() if r.ratio is not None)
    assert ranks(runs, "StarIO") == found


def test_seeds_are_averaged_over_common_recordings_only() -> None:
    halves = [part(errors(scale), slice(6)) for scale in (1.0, 2.0)]
    found = ranks({"StarIO": [errors(1.0)], "two": halves}, "StarIO")
    ratio = found["two"].ratio
    assert ratio is not None
    assert ratio.ratio == pytest.approx(np.sqrt(2.0))
    assert ranks({"a": [errors(1.0)], "b": [{}]}, "a") == {}


def test_sets_have_equal_weights_however_many_recordings_they_have() -> None:
    """Eight times the error on the two recordings of one set, none on the six of the other."""
    other = part(errors(8.0), slice(0, 3, 2)) | part(errors(1.0), slice(1, None, 2))
    found = ranks({"StarIO": [errors(1.0)], "other": [other]}, "StarIO")["other"].ratio
    assert found is not None
    assert found.ratio == pytest.approx(np.sqrt(8.0))


def test_groups_are_drawn_before_their_recordings() -> None:
    """A network that is worse with one of two people may be worse or equal with the next ones."""
    keys = [
        ("set", person, f"{person} {k}") for person, n in (("a", 9), ("b", 3)) for k in range(n)
    ]
    one = {key: np.ones((4, 2)) for key in keys}
    other = {key: np.array([[4.0 if key[1] == "a" else 1.0, 1.0]] * 4) for key in keys}
    found = ranks({"StarIO": [one], "other": [other]}, "StarIO")["other"].ratio
    assert found is not None
    assert (found.ratio, found.low, found.high) == pytest.approx((np.sqrt(2.0), 1.0, 2.0))


def test_published_figures_are_found_by_set_and_network() -> None:
    assert published("ridi", "StarIO") == (2.033, 2.274)
    assert published("oxiod", "R-ResNet") == (4.336, 1.595)
    assert published("ridi", "pdr") is None
    assert published("tyrex", "StarIO") is None
