"""One file per sensor: which belong together, their titles, units and clocks."""

import numpy as np
import published_formats as formats
import pytest
from alike import assert_same_samples

from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers import find_recordings, read_recording, write_csv
from stario.sequences.units import with_units


def write_phone_files(folder, accel: str, gyro: str, names=("accel.csv", "gyro.csv")) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in zip(names, (accel, gyro), strict=True):
        (folder / name).write_text(text)


def rows(time, values, sep=",", last=False) -> str:
    return "\n".join(
        sep.join(map(repr, [*v, t] if last else [t, *v]))
        for t, v in zip(time.tolist(), values.tolist(), strict=True)
    )


def test_loggers_with_different_conventions_are_read(tmp_path):
    """Seconds with units in a header; milliseconds without any; the time after the values."""
    walk = formats.walk_of(200.0, 5.0)
    t, gyro, accel = walk.time, walk.gyro, walk.accel
    header = '"Time (s)","Gyroscope x (deg/s)","Gyroscope y (deg/s)","Gyroscope z (deg/s)"\n'
    g_header = "timestamp [s];ax [g];ay [g];az [g]\n"
    blanks = "# a logger\n"
    conventions = {
        "phyphox": (
            g_header + rows(t, accel / 9.80665, ";"), header + rows(t, np.degrees(gyro)),
        ),
        "plain": (rows(1000 * t + 5e8, accel), rows(1000 * t + 5e8, gyro)),
        "behind": (rows(t, accel, last=True), rows(t, gyro, last=True)),
        "blanks": (blanks + rows(1e6 * t, accel, " "), blanks + rows(1e6 * t, gyro, " ")),
    }  # fmt: skip
    for name, (accel_text, gyro_text) in conventions.items():
        write_phone_files(tmp_path / name, accel_text, gyro_text)
        read = read_recording(tmp_path / name)
        assert np.abs(read.gyro - gyro).max() < 1e-9, name
        assert np.abs(read.accel - accel).max() < 1e-6, name
        assert np.abs(read.time - t).max() < 1e-7, name
    assert find_recordings(tmp_path) == [tmp_path / name for name in sorted(conventions)]


def write_sensor_files(folder, *names: str) -> None:
    """Write files of gyroscope samples, or of the accelerometer's if the name contains "acc"."""
    walk = formats.walk_of(100.0, 3.0)
    folder.mkdir()
    for name in names:
        values = walk.accel if "acc" in name.lower() else walk.gyro
        (folder / name).write_text(rows(walk.time, values))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ("walk1_acc.csv", "walk1_gyr.csv", "walk2_acc.csv", "walk2_gyr.csv"),
            r"a folder of 2 recordings, .*; name one, such as .*/walk1_gyr\.csv",
        ),
        (("acc_1.csv", "acc_2.csv", "gyr_3.csv"), r"recordings \(acc_1\.csv, acc_2\.csv, gyr_3"),
    ],
)
def test_recordings_that_share_a_folder_are_not_mixed(tmp_path, names, message):
    write_sensor_files(tmp_path / "s", *names)
    with pytest.raises(ReadError, match=message):
        read_recording(tmp_path / "s")


def test_files_with_two_prefixes_are_two_recordings(tmp_path):
    write_sensor_files(tmp_path / "s", "one_acc.csv", "one_gyr.csv", "Two_acc.csv", "Two_gyr.csv")
    (tmp_path / "s/Two_gyr.csv").write_text(rows(np.arange(99) / 100.0, np.ones((99, 3))))
    found = find_recordings(tmp_path)
    assert found == [tmp_path / "s/Two_gyr.csv", tmp_path / "s/one_gyr.csv"]
    two, one = map(read_recording, found)
    assert (two.name, one.name) == ("Two", "one")
    assert (two.gyro == 1.0).all()
    assert np.array_equal(one.gyro, formats.walk_of(100.0, 3.0).gyro)


def test_a_sensor_is_paired_with_the_one_of_its_own_device(tmp_path):
    write_sensor_files(tmp_path / "s", "watch_acc.csv", "watch_gyr.csv")
    expected = read_recording(tmp_path / "s")
    (tmp_path / "s/phone_acc.csv").write_text(rows(expected.time, 2.0 * expected.accel))
    assert np.array_equal(read_recording(tmp_path / "s").accel, expected.accel)


def test_variants_of_a_recordings_files_are_not_other_recordings(tmp_path):
    """Files written alongside the raw sensors; names that differ by more than the sensor."""
    names = ("Accelerometer.csv", "Gyroscope.csv")
    variants = ("AccelerometerUncalibrated.csv", "GyroscopeUncalibrated.csv", "Gravity.csv")
    write_sensor_files(tmp_path / "s", *names, *variants)
    write_sensor_files(tmp_path / "t", "acc_12-00-01.csv", "gyr_12-00-02.csv")
    assert_same_samples(read_recording(tmp_path / "s"), read_recording(tmp_path / "t"))
    uncalibrated = tmp_path / "s/AccelerometerUncalibrated.csv"
    uncalibrated.write_text(rows(np.arange(9) / 100.0, np.ones((9, 3))))
    assert len(read_recording(tmp_path / "s")) == len(read_recording(tmp_path / "t"))


@pytest.mark.parametrize("above", ["", "\n", "Device: Pixel\n\n", "# a\n\n# b\n"])
def test_any_text_above_a_loggers_header_is_skipped(tmp_path, above):
    walk = formats.walk_of(100.0, 3.0)
    head = f"{above}time,x,y,z\n"
    write_phone_files(
        tmp_path / "s", head + rows(walk.time, walk.accel), head + rows(walk.time, walk.gyro)
    )
    assert np.array_equal(read_recording(tmp_path / "s").gyro, walk.gyro)


@pytest.mark.parametrize("rate", [50.0, 1000.0, 1125.0])
@pytest.mark.parametrize("start", [0.0, 12345.678])
def test_the_time_unit_is_determined_at_every_accepted_rate(tmp_path, rate, start):
    walk = formats.walk_of(rate, 2.0)
    t = np.round(start + walk.time, 6)
    write_phone_files(tmp_path / "s", rows(t, walk.accel), rows(t, walk.gyro))
    assert read_recording(tmp_path / "s").rate == pytest.approx(rate, rel=1e-3)


def test_units_named_by_a_logger_are_used_or_refused(tmp_path):
    walk = formats.walk_of(100.0, 3.0)

    def read(time, gyro):
        texts = [
            f"time [{time}],x [{unit}],y,z\n" + rows(1e3 * walk.time, values)
            for unit, values in (("m/s^2", walk.accel), (gyro, np.degrees(walk.gyro)))
        ]
        write_phone_files(tmp_path / "s", *texts)
        return read_recording(tmp_path / "s")

    named = read("milliseconds", "deg/s")
    assert np.allclose(named.time, walk.time)
    with pytest.raises(InputError, match="whose file names its unit"):
        with_units(named, gyro_unit="deg/s")
    with_units(named, accel_unit="-m/s^2")
    with pytest.raises(ReadError, match="time: found unit 'ticks', expected s, ms, us, ns"):
        read("ticks", "deg/s")


def test_files_with_both_sensors_are_separate_recordings(tmp_path, walks):
    write_csv(tmp_path / "accel_gyro_1.csv", walks(200.0))
    write_csv(tmp_path / "accel_gyro_2.csv", walks(200.0))
    assert len(find_recordings(tmp_path)) == 2


def test_a_loggers_gravity_is_added_if_it_was_removed(tmp_path):
    walk = formats.walk_of(100.0, 5.0)
    gravity = walk.truth.attitude_WB.apply([0.0, 0.0, 9.80665], inverse=True)
    write_phone_files(
        tmp_path / "s", rows(walk.time, walk.accel - gravity), rows(walk.time, walk.gyro)
    )
    assert np.abs(read_recording(tmp_path / "s").accel).mean() < 3.0
    (tmp_path / "s/Gravity.csv").write_text(rows(walk.time, gravity))
    assert np.abs(read_recording(tmp_path / "s").accel - walk.accel).max() < 1e-9


def test_clocks_of_different_phase_are_interpolated_but_not_across_a_gap(tmp_path):
    walk = formats.walk_of(200.0, 10.0)
    t = walk.time
    accel_time = np.delete(t[:-1] + 0.0017, np.arange(800, 1000))
    force = np.stack([np.interp(accel_time, t, walk.accel[:, k]) for k in range(3)], axis=1)
    write_phone_files(tmp_path / "s", rows(accel_time, force), rows(t, walk.gyro))
    read = read_recording(tmp_path / "s")
    assert len(read) == len(t) - 2 - 201
    assert np.diff(read.time).max() == pytest.approx(1.01, abs=1e-6)
    kept = np.searchsorted(t, read.time + t[1] - 1e-6)
    assert np.array_equal(read.gyro, walk.gyro[kept])
    assert np.abs(read.accel - walk.accel[kept]).max() < 0.3
    write_phone_files(tmp_path / "late", rows(t + 100.0, walk.accel), rows(t, walk.gyro))
    with pytest.raises(ReadError, match=r"gyroscope from 0.000 to 10.000 s, accelerometer from 1"):
        read_recording(tmp_path / "late")
