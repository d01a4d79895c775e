"""Names of the cache's files: what they depend on."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stario.sequences.datasets import cache_files
from stario.sequences.datasets.cache_files import cache_folder, code_files, recording_files
from stario.sequences.readers import write_csv
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import generate_walk

WALK = simulate_imu(generate_walk(6, 2.0), 100.0, seed=4, name="walk")


def test_the_files_of_a_recording_are_those_that_are_read(tmp_path: Path) -> None:
    """Changing a neighbouring file must trigger a rebuild only if the recording reads it."""
    mav = tmp_path / "room" / "mav0"
    for name in ("imu0", "mocap0"):
        (mav / name).mkdir(parents=True)
        (mav / name / "data.csv").write_text("0,0,0,0,0,0,9.8\n")
    both = [mav / "imu0/data.csv", mav / "mocap0/data.csv"]
    for path in (tmp_path / "room", mav, mav / "imu0/data.csv"):
        assert recording_files(path) == both
    syn = tmp_path / "data1" / "syn"
    syn.mkdir(parents=True)
    row = ",".join(["0"] * 7 + ["0", "0", "1"] + ["0"] * 6)
    for name in ("imu1", "vi1", "imu2", "vi2"):
        (syn / f"{name}.csv").write_text(row + "\n")
    assert recording_files(syn / "imu2.csv") == [syn / "imu2.csv", syn / "vi2.csv"]
    raw, tango = tmp_path / "floor1" / "raw", tmp_path / "floor1" / "tango"
    for folder, name in ((raw, "imu1"), (tango, "tango1"), (tango, "tango2")):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.csv").write_text(row + "\n")
    assert recording_files(raw / "imu1.csv") == [raw / "imu1.csv", tango / "tango1.csv"]
    for name in ("a", "b"):
        write_csv(tmp_path / f"{name}.csv", WALK)
    assert recording_files(tmp_path / "a.csv") == [tmp_path / "a.csv"]


def test_the_cache_folder_is_set_by_environment_variables(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("STARIO_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("STARIO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "stario"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "stario"


def test_readers_levelling_windows_and_simulation_are_part_of_the_code() -> None:
    names = {"/".join(file.parts[-2:]) for file in code_files()}
    assert {
        "sequences/windows.py",
        "readers/generic_csv.py",
        "attitude/levelling.py",
        "simulation/imu.py",
        "datasets/array_cache.py",
    } <= names


def test_figures_and_metrics_are_not_and_nothing_in_the_code_imports_them() -> None:
    """A changed figure must not cost the windows of 100 hours of recordings."""
    names = {"/".join(file.parts[-2:]) for file in code_files()}
    assert not {"drawing/plots.py", "accuracy/metrics.py", "inspection/report.py"} & names
    unused = "|".join(
        re.escape(part.removesuffix(".py").rstrip("/").replace("/", "."))
        for part in cache_files._UNRELATED
    )
    for file in code_files():
        assert not re.search(rf"stario\.sequences\.({unused})\b", file.read_text("utf-8")), file
