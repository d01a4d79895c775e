"""Benchmark of networks alone by groups, with a stub that predicts a known share of the truth."""

import csv
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from displacement_stub import Stub, horizontal_path, with_waypoints

from stario.fusion.evaluation.figures import groups_figure, write_benchmark
from stario.fusion.evaluation.groups import (
    POOLED,
    RATIOS,
    Benchmark,
    By,
    alone_on,
    benchmark,
    labels,
    verdict,
)
from stario.fusion.evaluation.scores import values
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

Makers = dict[str, Callable[[str], Any]]
"""By the name of the weights, a function that makes the network for a group."""


def judged(
    recordings: Mapping[str, ImuSequence],
    models: Makers,
    by: By = "set",
    groups: Mapping[str, str] | None = None,
) -> Benchmark:
    paths = {Path(name): (groups or {}).get(name, "") for name in recordings}
    found = [
        alone_on(
            path,
            paths,
            lambda name, group: models[name](group),
            models,
            lambda path: recordings[str(path)],
        )
        for path in paths
    ]
    return benchmark(found, by, *models)


def of_person(recording: ImuSequence, person: str) -> ImuSequence:
    return replace(recording, attributes={"person": person})


@pytest.fixture(scope="module")
def pair(walk):
    recordings = {"one": of_person(walk, "a"), "two": of_person(with_waypoints(walk), "b")}
    scales = {"walks a": 0.95, "walks b": 0.9}
    models = {
        "ours": lambda group: Stub(walk, scales[group]),
        "theirs": lambda group: Stub(walk, 0.8),
    }
    return judged(recordings, models, "person", {"one": "walks a", "two": "walks b"})


def test_a_recording_without_truth_is_refused_and_a_wrong_truth_warned_of(stepping, caplog):
    mirrored = stepping.truth.position_W * [-1.0, 1.0, 1.0]
    wrong = replace(stepping, truth=replace(stepping.truth, position_W=mirrored))
    models = {"ours": lambda group: Stub(stepping)}
    judged({"wrong": wrong}, models)
    assert "steps: truth: positions mirrored" in caplog.text
    with pytest.raises(InputError, match="truth"):
        judged({"blind": stepping.without_truth()}, models)


def test_a_recording_with_two_waypoints_is_named_as_not_compared(walk, caplog):
    few, enough = with_waypoints(walk, 50.0), with_waypoints(walk)
    models = {"ours": lambda group: Stub(walk)}
    found = judged({"50": few, "8": enough}, models)
    assert [record.getMessage()[:17] for record in caplog.records] == ["50: not compared,"]
    assert (values(found.scores, "path_m") > 0.0).tolist() == [False, True]
    caplog.clear()
    judged({"50": few, "third": few, "8": enough}, models)
    [record] = caplog.records
    assert record.getMessage().startswith("2 of 3 recordings, the first 50: not compared,")


def test_a_device_at_rest_counts_in_no_median_or_ratio(walk, caplog):
    """Its errors relative to its path, the noise of its truth, would be a thousand percent."""
    still = 1e-4 * np.random.default_rng(0).normal(size=walk.truth.position_W.shape)
    resting = replace(walk, name="rest", truth=replace(walk.truth, position_W=still))
    models = {"ours": lambda group: Stub(walk), "theirs": lambda group: Stub(walk, 0.8)}
    found, walking = judged({"walk": walk, "rest": resting}, models), judged({"walk": walk}, models)
    assert "rest: not compared, because the ground truth moves by less" in caplog.text
    both, alone = (part.rows.iloc[-1] for part in (found, walking))
    assert str(both) == str(alone)  # some are NaN
    assert both["recordings"] == 1


def test_rows_compare_weights_by_group_and_pooled(walk, pair):
    rows = pair.rows.set_index(["group", "weights"])
    assert list(rows.index.unique("group")) == ["a", "b", "all"]
    a, b, pooled = (rows.loc[name, "ours"] for name in ("a", "b", "all"))
    assert a["ratio_1s"].ratio == pytest.approx(0.25, rel=0.01)
    assert b["ratio_10s"].ratio == pytest.approx(0.5, abs=0.05)
    assert (b["ratio_1s"], b["ratio_30s"]) == (None, None)
    assert pooled["ratio_10s"].ratio == pytest.approx(np.sqrt(0.25 * 0.5), abs=0.04)
    assert a["path_km"] == pytest.approx(1e-3 * horizontal_path(walk), rel=0.05)
    assert rows.loc[("a", "theirs"), "length_ratio"] == pytest.approx(0.8, abs=0.02)


def test_without_a_list_intervals_are_drawn_over_the_persons_of_an_archive(walk):
    """Over recordings alone, those of one person would pass for those of many."""
    scales = {"r.h5:1": ("a", 0.95), "r.h5:2": ("b", 0.9), "r.h5:3": ("b", 0.9)}
    recordings = {name: of_person(walk, person) for name, (person, _) in scales.items()}
    by_group = {f"r {person}": scale for person, scale in scales.values()}
    models = {
        "ours": lambda group: Stub(walk, by_group[group]),
        "theirs": lambda group: Stub(walk, 0.8),
    }
    pooled = judged(recordings, models, "person").rows.iloc[-1]
    # Persons have equal weights.
    assert pooled["ratio_1s"].ratio == pytest.approx(np.sqrt(0.25 * 0.5), rel=0.01)


def test_a_file_named_without_its_folder_belongs_to_the_set_of_that_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert labels(Path("walk.csv"), {})["set"] == tmp_path.name


def test_a_recording_without_errors_has_no_ratio(pair):
    """Of a device at rest, for example."""
    perfect = replace(pair, by="set", blocks=pair.blocks.assign(squares=0.0))
    assert perfect.rows[[*RATIOS]].isna().all(axis=None)


def test_a_benchmark_is_written_as_tables_and_figure(pair, tmp_path):
    found = replace(pair, by="set")
    assert "ratio over 10 s" in found.text()
    write_benchmark(tmp_path, found)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"groups.csv", "recordings.csv", "groups.json", "groups.png"}
    with (tmp_path / "groups.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["weights"] for line in lines] == ["theirs", "ours"]
    assert float(lines[1]["ratio_10s_low"]) <= float(lines[1]["ratio_10s_ratio"])
    content = json.loads((tmp_path / "groups.json").read_text())
    assert content["recordings"][-1]["truth"] == "waypoints"
    assert (tmp_path / "groups.png").stat().st_size > 10_000


def test_a_group_may_be_called_all(pair):
    named = pair.scores.assign(person=pair.scores["person"].replace("b", POOLED))
    found = replace(pair, scores=named)
    ours = found.rows[found.rows["role"] == "ours"]
    assert ours["group"].to_list() == ["a", "all", "all"]
    assert ours["pooled"].to_list() == [False, False, True]
    assert verdict(found.rows).startswith("not decided, 2 groups")
    assert len(groups_figure(found).axes[0].get_yticks()) == 3
    alone = replace(found, scores=named[named["person"] == POOLED])
    assert verdict(alone.rows) == ""
    assert len(groups_figure(alone).axes[0].get_yticks()) == 1
