import html
import json
import re
import subprocess
import sys
from dataclasses import replace
from datetime import datetime, timedelta
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from stario.fusion.commands.cli import app
from stario.fusion.values.config import read_config
from stario.network.model import load_model
from stario.sequences import about_z, read_tum, write_csv
from stario.sequences.conventions import with_axes
from stario.sequences.readers.generic_csv import read_generic_csv

COMMANDS = "run live compare evaluate inspect convert train simulate export check"
CHECKS = ("models", "table", "fusion", "moments", "heights", "simulation", "fixes", "benchmark")


@pytest.mark.parametrize("command", [*COMMANDS.split(), *(f"check {name}" for name in CHECKS)])
def test_every_command_prints_its_help(command):
    result = CliRunner().invoke(app, [*command.split(), "--help"], terminal_width=200)
    assert result.exit_code == 0
    assert f"{command} [OPTIONS]" in result.output
    assert " . " not in result.output  # left if the formatter drops a word in brackets


@pytest.mark.parametrize(
    "arguments",
    [
        ["nosuch"],
        ["run"],
        ["simulate", "a.csv", "--seconds", "0"],
        ["train", "--epochs", "0"],
        ["evaluate", "walk.csv", "--by", "mood"],
        ["check", "fixes", "walk.csv", "--backend", "ukf"],
        ["simulate", "a.csv", "--imu", "tactical"],
    ],
)
def test_wrong_usage_exits_with_code_2(stario, arguments):
    done = stario(*arguments)
    assert done.code == 2
    assert "Usage" in done.err


def test_the_version_is_that_of_the_distribution(stario):
    done = stario("--version")
    assert (done.code, done.out, done.err) == (0, f"{version('stario-nav')}\n", "")


def test_the_installed_command_has_the_same_exit_codes(tmp_path):
    command = Path(sys.executable).with_name("stario")
    if not command.exists():
        pytest.skip("stario is not installed next to this Python")

    done = subprocess.run([command, "convert", "one.csv"], capture_output=True, cwd=tmp_path)
    assert done.returncode == 1


def test_a_bug_is_not_reported_as_an_error_of_the_user(stario, monkeypatch, recording):
    def broken(path, format):
        raise ZeroDivisionError

    monkeypatch.setattr("stario.sequences.readers.read_recording", broken)
    with pytest.raises(ZeroDivisionError):
        stario("run", recording)


@pytest.mark.usefixtures("blank_figures")
def test_run_writes_a_track_and_prints_a_summary(stario, recording, tmp_path):
    done = stario("run", recording, "--out", "out")
    assert (done.code, done.err) == (0, "")
    for words in ("walk: generic CSV", "m rms from the truth", "out: track.tum, track.npz"):
        assert words in done.out
    for words in (" rad", "refused none", "root mean square", "0.0%"):
        assert words not in done.out
    track = read_tum(tmp_path / "out" / "track.tum")
    assert track.time[-1] - track.time[0] == pytest.approx(12.0, abs=0.11)
    (printed,) = re.findall(r"track: ([\d.]+) m in", done.out)
    assert float(printed) == pytest.approx(track.path_length(), abs=0.051)
    steps = np.linalg.norm(np.diff(track.position_W, axis=0), axis=1)
    assert float(printed) == pytest.approx(steps.sum(), rel=0.06)  # the phone sways, and no more
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "track.tum", "track.npz", "metrics.json", "config.json", "run.json", "health.json",
        "plan.png", "error.png", "innovations.png",
    }  # fmt: skip
    assert json.loads((tmp_path / "out/health.json").read_text())["samples"]["used"] == 1201


@pytest.mark.usefixtures("no_figures")
def test_run_inspect_and_report_give_one_verdict(stario, recording, tmp_path):
    """Here on positions that contradict accelerometer and track."""
    pytest.importorskip("plotly")
    walk = read_generic_csv(recording)
    truth = replace(walk.truth, position_W=3.0 * walk.truth.position_W)
    write_csv(tmp_path / "wrong.csv", replace(walk, truth=truth))
    told = stario("run", "wrong.csv", "--report").out
    verdict = json.loads(stario("inspect", "wrong.csv", "--json").out)["verdict"]
    page = (tmp_path / "runs/wrong/report.html").read_text()
    assert verdict[0]["code"] != "nothing"
    assert len(verdict) == sum(line.startswith(("! ", "  ")) for line in told.splitlines())
    for finding in verdict:
        assert told.count(finding["text"]) == 1
        assert html.escape(finding["text"]) in page


@pytest.fixture
def true_fixes(recording, tmp_path):
    """Write true positions once a second, in a rotated world and on a delayed clock."""

    def write(yaw: float = 0.0, delay: float = 0.0) -> Path:
        truth = read_generic_csv(recording).truth
        known = truth.at(np.arange(truth.time[0] + 0.5, truth.time[-1], 1.0))
        rows = ["t,kind,x,y,z,sx,sy,sz"]
        for t, p in zip(known.time, about_z(yaw).apply(known.position_W), strict=True):
            rows.append(f"{t + delay},position,{p[0]},{p[1]},{p[2]},0.05,,")
        path = tmp_path / "fixes.csv"
        path.write_text("\ufeff" + "\n".join(rows) + "\n", encoding="utf-8")
        return path

    return write


@pytest.mark.usefixtures("no_figures")
def test_a_track_with_fixes_is_aligned_by_a_fit(stario, recording, tmp_path, true_fixes):
    fixes = true_fixes(yaw=1.0)
    done = stario("run", recording, "--fixes", fixes, "--out", "fixed", "--json")
    assert json.loads(done.out)["track"]["ate_m"] < 0.3
    assert json.loads((tmp_path / "fixed/run.json").read_text())["fixes"] == str(fixes)
    words = json.loads((tmp_path / "fixed/metrics.json").read_text())["conventions"]
    assert "least squares" in words["alignment"]
    done = stario("compare", recording, "--fixes", fixes, "--out", "compared", "--json")
    compared = json.loads(done.out)
    assert words.items() <= compared["conventions"].items()
    assert compared["recordings"]["walk"]["tracks"]["track"]["ate_m"] < 0.3


def test_fixes_on_another_clock_are_refused(stario, recording, true_fixes):
    done = stario("run", recording, "--fixes", true_fixes(delay=1.7e9))
    done.assert_one_line_error("fixes", "1.7e+09", "first sample")


@pytest.mark.usefixtures("no_figures")
def test_run_tells_how_much_of_a_recording_it_tracked(stario, recording):
    head, *lines = recording.read_text().splitlines()
    stopped = lines[700].split(",")[1:7]
    for k in range(701, len(lines)):
        cells = lines[k].split(",")
        lines[k] = ",".join([cells[0], *stopped, *cells[7:]])
    Path("stopped.csv").write_text("\n".join([head, *lines]) + "\n")
    done = stario("run", "stopped.csv")
    assert " m in 7.0 of 12.0 s tracked, " in done.out
    assert "restart the device" in done.out


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("command", ["run", "evaluate"])
def test_a_folder_states_what_produced_its_results(stario, recording, tmp_path, command):
    (tmp_path / "slow.toml").write_text("[filter]\nupdate_rate = 2\n")
    options = "--axes", "x,y,z", "--accel-sign", "up", "--config", "slow.toml"
    done = stario(command, recording, *options, "--out", "out")
    assert done.code == 0, done.err
    assert read_config(tmp_path / "out/config.json") == read_config(tmp_path / "slow.toml")
    origin = json.loads((tmp_path / "out/run.json").read_text())
    assert datetime.fromisoformat(origin.pop("date")).utcoffset() == timedelta()
    assert origin == {
        "stario": version("stario-nav"),
        "model": "default",
        "weights_sha256": load_model("default").card.sha256,
        "inputs": [str(recording)],
        "reading": {},
        "fixes": None,
    }


@pytest.mark.usefixtures("no_figures")
def test_run_accepts_a_folder_or_a_list_and_explains_figures_once(stario, recording, tmp_path):
    (tmp_path / "all").mkdir()
    for name in ("a", "b"):
        (tmp_path / "all" / f"{name}.csv").write_bytes(recording.read_bytes())
    done = stario("run", "all", "--out", "out", "--explain")
    assert done.code == 0
    assert done.out.count("\nfitted [m]: ATE after") == 1
    assert done.out.count("m rms from the truth") == 2
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"a", "b"}
    (tmp_path / "list.txt").write_text("all/b.csv\nall/c.csv\n")
    done = stario("run", "list.txt", "--out", "alone", "--json", "--explain")
    assert done.code == 1
    assert json.loads(done.out)["recording"] == "b"
    assert "skipped" in done.err
    assert "all/c.csv" in done.err
    assert (tmp_path / "alone/track.tum").exists()


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("command", ["run", "evaluate", "convert"])
def test_every_command_accepts_units_axes_and_gravity(stario, recording, tmp_path, command):
    walk = with_axes(read_generic_csv(recording), "-y,x,z")
    upright = walk.truth.at(walk.time).attitude_WB * Rotation.from_euler("z", -90, degrees=True)
    linear = walk.accel - upright.apply([0.0, 0.0, 9.80665], inverse=True)
    odd = replace(walk, gyro=np.degrees(walk.gyro), accel=linear / -9.80665)
    write_csv(tmp_path / "odd.csv", odd)
    target = ["out.csv"] if command == "convert" else []
    stario(command, "odd.csv", *target).assert_one_line_error()
    flags = ["--gyro-unit", "deg/s", "--accel-unit=-g", "--axes", "y,-x,z", "--gravity", "removed"]
    done = stario(command, "odd.csv", *target, *flags)
    assert done.code == 0, done.err
    if command == "run":
        reading = json.loads((tmp_path / "runs/odd/run.json").read_text())["reading"]
        assert reading["gyro_unit"] == "deg/s"


def test_inspect_names_the_option_that_helps(stario, recording, tmp_path, request):
    walk = read_generic_csv(recording)
    write_csv(tmp_path / "g.csv", replace(walk, accel=walk.accel / 9.80665))
    done = stario("inspect", "g.csv", "--out", "out")
    assert done.code == 0
    assert "--accel-unit g" in done.out
    assert (tmp_path / "out/inspection.png").stat().st_size > 10_000
    request.getfixturevalue("no_figures")
    corrected = json.loads(stario("inspect", "g.csv", "--accel-unit", "g", "--json").out)
    assert all(each["code"] != "refused" for each in corrected["verdict"])
    assert corrected == json.loads((tmp_path / "runs/g/inspection.json").read_text())
    assert corrected["rate_hz"] == pytest.approx(100.0)


@pytest.mark.usefixtures("no_figures")
def test_run_writes_files_for_a_map_where_the_place_is_known(stario, recording, caplog):
    done = stario("run", recording, "--origin=-33.86,151.21,90", "--out", "r")
    assert done.code == 0, done.err
    line = json.loads(Path("r/track.geojson").read_text())["features"][0]
    assert line["geometry"]["coordinates"][0] == pytest.approx([151.21, -33.86], abs=1e-4)
    assert Path("r/track.gpx").read_text().startswith("<?xml")
    assert json.loads(Path("r/config.json").read_text())["place"]["origin"] == [-33.86, 151.21, 90]
    assert stario("run", recording, "--satellites", "use", "--out", "r").code == 0
    assert not Path("r/track.gpx").exists()  # nothing places this run on the earth
    assert "no satellite position is used" in caplog.text
