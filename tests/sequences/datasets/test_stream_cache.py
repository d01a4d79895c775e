import mmap
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.sequences import ImuSequence, Skipped, generate_walk, simulate_imu
from stario.sequences.datasets import stream_cache
from stario.sequences.datasets.stream_cache import (
    cache_folder,
    cached,
    code_files,
    recorded,
    recording_files,
)
from stario.sequences.readers import find_recordings, read_recording, write_csv
from stario.sequences.readers.archive import write_archive
from stario.sequences.windows import WorldStream, world_streams

WALK = simulate_imu(generate_walk(6, 9.0), 100.0, seed=4, name="walk")


class Reader:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, path: Path) -> ImuSequence:
        self.calls += 1
        return read_recording(path)


@pytest.fixture
def recording(tmp_path):
    """A walk whose ground truth has a gap, so that it gives two streams."""
    truth = WALK.truth
    gap = (truth.time > 4.0) & (truth.time < 4.5)
    path = tmp_path / "walk.csv"
    write_csv(path, replace(WALK, truth=replace(truth, valid=~gap)))
    return path


def streams_of(
    path: Path, folder: Path, read: Callable[[Path], ImuSequence], **options: object
) -> list[WorldStream]:
    (streams,) = recorded([path], read, options, folder)
    return streams


def assert_equal(found: list[WorldStream], expected: list[WorldStream]) -> None:
    assert [s.name for s in found] == [s.name for s in expected]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.imu_W, b.imu_W)
        np.testing.assert_array_equal(a.position_W, b.position_W)
        assert a.imu_W.dtype == a.position_W.dtype == np.float32


def map_of(array: np.ndarray) -> object:
    """The file mapped into memory that holds an array, or something else."""
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base


def is_mapped(array: np.ndarray) -> bool:
    return isinstance(map_of(array), mmap.mmap)


def test_cached_streams_equal_built_streams(recording, tmp_path):
    read = Reader()
    expected = world_streams(read_recording(recording))
    assert len(expected) == 2
    for _ in range(3):
        found = streams_of(recording, tmp_path / "cache", read)
        assert_equal(found, expected)
        assert all(is_mapped(s.imu_W) and is_mapped(s.position_W) for s in found)
    assert read.calls == 1


def test_more_recordings_are_mapped_than_a_process_may_open_files(recording, tmp_path):
    """Each map keeps a file open; a recording has a single one."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.dup(0)  # descriptors are numbered from below
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest + 20, limits[1]))
    try:
        kept = [
            streams_of(recording, tmp_path / "cache", lambda _: WALK, number=k) for k in range(24)
        ]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert all(is_mapped(s.imu_W) for streams in kept for s in streams)
    assert all(map_of(s.imu_W) is map_of(s.position_W) for streams in kept for s in streams)


def test_changed_content_options_or_code_change_the_key(recording, tmp_path, monkeypatch):
    read, folder = Reader(), tmp_path / "cache"
    streams_of(recording, folder, read)
    streams_of(recording, folder, read, axes="y,-x,z")
    assert read.calls == 2
    streams_of(recording, folder, read)
    assert read.calls == 2
    write_csv(recording, WALK.slice(0.0, 5.0))
    assert len(streams_of(recording, folder, read)) == 1
    assert read.calls == 3
    os.utime(recording, ns=(0, 0))
    streams_of(recording, folder, read)
    assert read.calls == 4
    monkeypatch.setattr(stream_cache, "_code", lambda: "later")
    streams_of(recording, folder, read)
    assert read.calls == 5


@pytest.mark.parametrize("damage", ["cut", "header", "empty", "noise", "longer"])
def test_a_damaged_cache_file_is_rebuilt(recording, tmp_path, damage, caplog):
    read, folder = Reader(), tmp_path / "cache"
    expected = world_streams(read_recording(recording))
    streams_of(recording, folder, read)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    broken = {
        "cut": whole[: len(whole) // 2],
        "header": whole[:20],
        "empty": b"",
        "noise": b"\xff" * 1000,
        "longer": whole + b"\0",
    }[damage]
    file.write_bytes(broken)
    assert_equal(streams_of(recording, folder, read), expected)
    assert read.calls == 2
    assert "incomplete" in caplog.text
    assert file.read_bytes() == whole


def test_concurrent_writers_do_not_interfere(recording, tmp_path):
    folder = tmp_path / "cache"
    expected = world_streams(read_recording(recording))
    with ThreadPoolExecutor(8) as pool:
        calls = [pool.submit(streams_of, recording, folder, Reader()) for _ in range(16)]
        for call in calls:
            assert_equal(call.result(), expected)
    assert len(list(folder.iterdir())) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals")
def test_a_killed_writer_leaves_nothing_that_is_read(recording, tmp_path):
    folder = tmp_path / "cache"
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from stario.sequences.readers import read_recording\n"
        "from stario.sequences.datasets.stream_cache import recorded\n"
        "os.fsync = lambda file: os.kill(os.getpid(), signal.SIGKILL)\n"
        "list(recorded([Path(sys.argv[1])], read_recording, {}, Path(sys.argv[2])))\n"
    )
    killed = subprocess.run([sys.executable, "-c", code, recording, folder])
    assert killed.returncode == -signal.SIGKILL
    (leftover,) = folder.iterdir()
    assert leftover.name.endswith(".tmp")
    read = Reader()
    assert_equal(streams_of(recording, folder, read), world_streams(read_recording(recording)))
    assert read.calls == 1
    # The next writer removes the leftover once it is certainly abandoned.
    os.utime(leftover, (0, 0))
    (whole,) = (p for p in folder.iterdir() if p != leftover)
    whole.unlink()
    streams_of(recording, folder, read)
    assert [p.name for p in folder.iterdir()] == [whole.name]


def test_without_a_writable_folder_streams_are_built_in_memory(recording, tmp_path, caplog):
    (tmp_path / "file").touch()
    streams = streams_of(recording, tmp_path / "file" / "cache", Reader())
    assert_equal(streams, world_streams(read_recording(recording)))
    assert "not kept" in caplog.text


def test_files_of_other_code_are_removed_once_nobody_uses_them(recording, tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    streams_of(recording, folder, Reader())
    (own,) = folder.iterdir()
    names = (own.name, "0-old.streams", "0-recent.streams", "notes.txt")
    for name in names:
        (folder / name).touch()
        os.utime(folder / name, (0, 0))
    os.utime(folder / "0-recent.streams", (time.time() - 29 * 86_400, 0))  # read, not written
    streams_of(recording, folder, Reader(), axes="y,-x,z")
    left = {file.name for file in folder.iterdir()}
    assert left & set(names) == {own.name, "0-recent.streams", "notes.txt"}
    assert len(left) == 4


def test_processes_return_memory_mapped_files(recording, tmp_path):
    paths = [recording, tmp_path / "missing.csv", recording]
    first, missing, second = recorded(paths, read_recording, {}, tmp_path / "cache", jobs=2)
    assert "missing.csv" in missing.reason
    for streams in (first, second):
        assert all(is_mapped(s.imu_W) for s in streams)


def test_recordings_unsuitable_for_training_are_skipped_with_the_reason(tmp_path):
    longer = simulate_imu(generate_walk(6, 20.0), 100.0, seed=4, name="walk")
    truth, of_longer = WALK.truth, longer.truth
    unsuitable = {
        "blind": WALK.without_truth(),
        "degrees": replace(WALK, gyro=np.degrees(WALK.gyro)),
        "short": replace(WALK, truth=truth.slice(1.0, 2.5)),
        "sparse": replace(WALK, truth=truth.at(truth.time[::20])),
        "in mm": replace(longer, truth=replace(of_longer, position_W=1e3 * of_longer.position_W)),
    }
    for name, sequence in unsuitable.items():
        write_csv(tmp_path / f"{name}.csv", sequence)
    paths = [tmp_path / f"{name}.csv" for name in unsuitable]
    outcomes = list(recorded(paths, read_recording, {}, tmp_path / "cache"))
    reasons = [outcome.reason for outcome in outcomes if isinstance(outcome, Skipped)]
    parts = ("truth", "--gyro-unit", "no unbroken stretch", "at 5 Hz; at least 10 Hz", "in mm")
    for reason, words in zip(reasons, parts, strict=True):
        assert words in reason


def test_built_streams_are_cached_by_key_and_those_of_an_archive_by_name(tmp_path):
    calls = []

    def build():
        calls.append(1)
        return world_streams(WALK)

    for seed in (1, 2, 1):
        assert_equal(cached({"seed": seed}, build, tmp_path), world_streams(WALK))
    assert len(calls) == 2
    assert cached({"seed": 3}, list, tmp_path) == []
    archive, read = tmp_path / "walks.h5", Reader()
    write_archive(archive, [WALK, WALK.slice(0.0, 5.0)])
    whole, part = find_recordings(archive)
    for _ in range(2):
        for path in (whole, part):
            (stream,) = streams_of(path, tmp_path / "cache", read)
            assert is_mapped(stream.imu_W)
    assert read.calls == 2
    write_archive(archive, [WALK.slice(0.0, 6.0)])
    streams_of(whole, tmp_path / "cache", read)
    assert read.calls == 3


WALK_FILE = WALK.slice(0.0, 2.0)


def test_the_files_of_a_recording_are_those_that_are_read(tmp_path):
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
        write_csv(tmp_path / f"{name}.csv", WALK_FILE)
    assert recording_files(tmp_path / "a.csv") == [tmp_path / "a.csv"]


def test_the_cache_folder_is_set_by_environment_variables(monkeypatch, tmp_path):
    monkeypatch.setenv("STARIO_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("STARIO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "stario"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "stario"


def test_the_code_is_all_that_windows_depend_on_and_no_more():
    """A changed figure must not cost the windows of 100 hours of recordings."""
    names = {"/".join(file.parts[-2:]) for file in code_files()}
    all_names = {file.as_posix().rsplit("/sequences/", 1)[1] for file in code_files()}
    assert {"sequences/windows.py", "readers/generic_csv.py", "attitude/levelling.py"} <= names
    assert "simulation/imu.py" in names
    assert not {"drawing/plots.py", "accuracy/metrics.py", "inspection/report.py"} & names
    for file in code_files():  # none of them imports another
        for part in re.findall(r"stario\.sequences\.([\w.]+) import", file.read_text("utf-8")):
            place = part.replace(".", "/")
            assert {f"{place}.py", f"{place}/__init__.py"} & all_names, file
