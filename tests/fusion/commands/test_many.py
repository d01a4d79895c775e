"""The commands for many recordings: compare, evaluate, train, backends."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from training_runs import narrow

from stario.fusion.commands import evaluate
from stario.fusion.commands.options import ReadingOptions
from stario.fusion.commands.train import _recipe
from stario.fusion.commands.training_data import packaged_lists
from stario.fusion.evaluation.compare import TRACKS
from stario.network import load_model
from stario.network.training import splits
from stario.network.training.config import FINE_TUNING, training_config
from stario.network.training.splits import read_packaged_list
from stario.sequences.readers.archive import split_name
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.generic_csv import read_generic_csv
from stario.sequences.simulation.moments import MOMENTS

# --- compare and evaluate ----------------------------------------------------------------------


def test_compare_prints_json_and_writes_the_same(stario, recording: Path, tmp_path: Path) -> None:
    done = stario("compare", recording, "--out", "out", "--json")
    assert done.code == 0
    assert json.loads(done.out) == json.loads((tmp_path / "out/metrics.json").read_text())
    assert (tmp_path / "out/walk/plan.png").stat().st_size > 10_000


@pytest.mark.usefixtures("no_figures")
def test_compare_sets_the_track_against_dead_reckoning(stario, recording: Path) -> None:
    done = stario("compare", recording, "--out", "out")
    assert done.err == ""
    seen, *findings, files = done.out.splitlines()
    assert all(line.startswith(("! ", "  ")) for line in findings)
    assert re.fullmatch(
        r"walk: StarIO's track: [\d.]+ m rms from the truth \([\d.]+ % of its [\d.]+ m\), "
        r"[\d.]+ m \([\d.]+ %\) after the best shift and turn; its sigma says [\d.]+ m; "
        r"dead reckoning: [\d.]+ m",
        seen,
    )
    assert files.startswith("figures and tracks: out/walk/plan.png")
    assert {path.stem for path in Path("out/walk").glob("*.tum")} == {
        *("track", "dead_reckoning", "truth"),
    }


@pytest.mark.usefixtures("no_figures")
def test_compare_prints_a_table_of_further_tracks_and_explains_on_request(
    stario, recording: Path
) -> None:
    done = stario("compare", recording, "--tracks", "all", "--explain")
    rows = [line.split()[0] for line in done.out.splitlines()]
    assert [row for row in rows if row in TRACKS] == list(TRACKS)
    assert "root mean square of the position error's norm" in done.out
    two = stario("compare", recording, "--tracks", "filtered")
    assert "root mean square" not in two.out
    assert {row for line in two.out.splitlines() if (row := line.split()[0]) in TRACKS} == {
        *("track", "filtered", "dead_reckoning"),
    }
    stario("compare", recording, "--tracks", "ekf").assert_one_line_error("--tracks", "filtered")


def test_check_fusion_compares_the_fusion_with_its_network(
    stario, recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "walk.csv").write_bytes(recording.read_bytes())
    done = stario("check", "fusion", recording, "walk.csv", "--json")
    assert done.code == 0
    scores = json.loads(done.out)
    assert {one["track"] for one in scores} <= set(TRACKS)  # as `run` and `compare` name them
    first, second = (one for one in scores if one["track"] == "network")
    assert [first["recording"], second["recording"]] == ["walk", "walk-2"]
    assert first["error_m"] == second["error_m"] > 0.0
    refused = stario("check", "fusion", recording, "--by", "colour")
    assert refused.code == 1
    assert "carry" in refused.err


def test_check_gaps_reports_how_far_missing_samples_move_the_end(
    stario, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stario.fusion.evaluation.checks.fusion.INSTANTS", 1)
    done = stario("check", "gaps", recording, "--json")
    assert done.code == 0
    found = json.loads(done.out)
    assert len(found) == 2
    assert all(one["recording"] == "walk" and one["metres"] >= 0.0 for one in found)
    shown = stario("check", "gaps", recording)
    assert "walk" not in shown.err
    assert "within 1% and 3 deg" in shown.out


def test_check_moments_reports_what_a_bad_moment_costs(
    stario, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = "stario.fusion.evaluation.checks.moments"
    monkeypatch.setattr(f"{checks}.MOMENTS", MOMENTS[-1:])
    monkeypatch.setattr(f"{checks}.PLACES", {"middle": 0.5})
    done = stario("check", "moments", recording, "--graph", "--json")
    assert done.code == 0
    found = json.loads(done.out)
    assert [(one["recording"], one["group"], one["track"]) for one in found] == [
        ("walk", "lift, middle", track) for track in ("filtered", "track")
    ]
    assert all(one["error_with"] > 0.0 for one in found)
    monkeypatch.setattr(f"{checks}.simulated_walks", lambda: [read_generic_csv(recording)])
    shown = stario("check", "moments")
    assert "lift, middle" in shown.out
    stario("check", "moments", "--axes", "y,-x,z").assert_one_line_error("--axes", "simulated")


def test_check_fixes_evaluates_tracks_with_fixes(stario, recording: Path) -> None:
    done = stario("check", "fixes", recording, "--every", "2", "--sigma", "0.1", "--json")
    assert done.code == 0
    (found,) = json.loads(done.out)
    assert found["recording"] == "walk"
    assert 0.0 < found["position_rms"] < 1.0
    shown = stario("check", "fixes", recording, "--every", "2")
    assert "yaw NEES" in shown.out


@pytest.mark.usefixtures("no_figures")
def test_truth_that_covers_only_a_part_is_reported(stario, recording: Path, tmp_path: Path) -> None:
    walk = read_generic_csv(recording)
    assert walk.truth is not None
    write_csv(tmp_path / "part.csv", replace(walk, truth=walk.truth.slice(0.0, 6.0)))
    done = stario("run", "part.csv", "--out", "out")
    assert "; the truth covers 50% of it" in done.out


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("command", ["run", "compare"])
def test_figures_of_several_recordings_are_explained_once(
    stario, recording: Path, tmp_path: Path, command: str
) -> None:
    shutil.copy(recording, tmp_path / "again.csv")
    done = stario(command, recording, "again.csv", "--out", "out", "--explain")
    assert done.out.count("\nfitted [m]: ATE after") == 1
    assert done.out.count("m rms from the truth") == 2


def test_many_recordings_skipped_for_one_reason_take_one_line(
    stario, recording: Path, tmp_path: Path
) -> None:
    blind = read_generic_csv(recording).without_truth()
    for k in range(5):
        write_csv(tmp_path / f"blind-{k}.csv", blind)
    done = stario("evaluate", recording, tmp_path)
    assert done.code == 1
    (line,) = done.err.splitlines()
    assert "5 recordings, the first " in line
    assert "blind-0.csv: truth: found none" in line


def test_evaluate_prints_medians_and_needs_truth(stario, recording: Path, tmp_path: Path) -> None:
    done = stario("evaluate", recording)
    assert done.code == 0
    assert [line.split()[0] for line in done.out.splitlines()[1:4]] == ["walk", "median", "mean"]
    done = stario("evaluate", recording, "--json")
    assert json.loads(done.out)["over_recordings"]["track"]["ate_m"]["median"] > 0.0
    write_csv(tmp_path / "blind.csv", read_generic_csv(recording).without_truth())
    stario("evaluate", "blind.csv").assert_one_line_error("truth")


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_batch_continues_after_failures_and_reports_them(
    stario, recording: Path, tmp_path: Path, jobs: int
) -> None:
    walk = read_generic_csv(recording)
    write_csv(tmp_path / "deg.csv", replace(walk, gyro=np.degrees(walk.gyro)))
    write_csv(tmp_path / "blind.csv", walk.without_truth())
    (tmp_path / "broken.csv").write_text("t,gx,gy,gz,ax,ay,az\n0,0,0,0,x,0,0\n")
    (tmp_path / "list.txt").write_text("deg.csv\nnosuch.csv\n\n,blind.csv\nblind.csv\nbroken.csv\n")
    write_csv(tmp_path / "walk.csv", walk)
    done = stario(
        "evaluate", recording, "list.txt", "missing", "walk.csv", "--jobs", jobs,
        "--out", "out", "--json",
    )  # fmt: skip
    assert done.code == 1
    figures = json.loads(done.out)
    assert set(figures["recordings"]) == {"walk", "walk-2"}
    assert json.loads((tmp_path / "out/metrics.json").read_text())["recordings"].keys() == {
        "walk", "walk-2"
    }  # fmt: skip
    lines = done.err.splitlines()
    assert all(line.startswith("stario: skipped: ") for line in lines)
    reasons = ("--gyro-unit", "nosuch.csv", "an empty entry", "truth", "ax: found 'x'", "missing")
    assert len(lines) == len(reasons)
    for reason in reasons:
        assert sum(reason in line for line in lines) == 1


@pytest.mark.usefixtures("no_figures")
def test_evaluate_compares_with_other_weights_by_groups(
    stario, recording: Path, tmp_path: Path
) -> None:
    """Weights against themselves; twelve seconds are too few for an error over ten seconds."""
    (tmp_path / "walks").mkdir()
    stario("simulate", "walks/long.csv", "--seconds", 25, "--carry", "handheld", "--rate", 100)
    done = stario(
        "evaluate", recording, "walks/long.csv", "--by", "set", "--against", "default",
        "--filtered", "--out", "out", "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    groups = {(group["group"], group["role"]): group for group in json.loads(done.out)["groups"]}
    short, long = (groups[name, "ours"] for name in (recording.parent.name, "walks"))
    equal = {"ratio": 1.0, "low": None, "high": None}  # one block each has no interval
    assert (short["ratio_1s"], short["ratio_10s"]) == (equal, None)
    assert (long["ratio_1s"], long["ratio_10s"]) == (equal, equal)
    assert long["length_ratio"] == pytest.approx(1.0, abs=0.5)  # of a walk of 25 s
    assert long["rms_1s_m"] < long["rms_10s_m"] < 10.0 * long["rms_1s_m"]
    assert 0.5 < long["nis_filtered"] < 6.0  # 3 is expected of a consistent filter
    written = json.loads((tmp_path / "out/groups.json").read_text())["groups"]
    assert {(group["group"], group["role"]): group for group in written} == groups


def test_every_option_that_changes_what_is_read_is_part_of_the_key_of_a_cache() -> None:
    usual = ReadingOptions()
    for name in (field.name for field in fields(usual)):
        other = replace(usual, **{name: ["person=dan"] if name == "where" else "other"})
        assert (other.as_read() == usual.as_read()) == (name == "where")


# --- train -------------------------------------------------------------------------------------


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A recipe of one step."""
    path = tmp_path / "tiny.json"
    path.write_text(json.dumps({"epoch_windows": 32, "batch": 32, "epochs": 1}))
    return path


@pytest.fixture
def narrow_network(monkeypatch: pytest.MonkeyPatch) -> None:
    narrow(monkeypatch)


@pytest.mark.usefixtures("no_figures", "narrow_network")
def test_weights_that_train_writes_can_be_run(
    stario, recording: Path, tmp_path: Path, tiny: Path
) -> None:
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


@pytest.mark.usefixtures("narrow_network")
def test_training_continues_after_failures_and_caches_its_windows(
    stario, recording: Path, tmp_path: Path, tiny: Path
) -> None:
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
def test_weights_to_start_from_set_the_network(
    stario, recording: Path, tmp_path: Path, tiny: Path
) -> None:
    call, other = ("train", recording, "--recorded-only", "--config", tiny), "StarIO without MSGCU"
    assert stario(*call, "--model", other, "--out", "first").code == 0
    first = ("--start-from", "first/model.safetensors")
    assert stario(*call, *first, "--out", "second").code == 0
    card = json.loads((tmp_path / "second/model.json").read_text())
    assert card["architecture"] == other
    stario(*call, *first, "--model", "StarIO").assert_one_line_error("--start-from", other)


@pytest.mark.usefixtures("narrow_network")
def test_sigma_is_not_calibrated_on_a_few_seconds_where_initial_weights_have_a_calibration(
    stario, recording: Path, tmp_path: Path, tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def calibration(out: str, *options: str) -> object:
        call = ("train", recording, "--recorded-only", "--config", tiny, *options, "--out", out)
        assert stario(*call).code == 0
        return json.loads((tmp_path / out / "model.json").read_text())["calibration"]

    first = calibration("first")
    tuned = ("--start-from", "first/model.safetensors")
    assert calibration("tuned", *tuned) == first
    monkeypatch.setattr("stario.fusion.commands.train._CALIBRATING_S", 1.0)
    assert calibration("calibrated", *tuned) != first


def test_fine_tuning_changes_weights_a_little_unless_a_recipe_says_otherwise(tiny: Path) -> None:
    first = load_model("default")
    assert _recipe(None, None).learned == _recipe(tiny, first).learned == 1.0
    gentle = _recipe(None, first, epochs=5)
    assert gentle == replace(training_config(FINE_TUNING), epochs=5)
    assert gentle.learned < 0.5
    assert gentle.rate < _recipe(None, None).rate


@pytest.mark.usefixtures("narrow_network")
def test_training_can_use_recordings_alone(
    stario, recording: Path, tmp_path: Path, tiny: Path
) -> None:
    twice = recording, recording.parent  # counts once
    done = stario("train", *twice, "--recorded-only", "--config", tiny, "--out", "alone")
    assert done.code == 0, done.err
    trained_on = json.loads((tmp_path / "alone/model.json").read_text())["trained_on"]
    assert trained_on == ["recorded, others: 10 s"]  # nothing simulated, no licence known


def test_a_recording_cannot_both_train_and_validate(
    stario, recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "list.txt").write_text(f"{recording}\n")
    done = stario("train", recording, "--validation", "list.txt", "--generated", 1)
    done.assert_one_line_error("--validation", f"{recording}, which is also trained on")
    assert not (tmp_path / "runs").exists()


def test_nothing_is_trained_if_nothing_could_be_read(stario, tmp_path: Path) -> None:
    stario("train", "missing.csv").assert_one_line_error("missing.csv", "no such file")
    assert not (tmp_path / "runs").exists()


def test_run_writes_the_smoothed_track_and_on_request_the_filters(
    stario, recording: Path, tmp_path: Path, no_figures
) -> None:
    done = stario("run", recording, "--filtered", "--out", "out", "--json")
    assert done.code == 0
    assert json.loads(done.out)["filtered"]["ate_m"] > 0.0
    smoothed, filtered = (
        np.load(tmp_path / "out" / f"{name}.npz") for name in ("track", "filtered")
    )
    np.testing.assert_array_equal(smoothed["time"], filtered["time"])
    bend = [
        np.abs(np.diff(arrays["position_W"], 2, axis=0)).max() for arrays in (smoothed, filtered)
    ]
    assert bend[0] < 0.5 * bend[1]  # the filter's steps at updates are gone
    sigma = [
        np.trace(arrays["covariance"][:, 9:12, 9:12], axis1=1, axis2=2)
        for arrays in (smoothed, filtered)
    ]
    assert (sigma[0][:20] < sigma[1][:20]).all()  # the bias is known from the start
    stario("run", recording, "--out", "out")
    assert not (tmp_path / "out/filtered.tum").exists()


def test_backends_compares_filter_and_graph(stario) -> None:
    done = stario("check", "backends", "--walks", "1", "--seconds", "10", "--json")
    assert done.code == 0
    content = json.loads(done.out)
    assert set(content["summary"]["median_ate_m"]) == {"filtered", "track", "fixed_lag"}
    assert content["scores"][0]["recording"] == "walk 0"


def test_recordings_too_short_to_hold_out_a_part_require_validation_recordings(
    stario, recording: Path, tmp_path: Path
) -> None:
    write_csv(tmp_path / "short.csv", read_generic_csv(recording).slice(0.0, 9.0))
    stario("train", "short.csv", "--generated", 1).assert_one_line_error(
        "two legs between known positions", "--validation"
    )


def test_what_is_left_out_is_neither_learned_from_nor_selected_on(tmp_path: Path) -> None:
    for line in _names():
        file = split_name(tmp_path / line)[0]
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


def _names() -> list[str]:
    lists = Path(splits.__file__).parent / "all.txt"
    lines = lists.read_text().splitlines()
    return [line.partition(",")[0] for line in lines if line and not line.startswith("#")]


def test_set_in_the_name_of_weights_is_the_first_word_of_a_group(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(evaluate, "_loaded", loaded.append)

    evaluate._for_group("runs/{set}/{group}.safetensors", "ridi dan")

    assert loaded == ["runs/ridi/ridi_dan.safetensors"]
