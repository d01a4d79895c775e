import pytest
from published_formats import tumvi

from stario.sequences import PHONE_IMU, InputError, ReadError, simulate_imu
from stario.sequences.readers import find_recordings, read_recording, write_csv
from stario.sequences.simulation.walks import WalkStyle, generate_walk


@pytest.fixture(scope="module")
def walk():
    style = WalkStyle(carry="handheld", preferred_speed=1.0)
    return simulate_imu(generate_walk(4, 40.0, style=style), rate=200.0, errors=PHONE_IMU)


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
