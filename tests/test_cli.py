"""The `stario` command as a user meets it: output, files, exit codes, one-line errors."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from stario.fusion.cli import app, main
from stario.fusion.config import read_config
from stario.sequences.conventions import with_axes
from stario.sequences.files import read_tum
from stario.sequences.readers.own_csv import read_own_csv, write_csv

COMMANDS = (
    "run",
    "compare",
    "evaluate",
    "simulate",
    "convert",
    "inspect",
    "train",
    "models",
    "export",
    "benchmark",
    "backends",
)


class Done:
    """What a call of the command left."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


@pytest.fixture
def stario(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    capsys: pytest.CaptureFixture[str],
):
    """Calls `stario` with arguments, in this process and in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STARIO_CACHE", str(tmp_path_factory.mktemp("cache")))

    def call(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["stario", *map(str, arguments)])
        capsys.readouterr()
        code = 0
        try:
            main()
        except SystemExit as leaving:
            code = int(leaving.code or 0)
        captured = capsys.readouterr()
        return Done(code, captured.out, captured.err)

    return call


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures, which take most of the time, where a test does not look at them."""
    monkeypatch.setattr("stario.fusion.results._figures", lambda *arguments: [])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "walk.csv"
    result = CliRunner().invoke(
        app, ["simulate", str(path), "--seconds", "12", "--carry", "handheld", "--rate", "100"]
    )
    assert result.exit_code == 0, result.output
    return path


def assert_one_line_error(done: Done, *words: str) -> None:
    assert done.code == 1
    assert done.out == ""
    lines = done.err.strip().splitlines()
    assert len(lines) == 1, done.err
    assert lines[0].startswith("stario: ")
    for word in words:
        assert word in lines[0]


# --- help and usage ----------------------------------------------------------------------------


def test_help_names_every_command() -> None:
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    for command in COMMANDS:
        assert command in result.output


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"], terminal_width=200)
    assert result.exit_code == 0
    assert f"stario {command}" in result.output.replace("root", "stario")
    assert " . " not in result.output  # a word in brackets that the formatter swallowed


@pytest.mark.parametrize(
    "arguments",
    [
        ["nosuch"],
        ["run"],
        ["run", "a.csv", "--nosuch"],
        ["simulate", "a.csv", "--seconds", "long"],
        ["simulate", "a.csv", "--seed", "-1"],
        ["train", "--epochs", "0"],
    ],
)
def test_wrong_usage_leaves_with_two(stario, arguments: list[str]) -> None:
    done = stario(*arguments)
    assert done.code == 2
    assert "Usage" in done.err


def test_the_installed_command_keeps_these_codes(tmp_path: Path) -> None:
    command = Path(sys.executable).with_name("stario")
    if not command.exists():
        pytest.skip("stario is not installed beside this Python")

    def code(*arguments: str) -> int:
        return subprocess.run([command, *arguments], capture_output=True, cwd=tmp_path).returncode

    assert [code("--help"), code("run", "missing.csv"), code("nosuch")] == [0, 1, 2]


def test_a_bug_is_not_dressed_up_as_an_error_of_the_user(
    stario, monkeypatch: pytest.MonkeyPatch, recording: Path
) -> None:
    def broken(path: Path, format: str) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("stario.sequences.readers.read_recording", broken)
    with pytest.raises(ZeroDivisionError):
        stario("run", recording)


# --- simulate and run --------------------------------------------------------------------------


def test_simulate_writes_a_recording_with_truth(stario, tmp_path: Path) -> None:
    done = stario("simulate", "w.csv", "--seconds", 5, "--rate", 50, "--seed", 7, "--json")
    assert done.code == 0
    figures = json.loads(done.out)
    sequence = read_own_csv(tmp_path / "w.csv")
    assert figures["samples"] == len(sequence) == 251
    assert figures["duration_s"] == pytest.approx(5.0)
    assert sequence.truth is not None
    stario("simulate", "again.csv", "--seconds", 5, "--rate", 50, "--seed", 7)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "w.csv").read_bytes()


def test_run_leaves_a_track_and_says_so(stario, recording: Path, tmp_path: Path) -> None:
    done = stario("run", recording, "--out", "out")
    assert done.code == 0
    assert done.err == ""
    for words in ("walk: 12.0 s", "ATE [m]", "samples used 1201", "updates", "8 files in out"):
        assert words in done.out
    track = read_tum(tmp_path / "out" / "ekf.tum")
    assert track.time[-1] - track.time[0] == pytest.approx(12.0, abs=0.11)
    assert len(list((tmp_path / "out").iterdir())) == 8


@pytest.mark.usefixtures("undrawn")
def test_run_speaks_json(stario, recording: Path, tmp_path: Path) -> None:
    done = stario("run", recording, "--json")
    figures = json.loads(done.out)
    assert figures["recording"] == "walk"
    assert figures["ekf"]["ate_m"] > 0.0
    assert (tmp_path / figures["folder"] / "metrics.json").exists()


@pytest.mark.usefixtures("undrawn")
def test_run_needs_no_truth_and_the_track_is_the_same(
    stario, recording: Path, tmp_path: Path
) -> None:
    write_csv(tmp_path / "blind.csv", read_own_csv(recording).without_truth())
    assert stario("run", recording, "--out", "seen").code == 0
    done = stario("run", "blind.csv", "--out", "blind", "--json")
    assert json.loads(done.out)["ekf"]["ate_m"] is None
    seen, blind = ((tmp_path / name / "ekf.tum").read_bytes() for name in ("seen", "blind"))
    assert seen == blind


@pytest.mark.usefixtures("undrawn")
def test_settings_come_from_a_file_and_are_kept(stario, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "slow.toml").write_text("[filter]\nupdate_rate = 2\n")
    assert stario("run", recording, "--config", "slow.toml", "--out", "a").code == 0
    assert read_config(tmp_path / "a/config.json") == read_config(tmp_path / "slow.toml")
    assert json.loads((tmp_path / "a/health.json").read_text())["updates"] == 23


@pytest.mark.usefixtures("undrawn")
def test_run_takes_a_folder_or_a_list(stario, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    for name in ("a", "b"):
        (tmp_path / "all" / f"{name}.csv").write_bytes(recording.read_bytes())
    done = stario("run", "all", "--out", "out")
    assert done.code == 0
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"a", "b"}
    (tmp_path / "list.txt").write_text("all/b.csv\nall/c.csv\n")
    done = stario("run", "list.txt", "--out", "alone")
    assert done.code == 1
    assert "skipped" in done.err
    assert "all/c.csv" in done.err
    assert (tmp_path / "alone/ekf.tum").exists()


# --- convert -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn")
def test_a_converted_recording_gives_the_same_track(
    stario, recording: Path, tmp_path: Path
) -> None:
    assert stario("convert", recording, "there").code == 0
    done = stario("convert", "there", "back.csv")
    assert done.code == 0
    assert "there: 1201 samples, 12.0 s\nback.csv" in done.out
    for path, out in ((recording, "a"), ("back.csv", "b")):
        assert stario("run", path, "--out", out).code == 0
    a, b = (read_tum(tmp_path / out / "ekf.tum") for out in "ab")
    np.testing.assert_allclose(a.position_W, b.position_W, atol=0.01)  # times by whole ns
    assert_one_line_error(stario("convert", recording, "there"), "there", "exists")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("command", ["run", "compare", "evaluate", "convert"])
def test_what_the_numbers_mean_can_be_told_to_every_command(
    stario, recording: Path, tmp_path: Path, command: str
) -> None:
    """Rates in degrees, Apple's user acceleration in g, axes turned against the truth's."""
    walk = with_axes(read_own_csv(recording), "-y,x,z")
    upright = walk.truth.at(walk.time).attitude_WB * Rotation.from_euler("z", 90, degrees=True)
    linear = walk.accel - upright.apply([0.0, 0.0, 9.80665], inverse=True)
    write_csv(
        tmp_path / "odd.csv", replace(walk, gyro=np.degrees(walk.gyro), accel=linear / -9.80665)
    )
    target = ["out.csv"] if command == "convert" else []
    assert_one_line_error(stario(command, "odd.csv", *target))
    words = ["--gyro-unit", "deg/s", "--accel-unit=-g", "--axes", "y,-x,z", "--gravity", "removed"]
    done = stario(command, "odd.csv", *target, *words)
    assert done.code == 0, done.err


# --- inspect -----------------------------------------------------------------------------------


def test_inspect_names_what_mends_a_recording(stario, recording: Path, tmp_path: Path) -> None:
    walk = read_own_csv(recording)
    write_csv(tmp_path / "g.csv", replace(walk, accel=walk.accel / 9.80665))
    done = stario("inspect", "g.csv", "--out", "out")
    assert done.code == 0
    assert "--accel-unit g" in done.out
    assert (tmp_path / "out/inspection.png").stat().st_size > 10_000
    mended = json.loads(stario("inspect", "g.csv", "--accel-unit", "g", "--json").out)
    assert mended["problems"] == []
    assert mended == json.loads((tmp_path / "runs/g/inspection.json").read_text())
    assert mended["rate_hz"] == pytest.approx(100.0)


# --- wrong input -------------------------------------------------------------------------------


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.usefixtures("undrawn")
def test_degrees_are_refused_with_the_option_that_helps(
    stario, recording: Path, tmp_path: Path, truth: bool
) -> None:
    sequence = read_own_csv(recording)
    sequence = sequence if truth else sequence.without_truth()
    write_csv(tmp_path / "deg.csv", replace(sequence, gyro=np.degrees(sequence.gyro)))
    done = stario("run", "deg.csv", "--out", "out")
    assert_one_line_error(done, "--gyro-unit deg/s", "deg")
    assert not (tmp_path / "out").exists()
    if truth:
        assert stario("run", "deg.csv", "--out", "out", "--gyro-unit", "deg/s").code == 0


@pytest.mark.usefixtures("undrawn")
def test_g_is_refused_with_the_option_that_helps(stario, recording: Path, tmp_path: Path) -> None:
    sequence = read_own_csv(recording)
    write_csv(tmp_path / "g.csv", replace(sequence, accel=sequence.accel / 9.80665))
    assert_one_line_error(stario("run", "g.csv"), "--accel-unit g")
    assert stario("run", "g.csv", "--accel-unit", "g").code == 0


@pytest.mark.usefixtures("undrawn")
def test_gravitys_sign_is_refused_with_the_option_that_helps(
    stario, recording: Path, tmp_path: Path
) -> None:
    sequence = read_own_csv(recording)
    write_csv(tmp_path / "apple.csv", replace(sequence, accel=-sequence.accel))
    assert_one_line_error(stario("run", "apple.csv"), "--accel-unit=-m/s^2")
    assert stario("run", "apple.csv", "--accel-unit=-m/s^2").code == 0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["broken.csv"]),
        (b"t,gx,gy,gz,ax,ay,az\n", ["broken.csv", "rows"]),
        (b"t,gx,gy,gz,ax,ay\n0,0,0,0,0,0\n", ["broken.csv"]),
        (b"t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n0.01,0,0\n", ["line 3", "cut short"]),
        (b"t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n", ["broken", "at least"]),
        (b"\x89PNG\r\n\x1a\n\x00\x00", ["broken.csv"]),
    ],
)
def test_a_broken_file_is_named_in_one_line(
    stario, tmp_path: Path, content: bytes, words: list[str]
) -> None:
    (tmp_path / "broken.csv").write_bytes(content)
    assert_one_line_error(stario("run", "broken.csv"), *words)
    assert list(tmp_path.iterdir()) == [tmp_path / "broken.csv"]


def test_a_recording_cut_within_a_line_is_named(stario, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.csv").write_bytes(recording.read_bytes()[:50_020])
    assert_one_line_error(stario("run", "cut.csv"), "cut.csv", "line ")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "missing.csv"], ["missing.csv", "nothing there"]),
        (["compare", "missing"], ["missing", "nothing there"]),
        (["evaluate", "--data", "missing"], ["missing", "--data"]),
        (["evaluate", "--split", "practice"], ["split", "practice"]),
        (["run", "RECORDING", "--format", "fax"], ["format", "fax"]),
        (["run", "RECORDING", "--gyro-unit", "rpm"], ["gyro_unit", "rpm"]),
        (["run", "RECORDING", "--axes", "y,x,z"], ["axes", "left-handed"]),
        (["run", "RECORDING", "--gravity", "gone"], ["gravity", "gone"]),
        (["convert", "RECORDING", "a.csv", "--to", "fax"], ["layout", "fax"]),
        (["convert", "missing.csv", "a.csv"], ["missing.csv", "nothing there"]),
        (["convert", "RECORDING", "no/such/a.csv"], ["folder"]),
        (["run", "RECORDING", "--model", "missing.safetensors"], ["missing.safetensors"]),
        (["run", "RECORDING", "--config", "missing.toml"], ["missing.toml"]),
        (["run", "RECORDING", "--config", "."], [".", "TOML or JSON"]),
        (["simulate", "no/such/folder.csv"], ["folder"]),
        (["simulate", ".", "--seconds", "2"], ["folder"]),
        (["simulate", "a.csv", "--seconds", "0"], ["duration"]),
        (["simulate", "a.csv", "--carry", "drone"], ["carry", "drone"]),
        (["simulate", "a.csv", "--imu", "tactical"], ["--imu", "tactical"]),
        (["simulate", "a.csv", "--rate", "0"], ["rate"]),
        (["train", "--generated", "0"], ["streams"]),
        (["train", "--config", "missing.json"], ["missing.json"]),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    stario, recording: Path, arguments: list[str], words: list[str]
) -> None:
    done = stario(*(recording if word == "RECORDING" else word for word in arguments))
    assert_one_line_error(done, *words)


@pytest.mark.parametrize(
    ("command", "content", "named"),
    [
        ("run", '{"filter": {"speed": 1}}', "filter.speed"),
        ("run", '{"noise": {"gyro_noise": "low"}}', "noise.gyro_noise"),
        ("compare", '{"filter": {"update_rate": 3}}', "filter.update_rate"),
        ("evaluate", '{"gravity": 1.62}', "gravity"),
        ("run", "{", "settings.json"),
        ("train", '{"speed": 1}', "speed"),
        ("train", "[1]", "settings.json"),
        ("train", '{"epochs": "three"}', "epochs"),
        ("train", '{"augmentation": {"magic": 1}}', "augmentation.magic"),
    ],
)
def test_a_setting_that_does_not_fit_is_named_in_one_line(
    stario, recording: Path, tmp_path: Path, command: str, content: str, named: str
) -> None:
    (tmp_path / "settings.json").write_text(content)
    assert_one_line_error(stario(command, recording, "--config", "settings.json"), named)


# --- compare and evaluate ----------------------------------------------------------------------


def test_compare_speaks_json_and_writes_the_same(stario, recording: Path, tmp_path: Path) -> None:
    done = stario("compare", recording, "--out", "out", "--json")
    assert done.code == 0
    assert json.loads(done.out) == json.loads((tmp_path / "out/metrics.json").read_text())
    assert (tmp_path / "out/walk/plan.png").stat().st_size > 10_000


@pytest.mark.usefixtures("undrawn")
def test_compare_prints_a_row_per_track(stario, recording: Path) -> None:
    done = stario("compare", recording)
    assert done.err == ""
    for name in ("walk: 12.0 s", "inertial", "network", "network_true_attitude", "ekf"):
        assert name in done.out


@pytest.mark.usefixtures("undrawn")
def test_compare_takes_folders_of_recordings(stario, recording: Path, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "walk.csv").write_bytes(recording.read_bytes())
    done = stario("compare", "a", "b", "--out", "out", "--json")
    assert set(json.loads(done.out)["recordings"]) == {"walk", "walk-2"}
    assert {p.name for p in (tmp_path / "out").iterdir() if p.is_dir()} == {"walk", "walk-2"}


@pytest.mark.usefixtures("undrawn")
def test_a_bad_recording_in_the_list_is_named_and_the_rest_compared(
    stario, recording: Path, tmp_path: Path
) -> None:
    sequence = read_own_csv(recording)
    write_csv(tmp_path / "short.csv", sequence.slice(0.0, 1.0))
    (tmp_path / "broken.csv").write_text("t,gx,gy,gz,ax,ay,az\n0,0,0,0,x,0,0\n")
    for bad in ("short.csv", "broken.csv"):
        done = stario("compare", bad, recording, "--out", "out", "--json")
        assert done.code == 1
        assert set(json.loads(done.out)["recordings"]) == {"walk"}
        (line,) = done.err.splitlines()
        assert line.startswith("stario: skipped: ")
        assert bad.removesuffix(".csv") in line
        assert_one_line_error(stario("compare", bad, "--out", "none"), bad.removesuffix(".csv"))
        assert not (tmp_path / "none").exists()


def test_evaluate_prints_medians_and_needs_truth(stario, recording: Path, tmp_path: Path) -> None:
    done = stario("evaluate", recording)
    assert done.code == 0
    assert [line.split()[0] for line in done.out.splitlines()[1:4]] == ["walk", "median", "mean"]
    done = stario("evaluate", recording, "--json")
    assert json.loads(done.out)["over_recordings"]["ekf"]["ate_m"]["median"] > 0.0
    write_csv(tmp_path / "blind.csv", read_own_csv(recording).without_truth())
    assert_one_line_error(stario("evaluate", "blind.csv"), "truth")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_batch_goes_on_past_what_fails_and_says_so(
    stario, recording: Path, tmp_path: Path, jobs: int
) -> None:
    walk = read_own_csv(recording)
    write_csv(tmp_path / "deg.csv", replace(walk, gyro=np.degrees(walk.gyro)))
    write_csv(tmp_path / "blind.csv", walk.without_truth())
    (tmp_path / "broken.csv").write_text("t,gx,gy,gz,ax,ay,az\n0,0,0,0,x,0,0\n")
    (tmp_path / "list.txt").write_text("deg.csv\nnosuch.csv\n\nblind.csv\nbroken.csv\n")
    done = stario(
        "evaluate", recording, "list.txt", "missing", recording, "--jobs", jobs,
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


# --- train -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn")
def test_weights_that_train_writes_can_be_run(stario, recording: Path, tmp_path: Path) -> None:
    settings = {"epoch_windows": 64, "batch": 32, "epochs": 1}
    (tmp_path / "tiny.json").write_text(json.dumps(settings))
    done = stario(
        "train", recording, "--generated", 1, "--config", "tiny.json", "--out", "trained",
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
    assert_one_line_error(stario("run", recording, "--model", weights), "model.safetensors")


def test_training_goes_on_past_what_fails_and_keeps_its_windows(
    stario, recording: Path, tmp_path: Path
) -> None:
    write_csv(tmp_path / "blind.csv", read_own_csv(recording).without_truth())
    (tmp_path / "list.txt").write_text("blind.csv\nnosuch.csv\n")
    (tmp_path / "tiny.json").write_text(json.dumps({"epoch_windows": 32, "batch": 32, "epochs": 1}))
    call = ("train", recording, "list.txt", "--generated", 1, "--config", "tiny.json")
    done = stario(*call, "--out", "a", "--cache", "kept")
    assert done.code == 1
    assert Path(done.out.strip()) == Path("a/model.safetensors")
    lines = [line for line in done.err.splitlines() if line.startswith("stario: skipped")]
    assert len(lines) == 2
    assert "nosuch.csv" in lines[0]
    assert "blind: truth" in lines[1]
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "kept").iterdir()}
    assert len(kept) == 2  # the recording's and the generated walk's
    assert stario(*call, "--out", "b", "--cache", "kept").code == 1
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "kept").iterdir()} == kept
    first, second = ((tmp_path / out / "model.safetensors").read_bytes() for out in "ab")
    assert first == second


def test_nothing_is_trained_where_nothing_could_be_read(stario, tmp_path: Path) -> None:
    assert_one_line_error(stario("train", "missing.csv"), "missing.csv", "nothing there")
    assert not (tmp_path / "runs").exists()


def test_run_with_the_graph_names_its_track(
    stario, recording: Path, tmp_path: Path, undrawn
) -> None:
    done = stario("run", recording, "--backend", "graph", "--out", "out", "--json")
    assert done.code == 0
    assert json.loads(done.out)["graph"]["ate_m"] > 0.0
    assert len(read_tum(tmp_path / "out" / "graph.tum").time) > 100
    notes = json.loads((tmp_path / "out" / "health.json").read_text())["notes"]
    assert notes[0].startswith("graph of")


def test_an_unknown_back_end_is_one_line(stario, recording: Path) -> None:
    done = stario("run", recording, "--backend", "ukf")
    assert done.code == 1
    assert "backend: found 'ukf'" in done.err
    assert len(done.err.strip().splitlines()) == 1


def test_backends_compares_filter_and_graph(stario) -> None:
    done = stario("backends", "--walks", "1", "--seconds", "10", "--json")
    assert done.code == 0
    content = json.loads(done.out)
    assert set(content["summary"]["median_ate_m"]) == {"ekf", "graph", "fixed_lag"}
    assert content["scores"][0]["name"] == "walk 0"
