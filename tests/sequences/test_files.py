import errno
import json
import os
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stario.sequences.errors import ConfigError, InputError, ReadError, StarioError, WeightsError
from stario.sequences.files import atomic_folder, atomic_write, write_json, write_npz
from stario.sequences.findings import TOO_EARLY, Finding, verdict


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_exception_leaves_only_the_old_file(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")

    def write_and_fail():
        with atomic_write(path) as file:
            file.write("new, half ")
            file.flush()
            assert path.read_text() == "old"  # the partial file is not visible
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_and_fail()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["result.txt"]


@pytest.mark.parametrize(("mode", "content"), [("w", "new\n"), ("wb", b"\x00\r\n")])
def test_a_finished_file_replaces_the_old_one(tmp_path, mode, content):
    path = tmp_path / "result"
    path.write_text("old")
    with atomic_write(path, mode) as file:
        file.write(content)
    assert path.read_bytes() == (content if mode == "wb" else content.encode())
    assert names(tmp_path) == ["result"]


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_permissions_are_those_of_new_files_links_stay_and_so_does_what_is_no_file(tmp_path):
    (tmp_path / "plain").write_text("")
    with atomic_write(tmp_path / "atomic") as file:
        file.write("")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    with atomic_write(tmp_path / "link") as file:
        file.write("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="device or pipe"), atomic_write(tmp_path / "pipe"):
        pass
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("write", [atomic_write, atomic_folder])
def test_an_operating_system_error_names_path_reason_and_fix(tmp_path, write):
    long = tmp_path / ("x" * 300)
    words = f"path: .*{long.name}: File name too long.*another folder"
    with pytest.raises(InputError, match=words), write(long):
        pass

    with pytest.raises(InputError, match="existing folder"), write(tmp_path / "no" / "f"):
        pass

    def fill():
        with write(tmp_path / "full") as file:
            if isinstance(file, Path):
                (file / "half").touch()
            assert not (tmp_path / "full").exists()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(InputError, match="full: No space left on device"):
        fill()
    assert names(tmp_path) == []


@dataclass
class Sample:
    value: float
    where: Path


def test_json_keeps_order_and_writes_nan_as_null_or_leaves_the_old_file(tmp_path):
    path = tmp_path / "metrics.json"
    values = {
        "z": (np.float32(0.5), 0.5),
        "a": (
            [float("nan"), np.float64("inf"), np.int64(3), True, None],
            [None, None, 3, True, None],
        ),
        "array": (np.array([[1.0, np.nan]]), [[1.0, None]]),
        "sample": (Sample(1.5, Path("x")), {"value": 1.5, "where": "x"}),
    }
    write_json(path, {name: given for name, (given, _) in values.items()})
    text = path.read_text()
    assert list(json.loads(text).items()) == [(name, read) for name, (_, read) in values.items()]
    assert "NaN" not in text
    assert text.endswith("}\n")
    path = tmp_path / "metrics.json"
    write_json(path, {"a": 1})
    with pytest.raises(InputError, match="found set"):
        write_json(path, {"a": {1, 2}})
    assert json.loads(path.read_text()) == {"a": 1}


def test_npz_round_trip_at_the_given_name_without_pickles(tmp_path):
    path = tmp_path / "track"  # numpy alone would add .npz to the name
    write_npz(path, time=np.arange(4.0), name=np.array("ekf"), valid=np.array([True, False]))
    with np.load(path, allow_pickle=False) as found:
        np.testing.assert_array_equal(found["time"], np.arange(4.0))
        assert str(found["name"]) == "ekf"
        assert found["valid"].dtype == np.bool_
    with pytest.raises(InputError, match="thing: found dtype object"):
        write_npz(path, thing=np.array([None, {}], dtype=object))
    assert names(tmp_path) == ["track"]


# --- findings and errors, as they are told and passed on ------------------------------------------


def codes(*findings: Finding) -> list[str]:
    return [finding.code for finding in verdict(findings)]


NOTE = Finding("gaps", "1 gap.", level="note")
AXES = Finding("gyro_axes", "gyroscope: differs", "turn it", values={"tilts": 7})


def test_a_verdict_tells_one_fault_once_and_nothing_to_do_only_if_nothing_was_found():
    assert codes() == ["nothing"]
    assert codes(NOTE) == ["nothing", "gaps"]
    assert codes(NOTE, AXES) == ["gyro_axes", "gaps"]
    assert codes(Finding(TOO_EARLY, "Too early.", level="note")) == [TOO_EARLY]
    again = Finding("gyro_axes", "another inspection of the same")
    follows = Finding("network_contradicts", "30% of the displacements contradict the IMU.")
    assert verdict([AXES, again, follows]) == [AXES]
    assert codes(follows) == ["network_contradicts"]
    assert AXES.line() == "! gyroscope: differs: turn it"
    assert NOTE.line() == "  1 gap."
    assert str(Finding("gaps", "1 gap.", "Log on.")) == "1 gap. Log on."


@pytest.mark.parametrize(
    "error",
    [
        StarioError("text"),
        InputError("field", "found", "expected", "fix"),
        ConfigError("field", "found", "expected"),
        ReadError(Path("a.csv"), "field", "found", "expected"),
        WeightsError("a.safetensors", "field", "found", "expected", "fix"),
    ],
)
@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_errors_survive_pickling_unchanged(error, protocol):
    again = pickle.loads(pickle.dumps(error, protocol))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
