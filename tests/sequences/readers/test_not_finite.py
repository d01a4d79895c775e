import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import published_formats as formats
import pytest

from stario.sequences import InputError, ReadError, read_recording
from stario.sequences.clean_samples import clean_samples

Damage = Callable[[Path, list[int]], None]
ROW = 500
"""A row to damage."""


def in_lines(name: str, change: Callable[[str], str]) -> Damage:
    def damage(path: Path, rows: list[int]) -> None:
        file = path / name if name else path
        lines = file.read_text().splitlines()
        for k in rows:
            lines[k + 1] = change(lines[k + 1])
        file.write_text("\n".join(lines))

    return damage


def in_hdf5(path: Path, rows: list[int]) -> None:
    import h5py

    with h5py.File(path / "data.hdf5", "a") as data:
        data["synced/gyro_uncalib"][rows] = np.full((len(rows), 3), np.nan)


DAMAGES: dict[str, Damage] = {
    "ronin": in_hdf5,
    "ridi": in_lines(
        "processed/data.csv", lambda row: re.sub(r"^(([^,]*,){6})[^,]*", r"\1nan", row)
    ),
    "imunet raw": in_lines("gyro.txt", lambda row: row.split()[0] + " nan nan nan"),
    "tlio raw": in_lines("", lambda row: row.rsplit(",", 1)[0] + ",nan"),
}


@pytest.mark.parametrize("name", list(DAMAGES))
def test_a_row_that_is_not_finite_is_dropped_and_a_file_of_most_is_refused(
    tmp_path, walks, caplog, name
):
    _, rate, write = formats.WRITERS[name]
    path = write(tmp_path / "7", walks(rate)).path
    whole = read_recording(path)
    DAMAGES[name](path, [ROW])
    read = read_recording(path)
    assert len(read) == len(whole) - 1
    same = np.searchsorted(whole.time, read.time - 1e-6)
    np.testing.assert_allclose(read.time, whole.time[same], atol=1e-9)
    np.testing.assert_allclose(read.gyro, whole.gyro[same], atol=1e-9)
    np.testing.assert_allclose(read.accel, whole.accel[same], atol=1e-9)
    assert len(read.truth) >= len(whole.truth) - 1
    pose = np.searchsorted(whole.truth.time, read.truth.time - 1e-6)
    off = read.truth.attitude_WB.inv() * whole.truth.attitude_WB[pose]
    assert off.magnitude().max() < 1e-6
    assert "dropped 1 of" in caplog.text
    DAMAGES[name](path, list(range(int(0.7 * len(whole)))))
    with pytest.raises(ReadError, match=r"found \d+ of \d+ rows that are not finite"):
        read_recording(path)


def test_the_rows_before_the_start_frame_may_be_damaged(tmp_path, walks):
    path = formats.ronin(tmp_path / "a000_1", walks(200.0)).path
    whole = read_recording(path)
    in_hdf5(path, [20, 99, 100])
    read = read_recording(path)
    np.testing.assert_allclose(read.gyro, whole.gyro[1:], atol=1e-9)


@pytest.mark.parametrize("part", ["gyro", "position"])
def test_a_message_of_a_bag_that_is_not_finite_is_left_out(tmp_path, caplog, part):
    walk = formats.walk_of(100.0, 2.0)
    path = formats.bag(tmp_path / "b", walk)
    truth = walk.truth
    value = walk.gyro[20, 1] if part == "gyro" else truth.position_W[20, 0]
    nan = struct.pack("<d", np.nan)
    path.write_bytes(path.read_bytes().replace(struct.pack("<d", value), nan))
    read = read_recording(path)
    assert len(read) == len(walk)  # samples that are not finite are kept, for users to count
    assert np.flatnonzero(np.isnan(read.gyro)).tolist() == ([61] if part == "gyro" else [])
    assert len(clean_samples(read)[0]) == len(walk) - (part == "gyro")
    assert len(read.truth) == len(truth) - (part == "position")
    assert ("/odom: dropped 1 of 201" if part == "position" else "dropped: 1 of 201") in caplog.text


def test_a_rate_that_missing_samples_make_too_low_says_so(walks):
    walk = walks(200.0)
    kept = np.arange(len(walk)) % 5 == 0
    walk = replace(walk, gyro=np.where(kept[:, None], walk.gyro, np.nan))
    with pytest.raises(InputError, match=r"found 40.0 Hz, .*most samples are not finite"):
        clean_samples(walk)
