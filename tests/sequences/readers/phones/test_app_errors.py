import zipfile

import numpy as np
import pytest
from phone_exports import export, ns, save, save_zyx

from stario.sequences import ReadError, read_recording
from stario.sequences.clean_samples import clean_samples


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"SQLite format 3\0" + bytes(40), "an SQLite database"),
        (b"PK\x03\x04xl/workbook.xml", "a zip without text files"),
        (b"\x1f\x8b\x08\0\0\0", "compressed with gzip"),
    ],
)
def test_an_unsupported_container_is_named(start, message, tmp_path):
    (tmp_path / "export.data").write_bytes(start)
    with pytest.raises(ReadError, match=rf"found [\w ,]*{message}.*; export as CSV"):
        read_recording(tmp_path / "export.data")


def test_two_recordings_in_a_zip_are_named(walk, tmp_path):
    save_zyx(tmp_path / "s", walk, TotalAcceleration=walk.accel, Gyroscope=walk.gyro)
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as file:
        for one in (tmp_path / "s").iterdir():
            file.write(one, f"a/{one.name}")
            file.write(one, f"b/{one.name}")
    with pytest.raises(ReadError, match=r"two\.zip: .* \(a, b\), .*unpack the zip"):
        read_recording(tmp_path / "two.zip")


@pytest.mark.parametrize("first", [0, 1])
def test_a_count_of_rows_is_no_time_unless_it_has_a_unit(first, walk, tmp_path):
    count, own = first + np.arange(len(walk)), "time,gx,gy,gz,ax,ay,az"
    save(tmp_path / "own.csv", own, count, walk.gyro, walk.accel)
    save(tmp_path / "ms.csv", own.replace("time", "time [ms]"), count, walk.gyro, walk.accel)
    assert read_recording(tmp_path / "ms.csv").rate == pytest.approx(1000.0)
    wide = ",".join(f"{name} {axis}" for name in ("Gyroscope", "Accelerometer") for axis in "XYZ")
    save(tmp_path / "wide.csv", f"timestamp,{wide}", count, walk.gyro, walk.accel)
    for name, values in (("Gyroscope", walk.gyro), ("Accelerometer", walk.accel)):
        save(tmp_path / f"titled/{name}.csv", "time,x,y,z", count, values)
        save(tmp_path / f"bare/{name}.csv", "", count, values)
    for name in ("own.csv", "wide.csv", "titled", "bare"):
        title = "timestamp" if name == "wide.csv" else "time"
        with pytest.raises(ReadError, match=rf"{title}: found {first}, .* counts the rows.*\[ms\]"):
            read_recording(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[{"sensor": "Gyroscope", "time"', r"x\.json: file: found .*, expected JSON"),
        ('[{"sensor": "../up", "time": "1"}]', r"x\.json: sensor: found no name"),
        ('[{"sensor": "Gyroscope", "time": "1"}, 3]', r"found other JSON, expected an array"),
        ('[{"sensor": "Gyroscope", "time": "1"}]', r"x\.json: .*found"),
    ],
)
def test_a_malformed_json_export_is_refused_in_one_line(text, message, tmp_path):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ReadError, match=message) as error:
        read_recording(tmp_path / "x.json")
    assert "\n" not in str(error.value)
    assert "stario-" not in str(error.value)


def test_a_sensors_file_without_samples_is_named(walk, tmp_path, caplog):
    """One of another sensor than the gyroscope's is no name of a recording."""
    save_zyx(tmp_path, walk, Gyroscope=walk.gyro, GyroscopeUncalibrated=walk.gyro)
    (tmp_path / "TotalAcceleration.csv").write_text("time,seconds_elapsed,z,y,x\n")
    with pytest.raises(ReadError, match=r"only gyro, .*TotalAcceleration\.csv: no rows"):
        read_recording(tmp_path)
    save_zyx(tmp_path, walk, TotalAcceleration=walk.accel)
    with pytest.raises(ReadError, match=r"one sensor of .*gyroscope: .*/Gyroscope\.csv$"):
        read_recording(tmp_path / "TotalAcceleration.csv")
    assert len(read_recording(tmp_path / "Gyroscope.csv")) == len(walk)
    (tmp_path / "Gyroscope.csv").write_text("")
    read_recording(tmp_path)
    assert "Gyroscope.csv: not read: it has no rows" in caplog.text


def test_samples_without_an_accelerometer_are_counted(walk, tmp_path, caplog):
    """It stopped halfway, say; that it starts a little late needs no mention."""
    save_zyx(tmp_path, walk, Gyroscope=walk.gyro)
    for part, words in ((slice(10, None), ""), (slice(0, 751), "dropped 750 of 1501 samples")):
        kept = walk.select(np.arange(len(walk))[part])
        save_zyx(tmp_path, kept, TotalAcceleration=kept.accel)
        read_recording(tmp_path)
        assert words in caplog.text
        assert ("dropped" in caplog.text) == bool(words)


def test_single_wild_samples_are_no_reason_to_refuse_a_file(walk, tmp_path):
    """They would spoil the comparison with the phone's attitude, which tells Apple's sign."""
    gyro, accel = walk.gyro.copy(), -walk.accel
    gyro[500, 1], gyro[600, 0], accel[700, 2], accel[900, 0] = 1e30, 1e5, np.inf, -1e15
    save_zyx(tmp_path, walk, Gyroscope=gyro, TotalAcceleration=accel)
    header = "time,seconds_elapsed,qz,qy,qx,qw"
    quat_xyzw = walk.truth.quat_xyzw[:, [2, 1, 0, 3]]
    save(tmp_path / "Orientation.csv", header, ns(walk), walk.time, quat_xyzw)
    time, rate, force = clean_samples(read_recording(tmp_path))
    assert len(time) == len(walk) - 2
    np.testing.assert_allclose(rate, np.delete(walk.gyro, [500, 600], axis=0))
    assert np.abs(force - np.delete(walk.accel, [500, 600], axis=0)).max() < 2.0


def test_a_clock_in_another_unit_than_its_title_says(walk, tmp_path):
    late = 1e3 * walk.time + 5
    for gyro_time, accel_time, words in (
        (ns(walk), ns(walk), "time: .*is its unit the one that the header"),
        (late, late - 5, "10 s apart, .*is its unit"),
    ):
        save(tmp_path / "Gyroscope.csv", "t [s],x,y,z", gyro_time, walk.gyro)
        save(tmp_path / "TotalAcceleration.csv", "t [s],x,y,z", accel_time, walk.accel)
        with pytest.raises(ReadError, match=words):
            read_recording(tmp_path)


@pytest.mark.parametrize(
    ("write", "whole", "changed", "error"),
    [
        ("trace", "TYPE_GYROSCOPE\t", "TYPE_GYROSCOPE\tx", "TYPE_GYROSCOPE, line 1 .*'156.* x"),
        ("trace", "1560828400010\tTYPE_GYRO", "9" * 25 + "\tTYPE_GYRO", "line 2 .*'999"),
        ("get_sensor_data", "\nGYRO;5.010;", "\nGYRO;5.010\nGYRO;5.010;", "line 2 .*cut line"),
        ("get_sensor_data", "\nACCE;5.010;", "\nACCE;;", "ACCE, line 2 .*' 0.0100'"),
    ],
)
def test_a_damaged_event_line_is_named(walk, tmp_path, write, whole, changed, error):
    export(write, tmp_path / "walk", walk)
    (file,) = (tmp_path / "walk").iterdir()
    file.write_text(file.read_text().replace(whole, changed, 1))
    with pytest.raises(ReadError, match=error):
        read_recording(file)


@pytest.mark.parametrize(
    ("write", "cell"), [("trace", "TYPE_GYROSCOPE\t"), ("get_sensor_data", "\nACCE;5.010;0.0100;")]
)
def test_an_event_that_is_not_finite_is_dropped_with_a_warning(walk, tmp_path, caplog, write, cell):
    export(write, tmp_path / "walk", walk)
    (file,) = (tmp_path / "walk").iterdir()
    before, _, after = file.read_text().rpartition(cell)
    separator = cell[-1]
    file.write_text(separator.join([f"{before}{cell}nan", *after.split(separator)[1:]]))
    read = read_recording(file)
    assert np.isfinite(np.column_stack([read.gyro, read.accel])).all()
    assert f"dropped 1 of {len(walk)} rows that are not finite" in caplog.text
