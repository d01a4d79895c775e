from pathlib import Path

import pytest
from published_formats import tumvi
from recorded import DATA
from walked import walked

from stario.sequences import PHONE_IMU, InputError, ReadError, simulate_imu
from stario.sequences.readers import find_recordings, is_list, read_recording, write_csv
from stario.sequences.simulation.walks import generate_walk


@pytest.fixture(scope="module")
def walk():
    return walked(4, 40.0, rate=200.0, carry="handheld", preferred_speed=1.0)


def test_euroc_is_found_by_folder_mav0_and_file_without_the_poses_of_others(tmp_path, walk):
    tumvi(tmp_path / "room", walk)
    for inner in ("", "mav0", "mav0/imu0/data.csv"):
        read = read_recording(tmp_path / "room" / inner)
        assert read.name == "room"
        assert read.truth is not None
    (tmp_path / "room/mav0/mocap0").rename(tmp_path / "room/mav0/vicon0")
    assert read_recording(tmp_path / "room").truth is None


def test_a_gap_in_the_truth_stays_a_gap(tmp_path, walk):
    tumvi(tmp_path, walk)
    file = tmp_path / "mav0/mocap0/data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:1001], *lines[1501:]]))
    known = read_recording(tmp_path).truth.at(walk.time).valid
    start, stop = walk.time[40], walk.time[-62]
    lost = (walk.time > start + 9.991) & (walk.time < start + 14.999)
    assert not known[lost | (walk.time < start - 0.001) | (walk.time > stop + 0.01)].any()
    assert known[~lost & (walk.time > start + 0.001) & (walk.time < stop - 0.02)].all()


@pytest.mark.parametrize(
    ("corrupt", "message"),
    [
        (lambda lines: [row.rsplit(",", 1)[0] for row in lines], "line 2: found 6 values"),
        (lambda lines: [*lines[:9], lines[9].replace(".", "x", 1)], "line 10, column 2: found '"),
        (lambda lines: [*lines[:9], "nan" + lines[9][19:]], "line 10, time: found 'nan'"),
    ],
)
def test_malformed_files_are_named(tmp_path, walk, corrupt, message):
    tumvi(tmp_path, walk)
    imu = tmp_path / "mav0/imu0/data.csv"
    imu.write_text("\n".join(corrupt(imu.read_text().splitlines())))
    with pytest.raises(ReadError, match=rf"imu0/data\.csv: {message}"):
        read_recording(tmp_path)


def test_unknown_content_is_shown_with_where_to_find_the_known_formats(tmp_path):
    path = tmp_path / "imu.csv"
    for text, seen in (
        ("0.0,1,2,3,4,5,6\n", "0.0,1,2,3,4,5,6"),
        ("PK\x00\x01", "no line of text"),
        ("", "no line of text"),
        ("seconds;speed\n", "seconds;speed"),
    ):
        path.write_text(text)
        with pytest.raises(ReadError, match=f"{seen}.*--help"):
            read_recording(path)
    for name, options, words in (
        ("none.csv", {}, "no such file"),
        ("", {}, r"a folder with imu\.csv; imu\.csv holds 'seconds;"),
        ("imu.csv", {"format": "bags"}, r"format: found 'bags', .* auto, archive, ronin, .*, csv"),
    ):
        with pytest.raises(InputError, match=words):
            read_recording(tmp_path / name, **options)


def test_find_recordings_searches_folders_in_order(tmp_path, walk):
    for form in ("syn", "raw"):
        (tmp_path / "b/data1" / form).mkdir(parents=True)
        write_csv(tmp_path / "b/data1" / form / "imu1.csv", walk)
    tumvi(tmp_path / "a", walk)
    write_csv(tmp_path / "c.csv", walk)
    (tmp_path / "notes.csv").write_text("day,who\n1,me\n")
    (tmp_path / ".hidden").mkdir()
    write_csv(tmp_path / ".hidden/d.csv", walk)
    found = [tmp_path / name for name in ("a", "b/data1/syn/imu1.csv", "c.csv")]
    assert find_recordings(tmp_path) == found
    for path in found:
        assert find_recordings(str(path)) == [path]
    (tmp_path / "nothing").mkdir()
    with pytest.raises(ReadError, match="a folder with nothing"):
        find_recordings(tmp_path / "nothing")
    with pytest.raises(ReadError, match="no such file"):
        find_recordings(tmp_path / "none")


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
