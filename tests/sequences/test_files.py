"""Files are written completely or not at all, and are read back as written."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.errors import InputError, ReadError
from stario.sequences.files import (
    atomic_folder,
    atomic_write,
    read_tum,
    write_json,
    write_npz,
    write_tum,
)
from stario.sequences.sequence import Trajectory


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def track(n: int = 50, start: float = 0.0, seed: int = 1) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        time=start + np.cumsum(rng.uniform(0.005, 0.02, n)),
        position_W=rng.normal(0, 100, (n, 3)),
        attitude_WB=Rotation.random(n, rng=rng),
    )


def test_an_exception_leaves_only_the_old_file(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")

    def write_and_fail() -> None:
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
def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_text("")
    with atomic_write(tmp_path / "atomic") as file:
        file.write("")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="existing folder"), atomic_write(tmp_path / "no" / "f"):
        pass
    assert names(tmp_path) == []


@pytest.mark.parametrize("write", [atomic_write, atomic_folder])
def test_an_operating_system_error_names_path_reason_and_fix(tmp_path, write):
    long = tmp_path / ("x" * 300)
    expected = rf"path: found .*{long.name}: File name too long, expected .*; choose another folder"
    with pytest.raises(InputError, match=expected), write(long):
        pass

    def fill() -> None:
        with write(tmp_path / "full"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(InputError, match="full: No space left on device"):
        fill()
    assert names(tmp_path) == []


@pytest.mark.parametrize("start", [0.0, 1.6e9])
def test_tum_round_trip(tmp_path, start):
    original = track(start=start)
    write_tum(tmp_path / "track.tum", original)
    found = read_tum(tmp_path / "track.tum")
    np.testing.assert_allclose(found.time, original.time, rtol=0, atol=1e-9 + start * 1e-15)
    np.testing.assert_allclose(found.position_W, original.position_W, rtol=0, atol=1e-9)
    turn = (found.attitude_WB * original.attitude_WB.inv()).magnitude()
    assert turn.max() < 5e-9


def test_tum_lines_are_what_other_tools_expect(tmp_path):
    path = tmp_path / "track.tum"
    upright = Rotation.from_quat([[0, 0, np.sin(0.5), np.cos(0.5)]] * 2)
    write_tum(path, Trajectory(np.array([0.0, 0.5]), np.array([[1, 2, 3], [4, 5, 6.0]]), upright))
    assert path.read_bytes().split(b"\n")[:2] == [
        b"0.000000000 1.000000000 2.000000000 3.000000000 "
        b"0.000000000 0.000000000 0.479425539 0.877582562",
        b"0.500000000 4.000000000 5.000000000 6.000000000 "
        b"0.000000000 0.000000000 0.479425539 0.877582562",
    ]


def test_tum_files_omit_invalid_poses(tmp_path):
    whole = track(10)
    valid = np.arange(10) % 3 != 0
    position = np.where(valid[:, None], whole.position_W, np.nan)
    write_tum(tmp_path / "t", Trajectory(whole.time, position, whole.attitude_WB, valid=valid))
    assert len(read_tum(tmp_path / "t")) == valid.sum()
    with pytest.raises(InputError, match="no valid pose"):
        write_tum(
            tmp_path / "none",
            Trajectory(whole.time, position, whole.attitude_WB, valid=np.arange(10) < 0),
        )


GOOD = "{t} 1 2 3 0 0 0 1"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 1 2 3 0 0 0", r"line 4: found 7 values, expected 8: t x y z"),
        ("1,1,2,3,0,0,0,1", r"line 4: found 1 values"),
        ("1 1 two 3 0 0 0 1", r"line 4, y: found 'two'"),
        ("1 1 2 nan 0 0 0 1", r"line 4, z: found 'nan'"),
        ("0.5 1 2 3 0 0 0 1", r"line 4, t: found 0\.5 after 0\.5"),
        ("1 1 2 3 0 0 0 0", r"line 4, qx qy qz qw: found norm 0"),
    ],
)
def test_a_bad_tum_line_is_named(tmp_path, line, message):
    path = tmp_path / "track.tum"
    rows = ["# t x y z qx qy qz qw", "", GOOD.format(t=0.5), line, GOOD.format(t=2)]
    path.write_text("\n".join(rows))
    with pytest.raises(ReadError, match=message) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)


def test_a_tum_file_that_is_missing_empty_or_binary_is_named(tmp_path):
    (tmp_path / "empty").write_text("# nothing\n")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("missing", "empty", "binary"):
        with pytest.raises(ReadError, match=f"{name}: file"):
            read_tum(tmp_path / name)


@dataclass
class Sample:
    value: float
    where: Path


def test_json_keeps_order_and_writes_nan_as_null(tmp_path):
    path = tmp_path / "metrics.json"
    write_json(
        path,
        {
            "z": np.float32(0.5),
            "a": [float("nan"), np.float64("inf"), np.int64(3), True, None],
            "array": np.array([[1.0, np.nan]]),
            "sample": Sample(1.5, Path("x")),
        },
    )
    text = path.read_text()
    assert list(json.loads(text)) == ["z", "a", "array", "sample"]
    assert json.loads(text) == {
        "z": 0.5,
        "a": [None, None, 3, True, None],
        "array": [[1.0, None]],
        "sample": {"value": 1.5, "where": "x"},
    }
    assert "NaN" not in text
    assert text.endswith("}\n")


def test_json_that_cannot_be_written_leaves_the_old_file_unchanged(tmp_path):
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
