import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from stario.fusion.commands import options
from stario.fusion.evaluation.compare import TRACKS
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.generic_csv import read_generic_csv
from stario.sequences.simulation.moments import MOMENTS


@pytest.mark.usefixtures("no_figures")
def test_compare_sets_the_track_against_dead_reckoning(stario, recording):
    done = stario("compare", recording, "--out", "out")
    assert done.err == ""
    seen, *findings, files = done.out.splitlines()
    assert all(line.startswith(("! ", "  ")) for line in findings)
    assert re.fullmatch(r"walk: .* [\d.]+ m rms from the truth .*; dead reckoning: [\d.]+ m", seen)
    assert files.startswith("figures and tracks: out/walk/plan.png")
    assert "root mean square" not in done.out
    tracks = {path.stem for path in Path("out/walk").glob("*.tum")}
    assert tracks == {"track", "dead_reckoning", "truth"}


@pytest.mark.usefixtures("no_figures")
def test_compare_prints_a_table_of_further_tracks_and_explains_on_request(stario, recording):
    done = stario("compare", recording, "--tracks", "all", "--explain")
    rows = [line.split()[0] for line in done.out.splitlines()]
    assert [row for row in rows if row in TRACKS] == list(TRACKS)
    assert "root mean square of the position error's norm" in done.out
    stario("compare", recording, "--tracks", "ekf").assert_one_line_error("--tracks", "filtered")


def test_check_fusion_compares_the_fusion_with_its_network(stario, recording, tmp_path):
    (tmp_path / "walk.csv").write_bytes(recording.read_bytes())
    done = stario("check", "fusion", recording, "walk.csv", "--json")
    assert done.code == 0
    scores = json.loads(done.out)
    assert {one["track"] for one in scores} <= set(TRACKS)  # as `run` and `compare` name them
    first, second = (one for one in scores if one["track"] == "network")
    assert [first["recording"], second["recording"]] == ["walk", "walk-2"]
    assert first["error_m"] == second["error_m"] > 0.0


def test_check_gaps_reports_how_far_missing_samples_move_the_end(stario, recording, monkeypatch):
    monkeypatch.setattr("stario.fusion.evaluation.checks.fusion.INSTANTS", 1)
    done = stario("check", "gaps", recording, "--json")
    assert done.code == 0
    found = json.loads(done.out)
    assert len(found) == 2
    assert all(one["recording"] == "walk" and one["metres"] >= 0.0 for one in found)


def test_check_moments_reports_what_a_bad_moment_costs(stario, recording, monkeypatch):
    checks = "stario.fusion.evaluation.checks.moments"
    monkeypatch.setattr(f"{checks}.MOMENTS", MOMENTS[:1])
    monkeypatch.setattr(f"{checks}.PLACES", {"middle": 0.5})
    done = stario("check", "moments", recording, "--graph", "--json")
    assert done.code == 0
    found = json.loads(done.out)
    assert [(one["recording"], one["group"], one["track"]) for one in found] == [
        ("walk", "shake 10 s, middle", track) for track in ("filtered", "track")
    ]
    assert all(one["error_with"] > 0.0 for one in found)
    monkeypatch.setattr(f"{checks}.CARRIES", ("bag",))
    simulated = "stario.fusion.evaluation.checks.simulation.simulated_walk"
    monkeypatch.setattr(simulated, lambda carry, seed: read_generic_csv(recording))
    shown = stario("check", "moments")
    assert "shake 10 s, middle" in shown.out


def test_check_fixes_evaluates_tracks_with_fixes(stario, recording):
    done = stario("check", "fixes", recording, "--every", "2", "--sigma", "0.1", "--json")
    assert done.code == 0
    (found,) = json.loads(done.out)
    assert found["recording"] == "walk"
    assert 0.0 < found["position_rms"] < 1.0


def test_many_recordings_skipped_for_one_reason_take_one_line(stario, recording, tmp_path):
    blind = read_generic_csv(recording).without_truth()
    for k in range(5):
        write_csv(tmp_path / f"blind-{k}.csv", blind)
    done = stario("evaluate", recording, tmp_path)
    assert done.code == 1
    (line,) = done.err.splitlines()
    assert "5 recordings, the first " in line
    assert "blind-0.csv: truth: found none" in line


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_batch_continues_after_failures_and_reports_them(stario, recording, tmp_path, jobs):
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
    assert figures["over_recordings"]["track"]["ate_m"]["median"] > 0.0
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
def test_evaluate_compares_with_other_weights_by_groups(stario, recording, tmp_path):
    """Weights against themselves; twelve seconds are too few for an error over ten seconds."""
    (tmp_path / "walks").mkdir()
    options = "--seconds 25 --carry handheld --rate 100 --seed 1"
    stario("simulate", "walks/long.csv", *options.split())
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


def test_every_option_that_changes_what_is_read_is_part_of_the_key_of_a_cache():
    usual = options.Reading()
    for name in (field.name for field in fields(usual)):
        other = replace(usual, **{name: ["person=dan"] if name == "where" else "other"})
        assert (other.as_read() == usual.as_read()) == (name == "where")


def test_check_fusion_compares_filter_and_graphs_on_simulated_walks(stario):
    done = stario("check", "fusion", "--walks", "1", "--seconds", "10", "--graph", "--json")
    assert done.code == 0
    scores = json.loads(done.out)
    assert [one["track"] for one in scores] == ["network", "filtered", "track", "fixed_lag"]
    assert {(one["recording"], one["group"]) for one in scores} == {("walk 0", "simulated")}


def test_weights_may_be_named_after_set_and_group(stario, recording, tmp_path):
    (tmp_path / "ridi dan").mkdir()
    (tmp_path / "ridi dan/walk.csv").write_bytes(recording.read_bytes())
    named = "runs/{set}/{group}.safetensors"
    done = stario("evaluate", "ridi dan/walk.csv", "--by", "set", "--against", named)
    done.assert_one_line_error("runs/ridi/ridi_dan.safetensors")
