import numpy as np
import pytest
from alike import assert_same_samples
from phone_exports import export, ns, save

from stario.sequences import InputError, check_units, read_recording, with_conventions


def test_the_summary_names_the_unit_that_times_were_taken_for(walk, tmp_path):
    """Not if the file names it, or if the times are counted from 1970 and fit no other."""
    wide = ",".join(f"{name} {axis}" for name in ("Gyro", "Acc") for axis in "XYZ")
    generic = "gx,gy,gz,ax,ay,az"
    millis = 10 * np.arange(len(walk)) + 7
    for titles, times, words in (
        (f"time,{wide}", millis, ", times taken as ms, 15.0 s"),
        (f"time,{generic}", millis, ", times taken as ms, 15.0 s"),
        (f"time,{generic}", walk.time, ", times taken as s, 15.0 s"),
        (f"time (ms),{wide}", millis, "file, 15.0 s"),
        (f"time [ms],{generic}", millis, "CSV, 15.0 s"),
        (f"time,{wide}", ns(walk), "file, 15.0 s"),
        (f"time,{generic}", ns(walk), "CSV, 15.0 s"),
    ):
        save(tmp_path / "a.csv", titles, times, walk.gyro, walk.accel)
        assert words in read_recording(tmp_path / "a.csv").summary()
    export("ios_logger", tmp_path / "b", walk)
    for words in ("b: iOS Logger, 15.0 s at 100.0 Hz, magnetometer at 100 Hz", "own attitude"):
        assert words in read_recording(tmp_path / "b").summary()


def test_an_undetermined_accelerometer_sign_is_reported(walk, tmp_path, caplog):
    export("sensor_logger_ios", tmp_path / "s", walk)
    (tmp_path / "s/Metadata.csv").unlink()
    undetermined = read_recording(tmp_path / "s")
    for read in (undetermined, with_conventions(undetermined)):
        check_units(read)
        assert "from an iPhone, pass `--accel-sign apple`" in caplog.text
        caplog.clear()
    turned = with_conventions(undetermined, accel_sign="apple")
    np.testing.assert_allclose(turned.accel, walk.accel, atol=1e-8)
    check_units(with_conventions(turned))
    assert not caplog.text
    export("ios_logger", tmp_path / "t", walk)
    for name in ("Motion.txt", "MotMagnFull.txt"):
        (tmp_path / "t" / name).unlink()
    with pytest.raises(InputError, match=r"`--accel-unit g`.* `--accel-sign apple`"):
        check_units(read_recording(tmp_path / "t"))
    assert not caplog.text


def test_lines_of_an_attitude_that_cannot_be_read_cost_no_recording(walk, tmp_path):
    export("get_sensor_data", tmp_path, walk)
    path = tmp_path / "log.txt"
    path.write_text(path.read_text().replace(";1;2;3;", ";1;2;"))
    assert read_recording(path).device_attitude is None


@pytest.mark.parametrize("second_clock", [False, True])
def test_swapped_rows_at_the_start_of_a_file_without_titles(second_clock, walk, tmp_path):
    order = np.arange(len(walk))
    order[[4, 5, 12, 13]] = [5, 4, 13, 12]
    clocks = [[stamp, stamp] if second_clock else [stamp] for stamp in ns(walk)]
    for name, values in (("gyro", walk.gyro), ("acce", walk.accel), ("gyro_uncalib", walk.accel)):
        rows = np.asarray(clocks)[order]
        save(tmp_path / f"s/{name}.txt", "", rows, values[order], sep=" ")
    sequence = read_recording(tmp_path / "s")
    assert_same_samples(sequence.select(np.argsort(sequence.time)), walk)
