import zipfile
from pathlib import Path

import numpy as np
import pytest
from csv_lines import ROW, write_lines

from stario.sequences import ReadError, find_recordings, read_recording
from stario.sequences.readers.columns import HEADER

ROWS = [f"{0.01 * k:.2f},{ROW}" for k in range(6)]


def phone(folder: Path, gyro: list[str], accel: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, rows in (("Gyroscope", gyro), ("Accelerometer", accel)):
        write_lines(folder / f"{name}.csv", "time,x,y,z", *rows)
    return folder


def phone_rows(cells: str = "0.1,0.2,9.5", count: int = 60) -> list[str]:
    return [f"{0.02 * k:.2f},{cells}" for k in range(count)]


def test_a_zip_is_recognised_by_its_content(tmp_path):
    with zipfile.ZipFile(tmp_path / "download", "w") as file:
        file.writestr("walk.csv", "\n".join([HEADER, *ROWS]))
    assert len(read_recording(tmp_path / "download")) == len(ROWS)


@pytest.mark.parametrize("missing", ["", "NA", "n/a", "NULL"])
def test_cells_without_a_value_are_blank(tmp_path, missing):
    header = f"{HEADER},mx [uT],my [uT],mz [uT]"
    rows = [f"{row},{missing},{missing},{missing}" for row in ROWS]
    rows[3] = f"{ROWS[3]},1,2,3"
    rows.insert(3, ",".join(["0.025", *[missing] * 6, "4", "5", "6"]))
    read = read_recording(write_lines(tmp_path / "own.csv", header, *rows))
    assert len(read) == len(ROWS)
    assert read.magnetometer.field.tolist() == [[4, 5, 6], [1, 2, 3]]


@pytest.mark.parametrize("cell", ["9", "9.", "", "-"])
def test_a_last_cell_cut_within_its_digits_is_skipped(tmp_path, cell):
    last = f"0.06,{ROW.rsplit(',', 1)[0]},{cell}"
    path = tmp_path / "own.csv"
    path.write_text("\n".join([HEADER, *ROWS, last]))
    assert len(read_recording(path)) == len(ROWS)
    path.write_text("\n".join([HEADER, *ROWS, f"0.06,{ROW}"]))  # whole, but without a line end
    assert len(read_recording(path)) == len(ROWS) + 1
    folder = phone(tmp_path / "phone", phone_rows(), phone_rows())
    for name in ("Gyroscope", "Accelerometer"):
        with (folder / f"{name}.csv").open("a") as file:
            file.write(f"1.20,0.1,0.2,{cell}")
    read = read_recording(folder)
    assert len(read) == 60
    assert np.allclose(read.accel, [0.1, 0.2, 9.5])


@pytest.mark.parametrize("cell", ["", "nan", "NA"])
def test_a_blank_cell_of_a_phones_sensor_loses_only_its_sample(tmp_path, cell, caplog):
    gyro, accel = phone_rows(), phone_rows()
    gyro[20] = f"0.40,0.1,{cell},9.5"
    accel[30] = f"0.60,{cell},0.2,9.5"
    read = read_recording(phone(tmp_path / "phone", gyro, accel))
    assert len(read) == 59
    assert 0.4 not in read.time.round(6)
    assert np.allclose(read.accel, [0.1, 0.2, 9.5])
    assert "Gyroscope.csv: dropped 1 samples of the gyro with a blank cell" in caplog.text


def test_thousands_are_not_taken_for_fractions(tmp_path):
    rows = [f'"{time}",0.1,0.2,0.3,1.5,2.5,9.25' for time in ("995", "1,000", "1,005")]
    with pytest.raises(ReadError, match="line 3, t"):
        read_recording(write_lines(tmp_path / "own.csv", HEADER.replace("t [s]", "t [ms]"), *rows))


@pytest.mark.parametrize("cut", ["0.06,0.1", ""])
@pytest.mark.parametrize("zeros", [7, 40_000])
def test_zeros_left_by_a_loss_of_power_are_skipped(tmp_path, cut, zeros, caplog):
    text = "\n".join([HEADER, *ROWS, cut]).encode()
    path = tmp_path / "own.csv"
    path.write_bytes(text + bytes(zeros))
    assert find_recordings(path) == [path]
    assert len(read_recording(path)) == len(ROWS)
    assert f"own.csv: skipped {zeros} zero bytes at the end" in caplog.text
    folder = phone(tmp_path / "phone", phone_rows(), phone_rows())
    with (folder / "Gyroscope.csv").open("ab") as file:
        file.write(cut.encode() + bytes(zeros))
    assert len(read_recording(folder)) == 60
    path.write_bytes(text + bytes(3) + b"\n" + text)
    with pytest.raises(ReadError, match="binary data"):
        read_recording(path, format="csv")
