"""Judging of networks alone by groups, with a stub that predicts a known share of the truth."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from judged import Stub, horizontal_path, with_waypoints

from stario.fusion.evaluation.folders import fresh_folder
from stario.fusion.evaluation.judging.judge import (
    POOLED,
    RecordingResult,
    judge,
    labels,
    rows_of,
)
from stario.fusion.evaluation.judging.prepared import prepare
from stario.fusion.evaluation.judging.table import (
    JudgingResult,
    groups_figure,
    judgement_text,
    verdict,
    write_judgement,
)
from stario.sequences.datasets.batch import Skipped
from stario.sequences.sequence import ImuSequence


@pytest.fixture(scope="module")
def judged_pair(walk: ImuSequence) -> list[RecordingResult]:
    prepared = [
        replace(prepare(recording, Path(name)), attributes={"person": person})
        for name, person, recording in (("one", "a", walk), ("two", "b", with_waypoints(walk)))
    ]
    groups = {Path("one"): "walks a", Path("two"): "walks b"}
    scales = {"walks a": 0.95, "walks b": 0.9}
    models = {
        "ours": lambda group: Stub(walk, scales[group]),
        "theirs": lambda group: Stub(walk, 0.8),
    }
    judged, skipped = judge([*prepared, Skipped("three", "why")], models, groups)
    assert [one.item for one in skipped] == ["three"]
    return judged


def test_a_recording_with_two_waypoints_is_named_as_not_compared(
    walk: ImuSequence, caplog: pytest.LogCaptureFixture
) -> None:
    prepared = [prepare(with_waypoints(walk, every), Path(f"{every:g}")) for every in (50.0, 8.0)]
    judged, _ = judge(prepared, {"ours": lambda group: Stub(walk)}, {})
    assert [record.getMessage()[:17] for record in caplog.records] == ["50: not compared,"]
    assert [one.errors["ours"].path_m > 0.0 for one in judged] == [False, True]
    caplog.clear()
    judge([prepared[0], *prepared], {"ours": lambda group: Stub(walk)}, {})
    [record] = caplog.records
    assert record.getMessage().startswith("2 of 3 recordings, the first 50: not compared,")


def test_a_device_at_rest_counts_in_no_median_or_ratio(
    walk: ImuSequence, caplog: pytest.LogCaptureFixture
) -> None:
    """Its errors relative to its path, the noise of its truth, would be a thousand percent."""
    still = 1e-4 * np.random.default_rng(0).normal(size=walk.truth.position_W.shape)
    resting = replace(walk, name="rest", truth=replace(walk.truth, position_W=still))
    prepared = [prepare(each, Path(each.name)) for each in (walk, resting)]
    models = {"ours": lambda group: Stub(walk), "theirs": lambda group: Stub(walk, 0.8)}
    judged, _ = judge(prepared, models, {})
    assert "rest: not compared, because the ground truth moves by less" in caplog.text
    both, alone = (rows_of(part, "set", "ours", "theirs")[-1] for part in (judged, judged[:1]))
    assert str(both.medians) == str(alone.medians)  # some are NaN
    assert both.ratios == alone.ratios
    assert both.recordings == 1


def test_rows_compare_weights_by_group_and_pooled(
    walk: ImuSequence, judged_pair: list[RecordingResult]
) -> None:
    rows = {row.name: row for row in rows_of(judged_pair, "person", "ours", "theirs")}
    assert list(rows) == ["a", "b", "all"]
    assert rows["a"].ratios["rms_1s_m"].ratio == pytest.approx(0.25, rel=0.01)
    assert rows["b"].ratios["rms_10s_m"].ratio == pytest.approx(0.5, abs=0.05)
    assert list(rows["b"].ratios) == ["rms_10s_m"]
    assert rows["all"].ratios["rms_10s_m"].ratio == pytest.approx(np.sqrt(0.25 * 0.5), abs=0.04)
    assert rows["a"].path_km == pytest.approx(1e-3 * horizontal_path(walk), rel=0.05)
    assert rows["a"].medians["theirs"]["length_ratio"] == pytest.approx(0.8, abs=0.02)


def test_without_a_list_intervals_are_drawn_over_the_persons_of_an_archive(
    walk: ImuSequence,
) -> None:
    """Over recordings alone, those of one person would pass for those of many."""
    scales = {"r.h5:1": ("a", 0.95), "r.h5:2": ("b", 0.9), "r.h5:3": ("b", 0.9)}
    prepared = [
        replace(prepare(walk, Path(name)), attributes={"person": person})
        for name, (person, _) in scales.items()
    ]
    by_group = {f"r {person}": scale for person, scale in scales.values()}
    models = {
        "ours": lambda group: Stub(walk, by_group[group]),
        "theirs": lambda group: Stub(walk, 0.8),
    }
    judged, _ = judge(prepared, models, {})
    ratio = rows_of(judged, "person", "ours", "theirs")[-1].ratios["rms_1s_m"].ratio
    assert ratio == pytest.approx(np.sqrt(0.25 * 0.5), rel=0.01)  # persons have equal weights


def test_a_file_named_without_its_folder_belongs_to_the_set_of_that_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert labels(Path("walk.csv"), {})["set"] == tmp_path.name


def test_a_recording_without_errors_has_no_ratio(judged_pair: list[RecordingResult]) -> None:
    """Of a device at rest, for example."""
    first = judged_pair[0]
    perfect = {
        name: replace(found, blocks={key: 0.0 * sums for key, sums in found.blocks.items()})
        for name, found in first.errors.items()
    }
    [row] = rows_of([replace(first, errors=perfect)], "set", "ours", "theirs")
    assert row.ratios == {}


def test_a_judgement_is_written_as_tables_and_figure(
    judged_pair: list[RecordingResult], tmp_path: Path
) -> None:
    rows = rows_of(judged_pair, "set", "ours", "theirs")
    found = JudgingResult("ours", "theirs", rows, judged_pair)
    assert "ratio over 10 s" in judgement_text(found)
    write_judgement(tmp_path, found)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"groups.csv", "recordings.csv", "groups.json", "groups.png"}
    with (tmp_path / "groups.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["weights"] for line in lines] == ["ours", "theirs"]
    assert float(lines[0]["rms_10s_m_low"]) <= float(lines[0]["rms_10s_m_ratio"])
    content = json.loads((tmp_path / "groups.json").read_text())
    assert content["recordings"][1]["truth"] == "waypoints"
    assert (tmp_path / "groups.png").stat().st_size > 10_000
    fresh_folder(tmp_path)  # for a later run
    assert not list(tmp_path.iterdir())


def test_a_group_may_be_called_all(judged_pair: list[RecordingResult]) -> None:
    judged = [
        replace(one, labels=one.labels | {"person": person})
        for one, person in zip(judged_pair, ("a", POOLED), strict=True)
    ]
    rows = rows_of(judged, "person", "ours", "theirs")
    assert [(row.name, row.pooled) for row in rows] == [("a", False), ("all", False), ("all", True)]
    assert verdict(rows).startswith("not decided, 2 groups")
    assert len(groups_figure(rows, "ours", "theirs").axes[0].get_yticks()) == 3
    alone = rows_of(judged[1:], "person", "ours", "theirs")
    assert verdict(alone) == ""
    assert len(groups_figure(alone, "ours", "theirs").axes[0].get_yticks()) == 1
