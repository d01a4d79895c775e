import shutil
import zipfile
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from phone_exports import save

from stario.sequences import check_units, generate_walk, read_recording, simulate_imu, write_csv
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers import find_recordings
from stario.sequences.readers.archive import write_archive
from stario.sequences.sequence import ImuSequence


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
        for one, other in zip(values_of(plain), values_of(read), strict=True):
            np.testing.assert_array_equal(one, other)
        check_units(read)
    else:
        with pytest.raises(InputError, match="sort the rows by time"):
            check_units(read)


def values_of(sequence: ImuSequence) -> tuple[np.ndarray, ...]:
    return sequence.time, sequence.gyro, sequence.accel
