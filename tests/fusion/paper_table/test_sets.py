from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from recorded import DATA

from stario.fusion.evaluation.scores import joined, scored
from stario.fusion.paper_table import runs as runs_module
from stario.fusion.paper_table import sets
from stario.fusion.paper_table.figures import pde_boxes
from stario.fusion.paper_table.runs import ReaderConfig, run_recipe, train_run
from stario.fusion.paper_table.sets import ALL, FIRST, DataSet, development_sets, folder_set
from stario.fusion.paper_table.table import COLUMNS, set_table, table_text, work_of
from stario.network.runtime.survey import ModelRow
from stario.network.training import splits
from stario.network.training.config import TrainingConfig
from stario.network.training.history import EpochReport
from stario.network.training.splits import learned_from
from stario.sequences import ImuSequence, InputError, PositionTrack, read_recording, write_csv
from stario.sequences.datasets.splits import ListEntry
from stario.sequences.files import write_json
from stario.sequences.readers.archive import write_archive

needs_data = pytest.mark.skipif(not (DATA / "archives").exists(), reason=f"no data in {DATA}")


def archived(path: Path, names: Iterable[str]) -> None:
    time, zero = np.arange(2) / 100.0, np.zeros((2, 3))
    write_archive(path, [ImuSequence(name, time, zero, zero) for name in names])


def test_a_split_is_disjoint_complete_and_determined_by_the_seed(tmp_path):
    archived(tmp_path / "a.h5", map(str, range(40)))
    first, again, other = (folder_set("a", tmp_path, seed) for seed in (3, 3, 4))
    assert first == again
    assert first.test != other.test
    parts = [set(first.training), set(first.validation), {one.path for one in first.test}]
    assert [len(part) for part in parts] == [32, 4, 4]
    assert len(set.union(*parts)) == 40
    assert "seed 3" in first.words


PHONES = [ListEntry(Path(f"kipd.h5:Walk{k}{p}"), "kipd") for k in range(9) for p in ("S9", "S20")]


def walks_of(part: Iterable[Path]) -> list[str]:
    return [path.name.removesuffix("S9").removesuffix("S20") for path in part]


def test_two_phones_on_one_walk_are_in_the_same_part(monkeypatch, tmp_path):
    archived(tmp_path / "kipd.h5", (entry.path.name.partition(":")[2] for entry in PHONES))
    held = [ListEntry(Path("ridi.h5:dan"), "ridi dan")]
    parts = {"all": [*PHONES, *held], "test": [], "holdout": held}
    for module in (sets, splits):
        monkeypatch.setattr(module, "read_packaged_list", lambda name, data: parts[name])
    for seed in range(5):
        split = folder_set("kipd", tmp_path, seed)
        for part in (split.training, split.validation, [one.path for one in split.test]):
            assert set(Counter(walks_of(part)).values()) == {2}
        [together] = development_sets(Path(), seed, 2, [ALL])
        assert [*Counter(walks_of(together.validation)).values()] == [2]


@needs_data
def test_the_main_sets_come_first_and_parts_of_a_set_are_disjoint():
    found = development_sets(DATA, 0, 2)
    assert tuple(one.name for one in found[:3]) == FIRST
    assert {one.name for one in found} == {*FIRST, "tyrex", "kipd", "ilc"}
    for one in found:
        test = {listed.path for listed in one.test}
        assert not test & set(one.training)
        assert not test & set(one.validation)
        assert not set(one.training) & set(one.validation)
        assert all((one.training, one.validation, test))
    with pytest.raises(InputError, match="'ronin'"):
        development_sets(DATA, 0, 2, ["ronin"])


@needs_data
def test_the_combined_set_is_tested_on_held_out_people_and_places():
    [together] = development_sets(DATA, 0, 2, [ALL])
    learned = [*together.training, *together.validation]
    assert not any("Thibaud" in str(path) or ":dan_" in str(path) for path in learned)
    assert not any("site2" in str(path) for path in learned)
    names = set(map(sets.set_of, together.test))
    assert names >= {"tyrex", "ridi", "kipd", "ilc", "rocip", "oxiod"}
    tested = [one.group for one in together.test]
    assert tested.count("tyrex Thibaud") == 2  # of his 41
    known = learned_from(DATA)
    assert not known["first-stage"] & {one.path for one in together.test}
    assert known["default"] >= {one.path for one in together.test}


TESTED = tuple(ListEntry(Path(f"ridi.h5:{name}"), "ridi") for name in "ab")
DATASET = DataSet("own", (Path("ridi.h5:c"),), (Path("ridi.h5:d"),), TESTED, "")


def content(ate_m: float, network="StarIO", seed=0, seconds=0.0) -> Mapping[str, Any]:
    """Results on both recordings, the second without a drift."""
    labels = {"network": network, "seed": seed}
    names = [str(entry.path) for entry in TESTED]
    scores = [
        scored(name, {"network_true_attitude": errors, "poses": {"path_m": 50.0}}, "ridi", **labels)
        for name, pde in zip(names, (0.03, None), strict=True)
        for errors in [{"ate_m": ate_m, "rte_m": 2.0, "pde": pde}]
    ]
    unit = {"set": "ridi", "group": "ridi", "metric": "ate", "block": 0, **labels}
    blocks = pd.DataFrame({"recording": names, "squares": ate_m**2, "count": 1.0, **unit})
    tables = {"scores": joined(scores), "blocks": blocks}
    return {**labels, **tables, "drawn": {}, "seconds": seconds, "skipped": []}


def trained(ate_m: float, seed: int) -> Mapping[str, Any]:
    work = {"windows_per_s": 200.0, "seconds": 7200.0, "skipped": []}
    errors = {"training_error_m2": 0.1, "validation_error_m2": 0.2}
    return {**content(ate_m, seed=seed, seconds=1800.0), "trained": work | errors}


def test_errors_are_means_over_recordings_in_their_units():
    rows = set_table(DATASET, [content(1.5, "pdr")], {}).rows
    assert rows["ate"].item() == 1.5
    assert rows["pde"].item() == pytest.approx(3.0)  # in %, where it is known
    known = [key for key in COLUMNS if rows[key].notna().any()]
    assert known == ["ate", "rte", "pde"]


def test_no_panel_of_the_drift_cuts_its_boxes():
    table = set_table(DATASET, [content(1.5), content(2.5, "R-ResNet")], {})
    for axes in pde_boxes(table.scores, {"StarIO": "red", "R-ResNet": "blue"}).axes:
        assert axes.get_ylim()[0] == 0.0
        assert axes.dataLim.y1 <= axes.get_ylim()[1]


def test_recordings_that_weights_have_learned_are_counted_among_the_tested_ones():
    learned = {"default": frozenset({TESTED[0].path, *DATASET.training, *DATASET.validation})}
    completed = [content(1.0, "default"), content(1.0, "open")]
    table = set_table(DATASET, completed, learned)
    rows = table.rows.to_dict("records")
    assert [(row["network"], row["learned"]) for row in rows] == [("default", 1), ("open", 0)]


def test_work_is_told_in_core_hours_and_windows_per_second():
    completed = [trained(1.0, 0), trained(1.2, 1)]
    work = work_of([completed])
    assert work.loc["StarIO"].tolist() == [14400.0, 3600.0, 200.0]
    times = {"torch": {"1": 1.0, "64": 0.5}}
    costs = [ModelRow("StarIO", 2_761_682, 24_854_000, times, 11.2)]
    table = set_table(DATASET, completed, {})
    assert table.rows["ratio"].to_list() == [None]  # to itself
    text = table_text([table], costs, work, TrainingConfig())
    assert "| StarIO | 2.762 (2.762) | 24.854 (25.122) | 11.2 | 1.00 | 0.50 | 5.00 | 200 |" in text
    assert "Total: 5.00 core hours, 4.00 for training and 1.00 for evaluation" in text


@pytest.fixture(scope="module")
def dataset(make_walk, tmp_path_factory):
    files = [tmp_path_factory.mktemp("walks") / f"{name}.csv" for name in "abc"]
    for seed, path in enumerate(files):
        write_csv(path, make_walk(seed=seed, seconds=16.0))
    return DataSet("own", tuple(files[:2]), (files[2],), (), "")


@pytest.fixture
def train(monkeypatch, dataset, tmp_path):
    """Train in name only, with a log of three epochs; return also the data of both parts."""

    def logged(recipe, data, validation, folder, **rest):
        given.extend([data, validation])
        errors = (0.5, 0.1), (0.4, float("nan")), (0.3, 0.2)
        reports = [asdict(EpochReport(k, *pair, {})) for k, pair in enumerate(errors, 1)]
        write_json(folder / "log.json", reports)

    def run(read=read_recording, **values):
        given.clear()
        recipe = run_recipe({"likelihood_from": 0.0, "epochs": 3, **values}, "StarIO", 0, None)
        reading = ReaderConfig(read, {}, tmp_path / read.__name__)
        return train_run(dataset, recipe, tmp_path, reading), *given

    given: list[Any] = []
    monkeypatch.setattr(runs_module, "train", logged)
    return run


def test_the_validation_error_is_that_of_the_epoch_whose_weights_are_kept(train):
    done, _, _ = train()
    assert (done["training_error_m2"], done["validation_error_m2"]) == (0.3, 0.1)


def test_the_shares_of_the_recipe_are_used(train):
    _, data, _ = train(shares={"a.csv": 0.9}, augmentation={"speeds": [1.0, 1.0]})
    pairs = zip(data.streams, data.weights, strict=True)
    weights = {stream.name: weight * len(stream) for stream, weight in pairs}
    shares = np.array([weights["a"], weights["b"]]) / sum(weights.values())
    assert shares == pytest.approx([0.9, 0.1], abs=0.01)


def test_without_recorded_poses_the_legs_alone_select_the_weights(train, monkeypatch):
    def waypoints(path):
        walk = read_recording(path)
        time = walk.truth.time[0] + np.arange(0.5, 16.0, 3.0)
        track = PositionTrack(time, walk.truth.at(time).position_W[:, :2], "waypoints")
        return replace(walk, truth=None, positions=track)

    monkeypatch.setattr(runs_module, "cached_walks", lambda *arguments, **rest: [])
    assert [train(read)[2].simulated for read in (waypoints, read_recording)] == [True, False]
