from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from csv_lines import write_lines

from stario.sequences import InputError, ReadError, check_units, read_recording
from stario.sequences.readers.text import with_seconds

NOON = datetime(2024, 5, 1, 12, 34, 56, 789000)
LATE = datetime(2024, 12, 31, 23, 59, 59, 500000)
GENERIC = "time,gx,gy,gz,ax,ay,az"
WIDE = (
    "Datetime;Gyroscope X;Gyroscope Y;Gyroscope Z;Accelerometer X;Accelerometer Y;Accelerometer Z"
)


def written(path: Path, header: str, form: str, start: datetime, count: int = 200) -> Path:
    separator = max(",;", key=header.count)
    times = [(start + timedelta(milliseconds=10 * k)).strftime(form) for k in range(count)]
    rows = [separator.join([time, "0.1", "0.2", "0.3", "1", "2", "9.5"]) for time in times]
    return write_lines(path, header, *rows)


@pytest.mark.parametrize(("header", "start"), [(GENERIC, LATE), (WIDE, NOON)])
@pytest.mark.parametrize(
    "form",
    [
        "%H:%M:%S.%f",
        "%H:%M:%S:%f",
        "%I:%M:%S.%f %p",
        "%Y-%m-%d %H:%M:%S.%f UTC",
        "%Y-%m-%dT%H:%M:%S.%f+00:00",
        "%Y-%m-%dT%H:%M:%S.%f+02",
        "%Y-%m-%d_%H:%M:%S.%f",
        "%Y-%m-%d %H:%M:%S.%f GMT+02:00",
        "%Y-%m-%d %H:%M:%S.%f -0330",
        "%Y/%m/%d %H:%M:%S.%f",
        "%d-%b-%Y %H:%M:%S.%f",
        "%d.%m.%Y %H:%M:%S.%f",
        "%d/%m/%y %H:%M:%S.%f",
        "%m/%d/%Y %H:%M:%S.%f",
    ],
)
def test_times_are_read_with_any_date_and_zone(tmp_path, header, start, form):
    read = read_recording(written(tmp_path / "own.csv", header, form, start))
    np.testing.assert_allclose(read.time, 0.01 * np.arange(200), atol=1e-9)
    np.testing.assert_allclose(read.gyro[-1], [0.1, 0.2, 0.3])


@pytest.mark.parametrize("header", [GENERIC, WIDE])
def test_days_of_a_spreadsheet_are_times(tmp_path, header):
    """Days since the end of 1899; ten decimals are eight microseconds."""
    separator = max(",;", key=header.count)
    days = [f"{45413.524268391 + 0.01 * k / 86400.0:.10f}" for k in range(200)]
    rows = [separator.join([day, "0.1", "0.2", "0.3", "1", "2", "9.5"]) for day in days]
    read = read_recording(write_lines(tmp_path / "own.csv", header, *rows))
    np.testing.assert_allclose(read.time, 0.01 * np.arange(200), atol=2e-5)
    assert "taken as" not in read.source


def test_zones_give_the_same_instant_and_midnight_passes_in_every_column_and_for_late_rows():
    noon = "1714564800.5"
    for text in ("2024-05-01T12:00:00.5Z", "2024-05-01 14:00:00.5 +02:00", "2024/05/01 12:00:00.5",
                 "2024-05-01 08:30:00.5 GMT-0330", "01-May-2024 12:00:00.5",
                 "2024-05-01_14:00:00.5+02"):  # fmt: skip
        assert with_seconds([text]) == [noon]
    lines = ["23:59:59.9,23:59:58.9", "00:00:00.1,23:59:59.1", "23:59:59.95,00:00:00.1"]
    first, second = np.array([[float(x) for x in row.split(",")] for row in with_seconds(lines)]).T
    np.testing.assert_allclose(first - first[0], [0.0, 0.2, 0.05], atol=1e-9)
    np.testing.assert_allclose(second - second[0], [0.0, 0.2, 1.2], atol=1e-9)


@pytest.mark.parametrize("header", [GENERIC, WIDE])
@pytest.mark.parametrize("digits", [14, 17])
def test_dates_without_separators_are_refused(tmp_path, header, digits):
    """Taken for a number, the time would jump by 40 s at each full minute."""
    path = written(tmp_path / "own.csv", header, "%Y%m%d%H%M%S%f", NOON)
    lines = path.read_text().splitlines()
    cut = [line[:digits] + line[20:] for line in lines[1:]]
    write_lines(path, lines[0], *cut)
    message = r"found 20240501123456\d*, a date without separators"
    with pytest.raises(ReadError, match=message):
        read_recording(path)
    write_lines(path, lines[0], *cut, "inf" + cut[5][digits:])
    with pytest.raises(ReadError, match=message):
        read_recording(path)


@pytest.mark.parametrize(
    ("lines", "seconds"),
    [
        ("12:00:00:5 12:00:00:15 12:00:00:105 12:00:01:0 12:00:02", [0.0, 0.01, 0.1, 0.995, 1.995]),
        ("12:00:00:05 12:00:00:95", [0.0, 0.9]),
    ],
)
def test_milliseconds_after_a_colon_may_lack_zeros(lines, seconds):
    time = np.array(with_seconds(lines.split()), dtype=np.float64)
    np.testing.assert_allclose(time - time[0], seconds, atol=1e-9)


def test_what_is_no_part_of_a_time_stays_as_it_is():
    for text in ("24:60:00", "2024-13-01 12:00:00", "01-Foo-2024 12:00:00"):
        assert with_seconds([text]) == [text]
        assert with_seconds([f"D4:22:CD:{text[-8:]}"]) == [f"D4:22:CD:{text[-8:]}"]
    assert with_seconds(["12:00:00.5 -12 3"])[0].endswith(".5 -12 3")
    assert with_seconds(["00:00:01,5,6"])[0].endswith(",5,6")


def test_a_comma_before_fractions_that_separates_cells_is_refused(tmp_path):
    """As Python's logging writes times: all values would be read from the column to their left."""
    rows = [f"2024-05-01 12:00:0{k // 100},{10 * k % 1000:03d},0,0,0,0,0,9" for k in range(200)]
    path = write_lines(tmp_path / "own.csv", GENERIC, *rows)
    with pytest.raises(ReadError, match=r"line 2: found 8 values, expected 7 .* decimal points"):
        read_recording(path)
    write_lines(path, GENERIC, *(row.replace(",", ".", 1) for row in rows))
    assert read_recording(path).rate == pytest.approx(100.0)


def test_a_date_beside_the_time_leaves_the_unit_of_the_time(tmp_path):
    rows = [f"2024-05-01 12:00:00,{10 * k},0.1,0.2,0.3,1,2,9" for k in range(200)]
    path = write_lines(tmp_path / "own.csv", "date,t [ms],gx,gy,gz,ax,ay,az", *rows)
    assert read_recording(path).rate == pytest.approx(100.0)


def test_times_in_whole_seconds_are_refused(tmp_path):
    path = written(tmp_path / "own.csv", GENERIC, "%H:%M:%S", NOON, 500)
    with pytest.raises(InputError, match="export them with fractions of a second"):
        check_units(read_recording(path))
    bad = path.read_text().replace("12:34:58", "12:34:98")
    path.write_text(bad)
    with pytest.raises(ReadError, match=r"own\.csv: line \d+, time: found '12:34:98'"):
        read_recording(path)
