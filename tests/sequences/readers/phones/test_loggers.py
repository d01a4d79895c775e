"""Exports of further loggers and devices: each must be read as the walk written."""

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from alike import assert_same_samples
from phone_files import field, gravity, ns, save

from stario.sequences import ImuSequence, find_recordings, read_recording
from stario.sequences.sequence import STANDARD_GRAVITY


def by_axis(*names: str) -> list[str]:
    """Return titles in which `#` becomes each axis."""
    return [name.replace("#", axis) for name in names for axis in "XYZ"]


def dates(walk: ImuSequence, form: str) -> list[list[str]]:
    start = datetime(2024, 5, 1, 23, 59, 55)
    return [[(start + timedelta(seconds=t)).strftime(form)] for t in walk.time.tolist()]


def micros(walk: ImuSequence) -> list[int]:
    return [1_000_000 + round(1e6 * t) for t in walk.time.tolist()]


def shimmer(folder: Path, walk: ImuSequence) -> None:
    """A line for spreadsheets, units below the titles, and a tab at the end of each line."""
    names = by_axis("Accel_LN_#", "Accel_WR_#", "Gyro_#")
    titles = ["Timestamp_Unix", *names]
    units = ["ms", *["m/(s^2)"] * 6, *["deg/s"] * 3]
    header = '"sep=\t"\n' + "\t".join(f"Shimmer_A_{title}_CAL" for title in titles) + "\t\n"
    blank = [[""]] * len(walk)
    clock = [1.7e12 + round(1e3 * t, 3) for t in walk.time.tolist()]
    save(folder / "a.csv", header + "\t".join(units) + "\t", clock, walk.accel, walk.accel + 1.0,
         np.degrees(walk.gyro), blank, sep="\t")  # fmt: skip


def units_below_the_titles(folder: Path, walk: ImuSequence) -> None:
    for name, unit, values in (
        ("acc", "g", walk.accel / STANDARD_GRAVITY),
        ("gyr", "deg/s", np.degrees(walk.gyro)),
    ):
        header = f"time,x,y,z\n(us),({unit}),({unit}),({unit})"
        save(folder / f"{name}.csv", header, micros(walk), values)


def matlab_mobile(folder: Path, walk: ImuSequence) -> None:
    """Names of months, across midnight."""
    for name, values in (("Acceleration", walk.accel), ("AngularVelocity", walk.gyro)):
        times = dates(walk, "%d-%b-%Y %H:%M:%S.%f")
        save(folder / f"{name}.csv", "Timestamp,X,Y,Z", times, values)


def metawear(folder: Path, walk: ImuSequence) -> None:
    for name, unit, values in (
        ("Accelerometer", "g", walk.accel / STANDARD_GRAVITY),
        ("Gyroscope", "deg/s", np.degrees(walk.gyro)),
    ):
        axes = ",".join(f"{axis}-axis ({unit})" for axis in "xyz")
        header = f"epoc (ms),timestamp (+0200),elapsed (s),{axes}"
        millis = [1_700_000_000_000 + round(1e3 * t) for t in walk.time.tolist()]
        texts = dates(walk, "%Y-%m-%dT%H.%M.%S.%f")
        save(folder / f"MetaWear_C8_{name}.csv", header, millis, texts, walk.time, values)


def polar(folder: Path, walk: ImuSequence) -> None:
    texts = dates(walk, "%Y-%m-%dT%H:%M:%S.%f")
    for name, unit, values in (
        ("ACC", "mg", 1e3 * walk.accel / STANDARD_GRAVITY),
        ("GYRO", "dps", np.degrees(walk.gyro)),
    ):
        axes = ";".join(f"{axis} [{unit}]" for axis in "XYZ")
        header = f"Phone timestamp;sensor timestamp [ns];{axes}"
        save(folder / f"Polar_Sense_{name}.txt", header, texts, ns(walk), values, sep=";")


def witmotion(folder: Path, walk: ImuSequence) -> None:
    """Times of day; only the unit tells that `As` is the gyroscope."""
    titles = ["time", "DeviceName", *by_axis("Acc#(g)", "As#(°/s)", "Angle#(°)")]
    columns = walk.accel / STANDARD_GRAVITY, np.degrees(walk.gyro), np.zeros((len(walk), 3))
    times, name = dates(walk, "%H:%M:%S.%f"), [["WT901"]] * len(walk)
    save(folder / "a.txt", "\t".join(titles), times, name, *columns, sep="\t")


def vectornav(folder: Path, walk: ImuSequence) -> None:
    titles = ["TimeStartup", *by_axis("Ypr#", "Accel#", "AngularRate#", "Mag#")]
    stamps = [1000 * t for t in micros(walk)]
    columns = np.zeros((len(walk), 3)), walk.accel, walk.gyro, field(walk)
    save(folder / "vn.csv", ",".join(titles), stamps, *columns)


def movella(folder: Path, walk: ImuSequence) -> None:
    """`FreeAcc` lacks gravity."""
    titles = ["PacketCounter", "SampleTimeFine", *by_axis("FreeAcc_#", "Acc_#", "Gyr_#")]
    above = "sep=,\nDeviceTag:,Movella DOT 1\nOutputRate:,100Hz\n\n"
    count = np.arange(len(walk))
    columns = walk.accel - gravity(walk), walk.accel, walk.gyro
    save(folder / "dot.csv", above + ",".join(titles), count, micros(walk), *columns)


def hyperimu(folder: Path, walk: ImuSequence) -> None:
    """Names of chips, which differ between the sensors of one phone."""
    names = "LSM6 Accelerometer.#", "AK09918 Magnetometer.#", "LSM6 Gyroscope.#", "Linear Acc.#"
    columns = walk.accel, field(walk), walk.gyro, walk.accel - gravity(walk)
    save(folder / "a.csv", ",".join(["Timestamp", *by_axis(*names)]), ns(walk), *columns)


def microcontroller(folder: Path, walk: ImuSequence) -> None:
    """The column of times is called like its unit."""
    titles = ["micros", *by_axis("a#", "g#")]
    save(folder / "a.csv", ",".join(titles), micros(walk), walk.accel, walk.gyro)


def date_and_time(folder: Path, walk: ImuSequence) -> None:
    titles = ["Date", "Time", *by_axis("Acc #", "Gyro #")]
    day, clock = dates(walk, "%d/%m/%Y"), dates(walk, "%I:%M:%S.%f %p")
    save(folder / "a.csv", ",".join(titles), day, clock, walk.accel, walk.gyro)


def titles_in_a_comment(folder: Path, walk: ImuSequence) -> None:
    titles = ["# time", *by_axis("acc_#", "gyr_#")]
    save(folder / "imu.txt", " ".join(titles), walk.time, walk.accel, walk.gyro, sep=" ")


def quoted_titles_with_commas(folder: Path, walk: ImuSequence) -> None:
    titles = ["Time, s", *by_axis("Acc #, g", "Gyro #, deg/s")]
    header = ",".join(f'"{title}"' for title in titles)
    columns = walk.accel / STANDARD_GRAVITY, np.degrees(walk.gyro)
    save(folder / "a.csv", header, walk.time, *columns)


def gopro(folder: Path, walk: ImuSequence) -> None:
    """Milliseconds without a unit, dates next to them, and titles of no axis."""
    for name, title, values in (
        ("ACCL", "Accelerometer [m/s2]", walk.accel),
        ("GYRO", "Gyroscope [rad/s]", walk.gyro),
    ):
        columns = 1e3 * walk.time, dates(walk, "%Y-%m-%dT%H:%M:%S.%fZ"), values
        save(folder / f"GX010001-{name}.csv", f'"cts","date","{title}","1","2"', *columns)


def sensor_log(folder: Path, walk: ImuSequence) -> None:
    """An app for iPhones without the attitude: columns as Core Motion names them tell the sign."""
    titles = by_axis("accelerometerAcceleration#(G)", "gyroRotation#(rad/s)")
    columns = -walk.accel / STANDARD_GRAVITY, walk.gyro
    texts = dates(walk, "%Y-%m-%d %H:%M:%S.%f +0200")
    save(folder / "a.csv", ",".join(["loggingTime(txt)", *titles]), texts, *columns)


LOGGERS: dict[str, Callable[[Path, ImuSequence], None]] = {
    write.__name__: write
    for write in (
        shimmer, units_below_the_titles, matlab_mobile, metawear, polar, witmotion, vectornav,
        movella, hyperimu, gopro, microcontroller, date_and_time, titles_in_a_comment,
        quoted_titles_with_commas, sensor_log,
    )
}  # fmt: skip


@pytest.mark.parametrize("logger", LOGGERS)
def test_a_loggers_export_is_read_as_the_walk(logger, walk, tmp_path):
    LOGGERS[logger](tmp_path / "s", walk)
    (found,) = find_recordings(tmp_path / "s")
    assert_same_samples(read_recording(found), walk)


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
