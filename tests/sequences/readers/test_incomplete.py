import os
from dataclasses import replace

import numpy as np
import published_formats as formats
import pytest
from phone_exports import save

from stario.sequences import (
    ReadError,
    check_units,
    find_recordings,
    inspect_recording,
    read_recording,
    write_csv,
)
from stario.sequences.datasets.convert import write_euroc
from stario.sequences.readers.archive import write_archive
from stario.sequences.readers.columns import HEADER


@pytest.fixture(scope="module")
def walk():
    return formats.walk_of(100.0, 3.0)


def test_an_euroc_folder_without_its_imu_is_no_recording_of_its_truth(walk, tmp_path):
    """Its truth has columns of gyroscope and accelerometer: their biases."""
    imu, truth = write_euroc(tmp_path / "V1", walk)
    imu.unlink()
    header, *poses = truth.read_text().splitlines()
    biases = ",".join(f"b_{s}_RS_S_{axis}" for s in "wa" for axis in "xyz")
    rows = [f"{row},{k % 7},2,3,4,5,6" for k, row in enumerate(poses)]
    truth.write_text("\n".join([f"{header},{biases}", *rows]))
    assert find_recordings(tmp_path) == [tmp_path / "V1"]
    with pytest.raises(ReadError, match=r"V1: mav0/imu0/data\.csv: found no such file"):
        read_recording(tmp_path / "V1")


def test_an_empty_file_in_a_folder_is_named(tmp_path):
    (tmp_path / "dan/processed").mkdir(parents=True)
    (tmp_path / "dan/processed/data.csv").touch()
    with pytest.raises(ReadError, match=r"processed/data\.csv .* empty"):
        read_recording(tmp_path / "dan")


def test_a_column_of_a_code_is_no_axis_of_a_sensor(walk, tmp_path):
    """ADVIO's `imu-gyro.csv` holds time, a code and other values: not the gyroscope."""
    folder, code = tmp_path / "advio-01/iphone", np.full((len(walk), 1), 34.0)
    (tmp_path / "advio-01/ground-truth").mkdir(parents=True)
    (tmp_path / "advio-01/ground-truth/pose.csv").touch()
    save(folder / "accelerometer.csv", "", walk.time, walk.accel)
    save(folder / "imu-gyro.csv", "", walk.time, code, walk.gyro, walk.accel)
    (folder / "gyro.csv").touch()
    with pytest.raises(ReadError, match=r"only accel, .*gyro\.csv.*no rows"):
        read_recording(tmp_path / "advio-01")


def test_a_sensor_file_without_permission_is_named(walk, tmp_path, monkeypatch):
    save(tmp_path / "Accelerometer.csv", "", walk.time, walk.accel)
    gyro = tmp_path / "Gyroscope.csv"
    gyro.touch()  # whose content is as unknown as without permission, which the root user has
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != gyro and allowed(path, mode))
    with pytest.raises(ReadError, match=r"Gyroscope\.csv: path: found no permission to read"):
        read_recording(tmp_path)


def test_poses_out_of_order_are_counted(walk, tmp_path, caplog):
    _, truth = write_euroc(tmp_path / "V1", walk)
    header, *poses = truth.read_text().splitlines()
    truth.write_text(
        "\n".join([header, *poses[:100], *poses[150:200], *poses[100:150], *poses[200:]])
    )
    found = read_recording(tmp_path / "V1").truth
    assert len(found) == len(poses) - 50
    assert f"dropped 50 of {len(poses)} poses: their times do not increase" in caplog.text


def test_an_euroc_file_whose_titles_are_in_another_order_is_not_read_by_position(tmp_path, walk):
    imu, *_ = write_euroc(tmp_path / "V1", walk)
    rows = [line.split(",") for line in imu.read_text().splitlines()]
    swapped = [",".join([row[0], *row[3:0:-1], *row[4:]]) for row in rows]
    imu.write_text("\n".join(swapped) + "\n")
    with pytest.raises(ReadError, match=r"header: .*, expected time, gyroscope xyz and acc"):
        read_recording(tmp_path / "V1")
    np.testing.assert_allclose(read_recording(imu, format="csv").gyro, walk.gyro)


@pytest.mark.parametrize(
    ("gyro", "accel", "alone"),
    [
        (slice(0, 190), slice(None), {"accelerometer": 1.1}),
        (slice(None), slice(0, 190), {"gyroscope": 1.1}),
        (slice(0, 190), slice(20, 300), {"accelerometer": 1.1}),
        (slice(0, 250), slice(None), {}),
    ],
    ids=["gyroscope cut", "accelerometer cut", "starts late", "half a second"],
)
@pytest.mark.parametrize("form", ["folder", "csv"])
def test_a_sensor_that_goes_on_without_the_other_is_told(
    form, gyro, accel, alone, walk, tmp_path, caplog
):
    if form == "folder":
        save(tmp_path / "w/Gyroscope.csv", "time [s],x,y,z", walk.time[gyro], walk.gyro[gyro])
        save(
            tmp_path / "w/Accelerometer.csv", "time [s],x,y,z", walk.time[accel], walk.accel[accel]
        )
    else:
        rows = [
            (t + 0.001, f"{t + 0.001:.4f},,,,{x},{y},{z}")
            for t, (x, y, z) in zip(walk.time[accel], walk.accel[accel], strict=True)
        ]
        rows += [
            (t, f"{t:.4f},{x},{y},{z},,,")
            for t, (x, y, z) in zip(walk.time[gyro], walk.gyro[gyro], strict=True)
        ]
        (tmp_path / "w.csv").write_text("\n".join([HEADER, *(text for _, text in sorted(rows))]))
    read = read_recording(tmp_path / ("w" if form == "folder" else "w.csv"))
    assert read.alone_s == pytest.approx(alone, abs=0.03)
    codes = [finding.code for finding in inspect_recording(read).findings]
    assert ("sensor_alone" in codes) == bool(alone)
    check_units(read)
    assert ("which are left out" in caplog.text) == bool(alone)


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("part", [slice(0, 150), slice(-150, None)], ids=["start", "end"])
def test_a_sensor_without_numbers_at_an_end_is_told(sensor, part, walk, tmp_path):
    values = getattr(walk, sensor).copy()
    values[part] = np.nan
    cut = replace(walk, **{sensor: values})
    write_csv(tmp_path / "w.csv", cut)
    write_archive(tmp_path / "w.h5", [cut])
    for file in ("w.csv", "w.h5"):
        found = inspect_recording(read_recording(tmp_path / file)).findings
        (alone,) = (finding.values for finding in found if finding.code == "sensor_alone")
        assert [*alone.values()] == pytest.approx([1.5])
        assert [*alone] == [{"gyro": "accelerometer", "accel": "gyroscope"}[sensor]]
