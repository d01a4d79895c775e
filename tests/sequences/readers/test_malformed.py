import json
import pickle
import re
import struct
from pathlib import Path

import numpy as np
import published_formats as formats
import pytest

from stario.sequences.errors import ReadError
from stario.sequences.readers import FORMATS, find_recordings, read_recording


def assert_refused(path: Path, *texts: str) -> None:
    """Assert that reading raises a one-line error with the recording's folder and every text."""
    with pytest.raises(ReadError) as caught:
        read_recording(path)
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 700
    assert str(path.parent) in line
    assert re.search(r": found .+, expected .+", line)
    for text in texts:
        assert text in line, line


def change(path: Path, row: int, column: str, cell: str) -> None:
    """Replace a cell of a CSV file; rows are counted below the header."""
    lines = path.read_text().splitlines()
    cells = lines[row + 1].split(",")
    cells[lines[0].split(",").index(column)] = cell
    lines[row + 1] = ",".join(cells)
    path.write_text("\n".join(lines))


@pytest.fixture
def ronin(tmp_path, walks):
    pytest.importorskip("h5py")
    return formats.ronin(tmp_path / "a000_1", walks(200.0)).path


def test_a_truncated_hdf5_is_refused(ronin):
    content = (ronin / "data.hdf5").read_bytes()
    (ronin / "data.hdf5").write_bytes(content[: len(content) // 2])
    assert_refused(ronin, "data.hdf5: content: found ", "expected HDF5")
    assert find_recordings(ronin) == [ronin]


def test_an_hdf5_with_a_missing_shorter_or_invalid_field_is_refused(ronin):
    import h5py

    with h5py.File(ronin / "data.hdf5", "a") as data:
        del data["synced/acce"]
    assert_refused(ronin, "data.hdf5: synced/acce: found no such field")
    with h5py.File(ronin / "data.hdf5", "a") as data:
        data["synced/acce"] = np.zeros((50, 3))
    assert_refused(ronin, "synced/acce: found shape (50, 3), expected (2401, 3)")
    with h5py.File(ronin / "data.hdf5", "a") as data:
        del data["synced/acce"]
        data["synced/acce"] = np.zeros((2401, 3))
        data["synced/game_rv"][17] = 0.0
    assert_refused(ronin, "row 17, synced/game_rv: found norm 0, expected a unit quaternion")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("imu_acce_scale", None, "info.json: imu_acce_scale: found no such field"),
        ("imu_init_gyro_bias", [1, 2], "imu_init_gyro_bias: found [1, 2], expected 3 finite"),
        ("start_calibration", [0, 0, 0, 0], "start_calibration: found norm 0"),
        ("start_frame", 9999, "start_frame: found 9999, expected a row from 0 to 2400"),
        ("grv_ori_error", "large", "grv_ori_error: found 'large', expected a finite number"),
    ],
)
def test_an_info_with_an_invalid_field_is_refused(ronin, field, value, message):
    info = json.loads((ronin / "info.json").read_text())
    info[field] = value
    (ronin / "info.json").write_text(json.dumps({k: v for k, v in info.items() if v is not None}))
    assert_refused(ronin, message)


def test_an_info_that_is_missing_or_not_json_is_refused(ronin):
    (ronin / "info.json").write_text("{")
    assert_refused(ronin, "info.json: file: found Expecting property name")
    (ronin / "info.json").write_text("[1]")
    assert_refused(ronin, "info.json: file: found list, expected a JSON object")
    (ronin / "info.json").unlink()
    assert_refused(ronin, "info.json: file: found no such file")


@pytest.mark.parametrize(
    ("which", "quaternion", "missing"), [("ridi", "rv", "rv_w"), ("rnin", "gt_q", "vio_p_z")]
)
def test_a_damaged_csv_with_named_columns_is_refused(tmp_path, walks, which, quaternion, missing):
    path = getattr(formats, which)(tmp_path / "seq", walks(200.0)).path
    csv = next(iter([*path.rglob("data.csv"), *path.rglob("SenseINS.csv")]))
    good = csv.read_text()
    change(csv, 40, "acce_y", "high")
    assert_refused(path, "line 42, acce_y", "found 'high', expected a number")
    csv.write_text(good)
    change(csv, 20, "acce_y", "nan")
    for axis in "wxyz":
        change(csv, 40, f"{quaternion}_{axis}", "0.0")
    assert_refused(path, f"row 42, {quaternion}: found norm 0, expected a unit quaternion")
    csv.write_text(good[: int(0.7 * len(good))].rsplit("\n", 1)[0].rsplit(",", 4)[0])
    assert_refused(path, "values, expected", "cut short")
    csv.write_text(good.replace(f"{missing},", "other,", 1).replace(f",{missing}\n", ",other\n", 1))
    assert_refused(path, f"{csv.name}: header: found no {missing}")
    csv.write_text(good.split("\n")[0] + "\n")
    assert_refused(path, "rows: found none below the header")


def test_pickles_are_refused_without_being_loaded(tmp_path, walks):
    class Harm:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "harm",))

    content = pickle.dumps(Harm())
    path = formats.ridi(tmp_path / "seq", walks(200.0)).path
    (path / "processed/data.csv").unlink()
    (path / "processed/data.pkl").write_bytes(content)
    assert_refused(path, "data.pkl: file: found a pickle", "expected processed/data.csv")
    assert find_recordings(path) == [path]
    (tmp_path / "walk.npy").write_bytes(content)
    assert_refused(tmp_path / "walk.npy", "walk.npy: content: found a pickle")
    path = formats.tlio(tmp_path / "7", walks(200.0)).path
    np.save(path / "imu0_resampled.npy", np.array([Harm()], dtype=object))
    assert_refused(path, "imu0_resampled.npy: array: found pickled objects, which may run code")
    assert not (tmp_path / "harm").exists()


def test_an_npy_that_does_not_fit_its_description_is_refused(tmp_path, walks):
    path = formats.tlio(tmp_path / "7", walks(200.0)).path
    file, description = path / "imu0_resampled.npy", path / "imu0_resampled_description.json"
    table, text = np.load(file), description.read_text()
    bad = table.copy()
    bad[9, 7:11] = 0.0
    np.save(file, bad)
    assert_refused(path, "row 9, qxyzw_World_Device: found norm 0")
    np.save(file, table[:, :10])
    assert_refused(path, "array: found shape (2401, 10), expected (N, 17)")
    np.save(file, np.array(["a", "b"]))
    assert_refused(path, "array: found dtype <U1, expected numbers")
    np.save(file, table)
    file.write_bytes(file.read_bytes()[:3000])
    assert_refused(path, "imu0_resampled.npy: array: found ", "is the download complete?")
    np.save(file, table)
    description.write_text(text.replace("qxyzw_World_Device(4)", "quat(4)"))
    assert_refused(path, "description.json: columns_name(width): found no qxyzw_World_Device")
    description.write_text(text.replace("pos_World_Device(3)", "pos_World_Device"))
    assert_refused(path, "found 'pos_World_Device', expected a name with its width")
    description.unlink()
    assert_refused(path, "imu0_resampled_description.json: file: found no such file")


def test_raw_samples_without_a_valid_calibration_are_refused(tmp_path, walks):
    path = formats.tlio_raw(tmp_path / "7", walks(1000.0)).path
    calibration = path.with_name("calibration.json")
    fields = json.loads(calibration.read_text())
    fields["Gyroscope"]["Model"]["RectificationMatrix"] = [[0.0] * 3] * 3
    calibration.write_text(json.dumps(fields))
    assert_refused(path, "Gyroscope.Model.RectificationMatrix: found a singular matrix")
    calibration.unlink()
    assert_refused(path, "calibration.json: file: found no such file")


def test_a_bag_cut_short_or_with_bad_values_is_refused(tmp_path):
    walk = formats.walk_of(100.0, 2.0)
    path = formats.bag(tmp_path / "b", walk)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert_refused(path, "b.bag: file: found ", "expected an intact bag", "`rosbag reindex`")
    quat = walk.truth.attitude_WB[20].as_quat()
    empty = formats.bag(tmp_path / "q", walk, imu_topics=("/imu",))
    content = empty.read_bytes().replace(struct.pack("<4d", *quat), struct.pack("<4d", 0, 0, 0, 0))
    empty.write_bytes(content)
    assert_refused(empty, "row 20, /odom, quaternion: found norm 0")
    folder = formats.bag(tmp_path / "two", walk, "sqlite3")
    database = next(folder.glob("*.db3"))
    database.write_bytes(database.read_bytes()[:5000])
    assert_refused(folder, "two: file: found ", "expected an intact bag")


def test_invalid_or_missing_logger_files_are_refused(tmp_path, walks):
    path = formats.android(tmp_path / "log", walks(200.0)).path
    gyro = path / "Gyroscope.csv"
    lines = gyro.read_text().splitlines()
    gyro.write_text("\n".join([*lines[:50], lines[50].rsplit(",", 2)[0], *lines[51:]]))
    assert_refused(path, "Gyroscope.csv: line 51: found 3 values, expected 5")
    gyro.write_text("\n".join([*lines[:50], lines[50].rsplit(",", 2)[0]]))
    assert len(read_recording(path)) == 49 - 15  # the app was killed; the accelerometer began later
    for wild in ("inf", "1e15"):
        gyro.write_text(
            "\n".join([lines[0], *(f"{x.rsplit(',', 1)[0]},{wild}" for x in lines[1:])])
        )
        found = f"x, y, z: found {float(wild):.3g} on average"
        assert_refused(path, f"Gyroscope.csv: {found}, expected a plausible value in rad/s")
    gyro.write_text("\n".join(lines).replace(",x", ",x [rpm]", 1))
    assert_refused(path, "Gyroscope.csv: header, ", "found unit 'rpm', expected rad/s, deg/s")
    gyro.unlink()
    assert_refused(path, "sensors: found only accel and mag, expected a gyroscope")
    with pytest.raises(ReadError, match=r"Accelerometer\.csv, .* gyroscope"):
        read_recording(path, format="phone")


@pytest.mark.parametrize("name", list(FORMATS))
def test_every_reader_refuses_what_is_not_its_own_format(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.csv").write_text("hello\n")
    (tmp_path / "bytes.bin").write_bytes(bytes(range(256)) * 10)
    for path in (tmp_path / "folder", tmp_path / "text.csv", tmp_path / "bytes.bin"):
        assert not FORMATS[name].recognises(path)
        with pytest.raises(ReadError):
            read_recording(path, format=name)
    assert not FORMATS[name].recognises(tmp_path / "none")


@pytest.mark.parametrize("name", ["w/data.hdf5", "w/walk.h5"])
def test_an_hdf5_file_of_something_else_has_no_recordings(name, tmp_path):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "w").mkdir()
    with h5py.File(tmp_path / name, "w") as data:
        data["notes/text"] = [1.0]
    assert_refused(
        tmp_path / name, "content: found no recordings in a known format, expected imu/t"
    )
