from pathlib import Path

import pytest
from recorded import DATA

from stario.sequences import PHONE_IMU, generate_walk, simulate_imu
from stario.sequences.readers import find_recordings, is_list, read_recording, write_csv

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}")


def test_folders_without_permission_are_passed_over(tmp_path, monkeypatch):
    listed = Path.iterdir

    def iterdir(folder):
        if folder.name == "private":
            raise PermissionError(13, "Permission denied")
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    (tmp_path / "private").mkdir()
    (tmp_path / "own.csv").write_text("t,gx,gy,gz,ax,ay,az\n0.0,0.1,0.2,0.3,1.0,2.0,9.0\n")
    assert find_recordings(tmp_path) == [tmp_path / "own.csv"]


@needs_data
def test_every_recording_is_found():
    assert sum(len(find_recordings(DATA / name)) for name in ("oxiod", "tumvi", "euroc")) == 18
    assert len(find_recordings(DATA / "archives")) == 1180


def test_a_text_file_with_rows_of_numbers_is_not_a_list(tmp_path):
    """Whatever its header and separator: each row would name a recording that does not exist."""
    path = tmp_path / "samples.txt"
    for mark in ",;\t ":
        rows = [mark.join(["0.0", "1", "2"]), mark.join(["0.1", "1", "2"])]
        path.write_text("\n".join(["# logger", mark.join(["s", "x", "y"]), *rows]))
        assert not is_list(path)
    path.write_text("a000_1\n145820422949970\n")
    assert is_list(path)


@pytest.mark.parametrize("stem", ["walk_{}", "{}", "{}_1"])
def test_recordings_named_by_letters_are_not_the_sensors_of_one(stem, tmp_path):
    """Letters a, b, g and m also name the accelerometer, magnetometer and gyroscope."""
    walk = simulate_imu(generate_walk(4, 14.0), rate=200.0, errors=PHONE_IMU)
    for number, letter in enumerate("abgm"):
        shorter = walk.slice(0.0, 10.0 + number)
        write_csv(tmp_path / f"{stem.format(letter)}.csv", shorter)
    found = [read_recording(path) for path in find_recordings(tmp_path)]
    assert [round(one.duration) for one in found] == [10, 11, 12, 13]
    assert all(one.source == "generic CSV" and one.magnetometer is None for one in found)


def test_a_copy_of_a_recording_is_named(walk, tmp_path, caplog):
    for name in ("walk", "walk (1)"):
        write_csv(tmp_path / f"{name}.csv", walk)
    write_csv(tmp_path / "other.csv", walk.select(slice(1, None)))
    assert len(find_recordings(tmp_path)) == 3
    [told] = [record.getMessage() for record in caplog.records]
    assert told == (
        f"{tmp_path / 'walk (1).csv'}: the same recording as {tmp_path / 'walk.csv'}: remove one"
    )
