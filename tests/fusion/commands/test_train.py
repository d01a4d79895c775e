import json
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from stario.fusion.commands.train import _recipe, packaged_lists
from stario.network import load_model
from stario.network.training import splits
from stario.network.training.config import FINE_TUNING, training_config
from stario.network.training.splits import read_packaged_list
from stario.sequences.readers.archive import split_name
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.generic_csv import read_generic_csv


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.json"
    path.write_text(json.dumps({"epoch_windows": 32, "batch": 32, "epochs": 1}))
    return path


@pytest.mark.usefixtures("no_figures", "narrow_network")
def test_weights_that_train_writes_can_be_run(stario, recording, tmp_path, tiny):
    done = stario(
        "train", recording, "--generated", 1, "--config", tiny, "--out", "trained",
        "--seed", 3,
    )  # fmt: skip
    assert done.code == 0, done.err
    weights = Path(done.out.strip())
    assert weights == Path("trained/model.safetensors")
    assert "epoch 1" in done.err
    card = json.loads((tmp_path / "trained/model.json").read_text())
    assert card["recipe"]["seed"] == 3
    assert any("recorded" in words for words in card["trained_on"])
    assert stario("run", recording, "--model", weights, "--out", "out").code == 0
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(bytes(content))
    stario("run", recording, "--model", weights).assert_one_line_error("model.safetensors")


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_training_that_is_stopped_says_how_to_go_on(stario, monkeypatch, tiny, stop):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs inherit none
    monkeypatch.setattr("stario.network.training.train.train", lambda *_: signal.raise_signal(stop))
    done = stario("train", "--generated", 1, "--config", tiny, "--out", "stopped")
    assert done.code != 0
    assert "the same command goes on from the last epoch in stopped" in done.err


@pytest.mark.usefixtures("narrow_network")
def test_training_continues_after_failures_and_caches(stario, recording, tmp_path, tiny):
    write_csv(tmp_path / "blind.csv", read_generic_csv(recording).without_truth())
    (tmp_path / "list.txt").write_text("blind.csv\nnosuch.csv\n")
    call = ("train", recording, "list.txt", "--generated", 1, "--config", tiny)
    done = stario(*call, "--out", "a", "--cache", "kept")
    assert done.code == 1
    assert Path(done.out.strip()) == Path("a/model.safetensors")
    lines = [line for line in done.err.splitlines() if line.startswith("stario: skipped")]
    assert len(lines) == 2
    assert "nosuch.csv" in lines[0]
    assert "blind.csv: truth" in lines[1]
    assert done.err.index(lines[1]) < done.err.index("epoch 1:")
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "kept").iterdir()}
    assert len(kept) == 2  # the recording's and the generated walk's
    assert stario(*call, "--out", "b", "--cache", "kept").code == 1
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "kept").iterdir()} == kept
    first, second = ((tmp_path / out / "model.safetensors").read_bytes() for out in "ab")
    assert first == second


@pytest.mark.usefixtures("narrow_network")
def test_weights_to_start_from_set_the_network(stario, recording, tmp_path, tiny, monkeypatch):
    """A few seconds are too few to calibrate sigma anew."""
    other = "StarIO without MSGCU"

    def card(out, *options):
        twice = recording, recording.parent  # counts once
        call = ("train", *twice, "--recorded-only", "--config", tiny, *options, "--out", out)
        done = stario(*call)
        assert done.code == 0, done.err
        return json.loads((tmp_path / out / "model.json").read_text())

    first = card("first", "--model", other)
    assert first["trained_on"] == ["recorded, others: 10 s"]  # nothing simulated, no licence known
    start = ("--start-from", "first/model.safetensors")
    tuned = card("tuned", *start)
    assert (tuned["architecture"], tuned["calibration"]) == (other, first["calibration"])
    monkeypatch.setattr("stario.fusion.commands.train._CALIBRATING_S", 1.0)
    assert card("calibrated", *start)["calibration"] != first["calibration"]
    wrong = stario("train", recording, "--config", tiny, *start, "--model", "StarIO")
    wrong.assert_one_line_error("--start-from", other)


def test_fine_tuning_changes_weights_a_little_unless_a_recipe_says_otherwise(tiny):
    first = load_model("default")
    assert _recipe(None, None).learned == _recipe(tiny, first).learned == 1.0
    gentle = _recipe(None, first, epochs=5)
    assert gentle == replace(training_config(FINE_TUNING), epochs=5)
    assert gentle.learned < 0.5
    assert gentle.rate < _recipe(None, None).rate


def test_a_recording_cannot_both_train_and_validate(stario, recording, tmp_path):
    (tmp_path / "list.txt").write_text(f"{recording}\n")
    done = stario("train", recording, "--validation", "list.txt", "--generated", 1)
    done.assert_one_line_error("--validation", f"{recording}, which is also trained on")
    assert not (tmp_path / "runs").exists()


def test_short_recordings_require_validation_recordings(stario, recording, tmp_path):
    write_csv(tmp_path / "short.csv", read_generic_csv(recording).slice(0.0, 9.0))
    stario("train", "short.csv", "--generated", 1).assert_one_line_error(
        "two legs between known positions", "--validation"
    )


def test_what_is_left_out_is_neither_learned_from_nor_selected_on(tmp_path):
    listed = (Path(splits.__file__).parent / "all.txt").read_text().splitlines()
    for line in listed:
        if line and not line.startswith("#"):
            file = split_name(tmp_path / line.partition(",")[0])[0]
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
    entries = read_packaged_list("all", tmp_path)
    groups = {entry.path: entry.group for entry in entries}

    learned, selected = packaged_lists(tmp_path, ["tyrex", "ridi dan"], "all")

    used = {groups[path] for path in learned + selected}
    assert not {g for g in used if g.startswith("tyrex")} | ({"ridi dan"} & used)
    holdout = {entry.path for entry in read_packaged_list("holdout", tmp_path)}
    assert set(selected) <= holdout
    assert not set(learned) & holdout
    left_out = sum(g.startswith("tyrex") or g == "ridi dan" for g in groups.values())
    assert len(learned) + len(selected) == len(entries) - left_out
