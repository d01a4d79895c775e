import json
import os
import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from stario.fusion.commands.cli import app
from stario.fusion.evaluation.scores import values
from stario.fusion.paper_table import runs as runs_module
from stario.fusion.paper_table.runs import (
    LEADING,
    PROTOCOLS,
    TRUE_ATTITUDE,
    ReaderConfig,
    Run,
    backend,
    complete_run,
    completed_runs,
    run_recipe,
    table_runs,
)
from stario.fusion.paper_table.sets import DataSet, folder_set
from stario.fusion.paper_table.table import set_table
from stario.network.architectures import ARCHITECTURES
from stario.network.runtime.survey import ModelRow
from stario.sequences import ConfigError, InputError, WeightsError, read_recording, write_csv
from stario.sequences.datasets.batch import each

RECIPE: dict[str, object] = {"batch": 6, "device": "cpu", "attitude": "true"}


@pytest.fixture(scope="module")
def dataset(make_walk, tmp_path_factory):
    folder = tmp_path_factory.mktemp("walks")
    for seed in range(4):
        write_csv(folder / f"walk{seed}.csv", make_walk(seed=seed, seconds=8.0))
    return folder_set("own", folder, seed=0)


@pytest.fixture(scope="module")
def reading(tmp_path_factory):
    return ReaderConfig(read_recording, {}, tmp_path_factory.mktemp("cache"))


def run(dataset: DataSet, network: str = "StarIO", seed: int = 0, steps: int = 4) -> Run:
    return Run(dataset, network, seed, run_recipe(RECIPE, network, seed, steps))


@pytest.mark.usefixtures("narrow_network")
def test_a_killed_run_resumes_and_gives_the_same_model(dataset, reading, tmp_path, monkeypatch):
    monkeypatch.setattr(runs_module, "_EPOCH_STEPS", 2)
    whole, killed = run(dataset), run(dataset)
    complete_run(whole, tmp_path / "whole", reading)
    with monkeypatch.context() as during:

        def kill(path, seconds):
            raise KeyboardInterrupt

        during.setattr(runs_module, "write_json", kill)
        with pytest.raises(KeyboardInterrupt):
            complete_run(killed, tmp_path / "killed", reading)
    folder = killed.folder(tmp_path / "killed")
    assert (folder / "checkpoint.safetensors").exists()
    assert not (folder / "trained.json").exists()
    complete_run(killed, tmp_path / "killed", reading)
    model = whole.folder(tmp_path / "whole") / "model.safetensors"
    assert (folder / "model.safetensors").read_bytes() == model.read_bytes()
    assert len(json.loads((folder / "log.json").read_text())) == 2


def assert_complete(folder: Path) -> None:
    names = {"tested.json", "log.json", "model.json", "model.safetensors", "trained.json"}
    assert {path.name for path in folder.glob("[!.]*")} == names
    trained = json.loads((folder / "trained.json").read_text())
    assert trained["steps"] == 1
    assert min(trained["windows_per_s"], trained["seconds"]) > 0.0
    content = json.loads((folder / "tested.json").read_text())
    [drawn] = content["drawn"].values()
    assert len({len(values) for values in drawn.values()}) == 1
    scores, blocks = (pd.DataFrame(content[name]) for name in ("scores", "blocks"))
    assert set(scores["track"]) == {"poses", *PROTOCOLS}
    total, count = blocks.loc[blocks["metric"] == "ate", ["squares", "count"]].sum()
    ate = values(scores, "ate_m", track=TRUE_ATTITUDE)
    assert ate == pytest.approx([(total / count / 2) ** 0.5])


@pytest.mark.usefixtures("narrow_network")
def test_only_new_networks_and_seeds_are_trained(dataset, reading, tmp_path, monkeypatch):
    trained = []
    original = runs_module.train_run

    def counted(dataset, recipe, *rest):
        trained.append(f"{recipe.architecture} {recipe.seed}")
        return original(dataset, recipe, *rest)

    monkeypatch.setattr(runs_module, "train_run", counted)
    work = partial(complete_run, out=tmp_path, reading=reading)
    first = [run(dataset, steps=1), Run(dataset, "pdr", 0, None)]
    assert list(each(work, first)) == first
    assert_complete(tmp_path / "own/StarIO/1-steps/seed-0")
    errors = first[0].folder(tmp_path) / "tested.json"
    written = errors.stat().st_mtime_ns
    more = [*first, run(dataset, "StarIO without MSGCU", steps=1), run(dataset, seed=1, steps=1)]
    assert list(each(work, more)) == more
    assert trained == ["StarIO 0", "StarIO without MSGCU 0", "StarIO 1"]
    assert errors.stat().st_mtime_ns == written
    table = set_table(dataset, completed_runs(more, tmp_path)["own"], {})
    pdr, other, ours = table.rows.to_dict("records")
    assert (pdr["network"], other["network"]) == ("pdr", "StarIO without MSGCU")
    ate = values(table.scores, "ate_m", network="StarIO", track=TRUE_ATTITUDE)
    assert ours["ate"] == pytest.approx(ate.mean())
    assert ours["ate_sem"] == pytest.approx(abs(ate[0] - ate[1]) / 2)  # deviation / sqrt(2)
    assert np.isnan(other["ate_sem"])
    assert np.isnan(pdr["ate"])
    assert pdr["own_ate"] > 0.0
    assert sorted([other["rank"], ours["rank"]]) == [1, 2]  # fmt: skip


@pytest.mark.usefixtures("narrow_network")
def test_runs_of_another_recipe_are_refused(dataset, reading, tmp_path):
    done = run(dataset, steps=1)
    complete_run(done, tmp_path, reading)
    other = Run(dataset, "StarIO", 0, run_recipe({**RECIPE, "rate": 1e-2}, "StarIO", 0, 1))
    with pytest.raises(ConfigError, match=r"tested\.json.*recipe"):
        complete_run(other, tmp_path, reading)
    assert completed_runs([run(dataset, steps=2)], tmp_path) == {}


def test_the_most_important_runs_come_first_and_all_have_equal_steps(dataset):
    names = ("tyrex", "oxiod", "all")
    sets = [DataSet(n, dataset.training, dataset.validation, dataset.test, "") for n in names]
    runs = table_runs(sets, {**RECIPE, "batch": 10}, steps=600, seeds=2)
    order = [(c.dataset.name, c.seed) for c in runs if c.recipe]
    assert list(dict.fromkeys(order)) == [
        ("oxiod", 0), ("all", 0), ("oxiod", 1), ("all", 1), ("tyrex", 0), ("tyrex", 1),
    ]  # fmt: skip
    assert order.count(("all", 0)) == len(ARCHITECTURES)
    assert [c.network for c in runs if (c.dataset.name, c.seed) == ("all", 1)] == list(LEADING)
    recipes = [c.recipe for c in runs if c.recipe]
    assert {(r.steps, r.batch, r.patience >= r.epochs) for r in recipes} == {(600, 10, True)}
    assert [c.network for c in runs[:2]] == ["pdr", "default"]
    with pytest.raises(InputError, match="Nobody"):
        table_runs(sets, RECIPE, networks=["Nobody"])


def test_a_run_can_be_pickled_for_other_machines(dataset, reading):
    work = partial(complete_run, out=Path("out"), reading=reading)
    sent = pickle.loads(pickle.dumps((work, run(dataset))))
    assert sent[1] == run(dataset)
    assert sent[1].digest == run(dataset).digest


def test_results_belong_to_a_network_a_recipe_and_all_recordings_of_their_set(dataset):
    sets = [replace(dataset, **{part: ()}) for part in ("training", "validation", "test")]
    others = [*map(run, sets), run(dataset, "R-ResNet"), run(dataset, seed=1)]
    assert len({run(dataset).digest, *(other.digest for other in others)}) == 6


def test_new_weights_or_changed_recordings_do_not_keep_old_results(dataset, monkeypatch):
    given = Run(dataset, "default", 0, None)
    before = given.digest, run(dataset).digest
    with monkeypatch.context() as patch:
        patch.setattr(runs_module, "_weights_sha256", lambda name: "new")
        assert (given.digest != before[0], run(dataset).digest) == (True, before[1])
    os.utime(dataset.training[0])  # as if it were written again
    assert (given.digest, run(dataset).digest != before[1]) == (before[0], True)
    os.utime(dataset.test[0].path)
    assert given.digest != before[0]
    with pytest.raises(WeightsError, match="no such file"):
        _ = Run(dataset, "missing", 0, None).digest


def test_an_unknown_backend_is_refused():
    with pytest.raises(InputError, match="--backend"), backend("mpi"):
        pass


@pytest.mark.usefixtures("blank_figures")
def test_the_command_writes_tables_and_figures(dataset, tmp_path, monkeypatch):
    folder = dataset.training[0].parent
    monkeypatch.setenv("STARIO_CACHE", str(tmp_path / "cache"))
    costs = [ModelRow("DeepILS", 2_290_754, 15_287_000, {"torch": {"1": 1.0, "64": 0.5}}, 11.2)]
    surveyed = "stario.fusion.paper_table.table.survey"  # measuring is slow
    monkeypatch.setattr(surveyed, lambda names: costs if names == ["DeepILS"] else [])
    (tmp_path / "recipe.json").write_text(json.dumps(RECIPE))
    out = tmp_path / "out"
    arguments = ["--set", f"ronin={folder}", "--out", str(out), "--steps", "1", "--seeds", "1"]
    arguments += ["--networks", "DeepILS", "--config", str(tmp_path / "recipe.json")]
    done = CliRunner().invoke(app, ["check", "table", *arguments])
    assert done.exit_code == 0, done.output
    text = (out / "table.md").read_text()
    assert text in done.output
    for words in ("1 training steps of 6 windows", "| DeepILS | 2.291 (", "4.374, 3.665"):
        assert words in text
    assert pd.read_csv(out / "table.csv")["network"].to_list() == ["pdr", "DeepILS", "default"]
    content = json.loads((out / "table.json").read_text())["sets"]["ronin"]
    assert (content["training"], content["validation"], content["tested"]) == (2, 1, 1)
    figures = {path.name for path in (out / "ronin/figures").glob("*.png")}
    assert figures == {"ate_parameters.png", "distributions.png", "pde.png", "trajectories.png"}
    clash = f"check table --out {out} --set a={folder} --set a={folder}".split()
    with pytest.raises(InputError, match="name"):
        CliRunner().invoke(app, clash, catch_exceptions=False)
