import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.sequences import PositionTrack, write_csv
from stario.sequences.readers.archive import write_archive
from stario.sequences.readers.generic_csv import read_generic_csv


@pytest.mark.usefixtures("no_figures")
def test_a_wrong_unit_or_sign_is_refused_with_the_option_that_helps(stario, recording, tmp_path):
    sequence = read_generic_csv(recording)
    for field, factor, option, truth in (
        ("gyro", 180.0 / np.pi, "--gyro-unit deg/s", sequence.truth),
        ("gyro", 180.0 / np.pi, "--gyro-unit deg/s", None),
        ("accel", 1.0 / 9.80665, "--accel-unit g", sequence.truth),
        ("accel", -1.0, "--accel-sign apple", sequence.truth),
    ):
        odd = {field: factor * getattr(sequence, field)}
        write_csv(tmp_path / "odd.csv", replace(sequence, truth=truth, **odd))
        stario("run", "odd.csv", "--out", "out").assert_one_line_error(option)
        assert not (tmp_path / "out").exists()
    assert stario("run", "odd.csv", "--out", "out", *option.split()).code == 0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["broken.csv"]),
        (b"t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n0.01,0,0\n", ["line 3", "cut short"]),
        (b"t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n", ["broken", "at least"]),
    ],
)
def test_a_broken_file_is_named_in_one_line(stario, tmp_path, content, words):
    (tmp_path / "broken.csv").write_bytes(content)
    stario("run", "broken.csv").assert_one_line_error(*words)
    assert list(tmp_path.iterdir()) == [tmp_path / "broken.csv"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "missing.csv"], ["missing.csv", "no such file"]),
        (["evaluate", "--data", "missing"], ["missing", "--data"]),
        (["evaluate", "--data", ".", "--split", "practice"], ["split", "practice"]),
        (["evaluate"], ["PATH", "--data"]),
        (["evaluate", "--data", ".", "--where", "person=dan"], ["--where", "--data"]),
        (["evaluate", "RECORDING", "--against", "default"], ["--against", "--by"]),
        (["run", "RECORDING", "--format", "fax"], ["format", "fax"]),
        (["run", "RECORDING", "--gyro-unit", "rpm"], [".csv: --gyro-unit: found 'rpm'"]),
        (["inspect", "RECORDING", "--axes=x,y"], [".csv: --axes: found 'x,y'"]),
        (["inspect", "RECORDING", "--imu-topic", "/imu"], [".csv: --imu-topic: found"]),
        (["convert", "RECORDING", "a.csv", "--to", "fax"], ["layout", "fax"]),
        (["convert", "RECORDING", "no/such/a.csv"], ["folder"]),
        (["convert", "RECORDING", "walk.txt"], [".txt", ".csv, .h5", "--to"]),
        (["live", "--port", "0", "--phyphox", "file:///etc/passwd"], ["phyphox"]),
        (["run", "RECORDING", "--origin", "11.5"], ["--origin"]),
        (["run", "RECORDING", "--satellites", "yes"], ["--satellites"]),
        (["run", "RECORDING", "--waypoints", "no"], ["--waypoints"]),
        (["run", "RECORDING", "--out", "RECORDING"], ["found a file, expected a folder"]),
        (["live", "--out", "RECORDING"], ["found a file, expected a folder"]),
        (["train", "--start-from", "open", "--config", "no.json"], ["no.json: found no such"]),
        (
            ["run", "RECORDING", "--model", "nothere"],  # the error names the known weights
            ["nothere", "default, first-stage, open or walks-36min"],
        ),
        (["run", "RECORDING", "--config", "."], [".", "TOML or JSON"]),
        (["simulate", "a.csv", "--seconds", "1e9"], ["duration", "10000 s at 200 Hz"]),
        (["simulate", "a.h5"], ["a.h5", ".csv", "convert"]),
        (["convert", "RECORDING", "a.h5", "--to", "csv"], ["a.h5", "csv"]),
        (["train", "--config", "missing.json"], ["missing.json"]),
        (["train"], ["PATH", "--data"]),
        (["train", "--data", ".", "--where", "person=dan"], ["--where: found use with --data"]),
        (["train", "--generated", "1", "--out", "RECORDING"], ["folder"]),
    ],
)
def test_invalid_arguments_give_a_one_line_error(stario, recording, arguments, words):
    done = stario(*(recording if word == "RECORDING" else word for word in arguments))
    done.assert_one_line_error(*words)
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("compare --gyro-unit deg/s", "--gyro-unit without PATH"),
        ("inspect RECORDING --format csv --where person=dan", "--where --format"),
        ("evaluate RECORDING --data .", "--data with PATH"),
        ("evaluate RECORDING --split validation", "--split without --data"),
        ("evaluate RECORDING --by set --no-magnetometer", "--no-magnetometer with --by"),
        ("check fusion --model open", "--model simulated"),
        ("check fusion --by carry", "--by simulated"),
        ("check fusion RECORDING --walks 3", "--walks recordings"),
        ("check faults RECORDING --model open", "--model without --network"),
        ("check faults --no-magnetometer", "--no-magnetometer simulated"),
        ("check faults --axes y,-x,z", "--axes simulated"),
        ("check faults RECORDING --where person=dan", "--where one recording"),
        ("check moments --axes y,-x,z", "--axes simulated"),
        ("check table --out cells --set a=. --sets oxiod", "--sets without --data"),
        ("run RECORDING --declination 5 --no-magnetometer", "--declination --no-magnetometer"),
        ("train RECORDING --recorded-only --generated 5", "--generated with --recorded-only"),
        ("train --generated 1 --gyro-unit deg/s", "--gyro-unit without recordings"),
        ("train RECORDING --leave-out ridi", "--leave-out without --data"),
        ("simulate a.csv --body RECORDING --seconds 5", "--seconds with --body"),
        ("train RECORDING --learn-from few", "--learn-from without --data"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(stario, recording, tmp_path, arguments, words):
    given = (recording if word == "RECORDING" else word for word in arguments.split())
    stario(*given).assert_one_line_error(*words.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "content", "named"),
    [
        ("compare", '{"filter": {"speed": 1}}', "settings.json: filter.speed"),
        ("run", "{", "settings.json"),
        ("train", '{"speed": 1}', "settings.json: speed"),
        ("train", '{"epochs": 0}', "settings.json: epochs"),
    ],
)
def test_an_invalid_setting_is_named_in_one_line(stario, recording, command, content, named):
    Path("settings.json").write_text(content)
    stario(command, recording, "--config", "settings.json").assert_one_line_error(named)


@pytest.mark.parametrize("command", ["convert RECORDING", "simulate"])
def test_no_file_is_overwritten_without_the_option(stario, recording, tmp_path, command):
    there = tmp_path / "there.csv"
    there.write_text("mine")
    call = [recording if word == "RECORDING" else word for word in command.split()]
    call += [there, *(["--seconds", 5] if command == "simulate" else [])]
    stario(*call).assert_one_line_error("already exists", "--overwrite")
    assert there.read_text() == "mine"
    assert stario(*call, "--overwrite").code == 0
    assert len(read_generic_csv(there)) > 1000


def test_no_input_is_overwritten(stario, recording):
    before = recording.read_bytes()
    for options in ([], ["--overwrite"]):
        stario("convert", recording, recording, *options).assert_one_line_error("also an input")
    assert recording.read_bytes() == before
    assert stario("convert", recording, "two.h5").code == 0
    before = Path("two.h5").read_bytes()
    for source in ("two.h5:walk", "."):
        stario("convert", source, "two.h5", "--overwrite").assert_one_line_error("also an input")
    assert Path("two.h5").read_bytes() == before


@pytest.mark.usefixtures("no_figures")
def test_a_declination_without_a_source_of_north_is_reported(stario, recording):
    done = stario("run", recording, "--declination", "-6", "--out", "north")
    assert done.code == 0
    assert "north" in done.out
    assert "nothing to do" not in done.out


@pytest.mark.parametrize(("command", "where"), [("train", "all.h5"), ("evaluate", "list.txt")])
def test_a_missing_package_ends_a_batch(stario, recording, tmp_path, monkeypatch, command, where):
    write_archive(tmp_path / "all.h5", [read_generic_csv(recording)])
    (tmp_path / "list.txt").write_text("all.h5:walk\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    done = stario(command, recording, where, "--out", "out")
    done.assert_one_line_error("h5py", "not installed", "pip install 'h5py>=3")


def test_waypoints_alone_cannot_be_all_recorded_data(stario, recording, tmp_path):
    sequence = read_generic_csv(recording)
    truth = sequence.truth
    legs = slice(None, None, len(truth) // 8)
    known = PositionTrack(truth.time[legs], truth.position_W[legs], "waypoints")
    write_csv(tmp_path / "legs.csv", replace(sequence, truth=None, positions=known))
    done = stario("train", "legs.csv", "--validation", recording, "--recorded-only", "--out", "o")
    done.assert_one_line_error("omit --recorded-only")
