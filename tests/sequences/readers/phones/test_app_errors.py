"""Files and zips that no reader of phone apps takes are refused in one line that names why."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from phone_files import zyx

from stario.sequences import ImuSequence, ReadError, read_recording


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"SQLite format 3\0" + bytes(40), "an SQLite database"),
        (b"PK\x03\x04xl/workbook.xml", "a zip without text files"),
        (b"\x1f\x8b\x08\0\0\0", "compressed with gzip"),
    ],
)
def test_an_unsupported_container_is_named(start: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "export.data").write_bytes(start)
    with pytest.raises(ReadError, match=rf"found [\w ,]*{message}.*; export as CSV"):
        read_recording(tmp_path / "export.data")


def test_two_recordings_in_a_zip_are_named(walk: ImuSequence, tmp_path: Path) -> None:
    zyx(tmp_path / "s", walk, TotalAcceleration=walk.accel, Gyroscope=walk.gyro)
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as file:
        for one in (tmp_path / "s").iterdir():
            file.write(one, f"a/{one.name}")
            file.write(one, f"b/{one.name}")
    expected = r"two\.zip: content: found 2 recordings \(a, b\), expected one; unpack the zip"
    with pytest.raises(ReadError, match=rf"^[^:]*/{expected}$"):
        read_recording(tmp_path / "two.zip")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[{"sensor": "Gyroscope", "time"', r"x\.json: file: found .*, expected JSON"),
        ('[{"sensor": "../up", "time": "1"}]', r"x\.json: sensor: found no name"),
        ('[{"sensor": "Gyroscope", "time": "1"}, 3]', r"found other JSON, expected an array"),
        ('[{"sensor": "Gyroscope", "time": "1"}]', r"x\.json: .*found"),
    ],
)
def test_a_malformed_json_export_is_refused_in_one_line(
    text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ReadError, match=message) as error:
        read_recording(tmp_path / "x.json")
    assert "\n" not in str(error.value)
    assert "stario-" not in str(error.value)
