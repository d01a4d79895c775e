import re
import shutil
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import published_formats as formats
import pytest
from phone_exports import save

from stario.sequences import check_units, generate_walk, read_recording, simulate_imu, write_csv
from stario.sequences.clean_samples import clean_samples
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers import find_recordings
from stario.sequences.readers.archive import write_archive


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(3, 12.0), 100.0, seed=1, name="walk")


@pytest.fixture
def archive(walk, tmp_path):
    write_archive(tmp_path / "two.h5", [walk, replace(walk, name="other")])
    return tmp_path / "two.h5"


def test_flipped_bytes_in_an_archive_raise_input_errors_only_and_an_upper_case_suffix_none(
    archive, tmp_path
):
    data, rng = archive.read_bytes(), np.random.default_rng(0)
    damaged = tmp_path / "spoiled.h5"
    for _ in range(40):
        changed = bytearray(data)
        for place in rng.integers(0, len(data), 20):
            changed[place] ^= 0xFF
        damaged.write_bytes(changed)
        with suppress(InputError):
            for path in find_recordings(damaged):
                with suppress(InputError):
                    read_recording(path)
    shutil.copy(archive, tmp_path / "TWO.H5")
    paths = find_recordings(tmp_path / "TWO.H5")
    assert [read_recording(path).name for path in paths] == ["other", "walk"]


def test_a_damaged_zip_is_a_read_error(walk, tmp_path):
    write_csv(tmp_path / "walk.csv", walk)
    with zipfile.ZipFile(tmp_path / "walk.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.write(tmp_path / "walk.csv", "walk.csv")
    data, rng = (tmp_path / "walk.zip").read_bytes(), np.random.default_rng(0)
    for place in rng.integers(40, len(data) - 200, 12).tolist():
        changed = bytearray(data)
        changed[place : place + 8] = bytes(8)
        (tmp_path / "walk.zip").write_bytes(changed)
        with pytest.raises(ReadError, match="zip"):
            read_recording(tmp_path / "walk.zip")


def test_leftovers_of_a_killed_writer_are_not_recordings(walk, tmp_path):
    from stario.sequences.datasets.convert import convert

    convert(walk, tmp_path / ".rec.abcd.tmp", "euroc")
    convert(walk, tmp_path / "rec", "euroc")
    assert find_recordings(tmp_path) == [tmp_path / "rec"]


def test_a_truncated_event_loses_only_itself(tmp_path):
    rows = []
    for k in range(200):
        t = 10.0 + 0.01 * k
        rows += [f"ACCE;{t:.3f};{t:.3f};0.1;0.2;9.8;3", f"GYRO;{t:.3f};{t:.3f};0.01;-0.02;0.03;3"]
    last = "GYRO;12.345;12.340;0.01;-0.02;0.03;3"
    for length in (0, 2, 9, 34, len(last)):
        path = tmp_path / "logfile.txt"
        path.write_text("\n".join([*rows, last[:length]]))
        assert len(read_recording(path)) in (199, 200, 201)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_reference_points_take_the_time_unit_that_fits_the_recording(walk, tmp_path, unit):
    for late_s in (0.0, 1e6):
        for name, values in (("gyr", walk.gyro), ("acc", walk.accel)):
            save(tmp_path / f"walk_{name}.csv", "time [s],x,y,z", walk.time + late_s, values)
        taps = [[f"{t * unit:.0f}", t, 1.0] for t in (0.0, 2.0, 7.0, 11.0)]
        save(tmp_path / "walk_ref.csv", "t,x,y", taps)
        if not late_s:
            found = read_recording(tmp_path).positions
            np.testing.assert_allclose(found.time, [0.0, 2.0, 7.0, 11.0], atol=1e-6)
    with pytest.raises(ReadError, match=r"walk_ref\.csv: time: .* within .*1000000"):
        read_recording(tmp_path)


@pytest.mark.parametrize(("delay", "sorts"), [(2, True), (60, False)])
def test_slightly_disordered_rows_are_sorted(tmp_path, caplog, delay, sorts):
    """Every eighth row is late; a delay of 20 ms is sorted out, but 0.6 s has no clear cause."""
    walk = simulate_imu(generate_walk(2, 12.0), 100.0)
    row = np.arange(len(walk))
    order = np.argsort(row + np.where(row % 8 == 3, delay + 0.5, 0.0))
    write_csv(tmp_path / "plain.csv", walk.without_truth())
    lines = (tmp_path / "plain.csv").read_text().splitlines()
    shuffled = [lines[0], *(lines[1:][k] for k in order)]
    (tmp_path / "shuffled.csv").write_text("\n".join(shuffled) + "\n")
    plain, read = (read_recording(tmp_path / f"{name}.csv") for name in ("plain", "shuffled"))
    assert ("sorted by time" in caplog.text) is sorts
    if sorts:
        for name in ("time", "gyro", "accel"):
            np.testing.assert_array_equal(getattr(read, name), getattr(plain, name))
        check_units(read)
    else:
        with pytest.raises(InputError, match="sort the rows by time"):
            check_units(read)


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
