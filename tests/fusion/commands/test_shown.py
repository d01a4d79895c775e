import json
import logging
import socket
import sys
from itertools import count

import numpy as np
import pytest
from phone_exports import export

from stario.fusion.commands.common import training_progress
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.generic_csv import read_generic_csv

TRACK_LABELS = ("dead reckoning (IMU alone)", "network alone", "StarIO", "truth")


def test_run_writes_a_report_and_the_filters_track(stario, recording, tmp_path, no_figures):
    done = stario("run", recording, "--out", "told", "--report", "--filtered", "--json")
    found = json.loads(done.out)
    assert found["filtered"]["ate_m"] > 0.0
    assert found["summary"]["length_m"] > found["summary"]["end_m"] > 0.0
    assert found["summary"]["final_sigma"]["position_m"] > 0.0
    times = [np.load(tmp_path / "told" / f"{name}.npz")["time"] for name in ("track", "filtered")]
    np.testing.assert_array_equal(*times)
    text = (tmp_path / "told/report.html").read_text()
    assert "<h1>walk</h1>" in text
    assert "filter, as in a stream" in text
    assert "Accuracy against ground truth" in text
    assert "in x and y only" in text


def test_a_warning_of_a_file_is_shown_once(stario, recording, tmp_path, monkeypatch):
    export("androsensor", tmp_path, read_generic_csv(recording))
    (file,) = tmp_path.glob("*AndroSensor.csv")
    file.write_text(file.read_text()[:-9])
    monkeypatch.setattr(logging.root, "handlers", [])
    done = stario("convert", file, "out.csv")
    assert done.code == 0
    assert done.err.count("skipped the last row") == 1


def test_compare_writes_a_report_of_what_is_known(stario, recording, no_figures, tmp_path):
    write_csv(tmp_path / "blind.csv", read_generic_csv(recording).without_truth())
    tracks = ("--report", "--tracks", "network")
    printed = stario("compare", recording, "--out", "told", *tracks, "--json").out
    assert json.loads(printed) == json.loads((tmp_path / "told/metrics.json").read_text())
    told = stario("compare", "blind.csv", "--out", "told", *tracks).out
    assert "ATE" not in told
    assert "NIS" in told
    for name, labels in (
        ("walk", {"dead reckoning (IMU alone)", "network alone", "StarIO", "truth"}),
        ("blind", {"network alone", "StarIO"}),  # without truth the map leaves the IMU alone out
    ):
        text = (tmp_path / "told" / name / "report.html").read_text()
        assert {label for label in TRACK_LABELS if f"</svg>{label}</button>" in text} == labels
        assert "filter, as in a stream" not in text
        assert ("Accuracy against ground truth" in text) == ("truth" in labels)


def test_view_writes_a_file_and_opens_it(stario, recording, tmp_path, no_figures, monkeypatch):
    pytest.importorskip("rerun", reason="pip install '.[view]'")
    opened = []
    monkeypatch.setattr("stario.fusion.report.view.open_view", opened.append)
    assert stario("run", recording, "--out", "seen", "--view").code == 0
    assert [path.resolve() for path in opened] == [tmp_path / "seen/track.rrd"]
    assert (tmp_path / "seen/track.rrd").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("plotly", ("run", "walk.csv", "--report")),
        ("plotly", ("compare", "--report")),
        ("rerun", ("run", "walk.csv", "--view")),
        ("uvicorn", ("live",)),
    ],
)
def test_a_missing_extra_is_reported_first(stario, monkeypatch, package, arguments):
    monkeypatch.setitem(sys.modules, package, None)  # as if its extra were not installed
    stario(*arguments).assert_one_line_error(package, "not installed", "pip install")


def test_live_refuses_a_port_in_use(stario):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        stario("live", "--port", port).assert_one_line_error("port", "--port")


def test_training_without_a_terminal_tells_its_progress_and_the_time_left(monkeypatch, capsys):
    clock = count(0.0, 4.0)
    monkeypatch.setattr("stario.fusion.commands.common.monotonic", lambda: next(clock))
    with training_progress(100) as progress:
        for step in range(1, 8):
            progress(step, 0.05)
    lines = capsys.readouterr().err.split("\n")
    assert lines[0] == "step 3 of 100, about 06:28 left, error 0.0500 m^2"
    assert [line.split()[1] for line in lines if line.startswith("step")] == ["3", "6"]
