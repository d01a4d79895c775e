import fcntl
from pathlib import Path

import h5py
import numpy as np
import pytest
from alike import assert_upright
from recorded import DATA

from stario.sequences import ReadError, find_recordings, read_recording
from stario.sequences.readers.archive import archive_members

ARCHIVES = DATA / "archives"


def _archive(path: Path) -> Path:
    time = np.arange(50) / 50.0
    with h5py.File(path, "w") as file:
        for name, person in (("a", "ann"), ("b", "bob"), ("c", "ann")):
            group = file.create_group(name)
            group.attrs["person"] = person
            group.attrs["tags"] = ["a", "b"]
            group["imu/t"], group["imu/gyro"] = time, np.zeros((50, 3))
            group["imu/accel"] = np.tile([0.0, 0.0, 9.81], (50, 1))
        file["a/mag/t"], file["a/mag/field"] = time[::5], np.ones((10, 3))
        file["a/truth/t"], file["a/truth/p"] = time, np.ones((50, 3))
        file["a/truth/quat_xyzw"] = np.tile([0.0, 0.0, 0.0, 1.0], (50, 1))
        file["b/truth/t"], file["b/truth/p"] = time, np.ones((50, 3))
        file["c/waypoints/t"], file["c/waypoints/xy"] = [0.1, 0.9], np.ones((2, 2))
    return path


def test_each_recording_has_its_kind_of_truth(tmp_path):
    path = _archive(tmp_path / "walks.h5")
    pose, track, waypoints = (read_recording(found) for found in find_recordings(path))
    assert len(pose.truth) == 50
    assert pose.positions is None
    assert len(pose.magnetometer) == 10
    assert track.truth is None
    assert track.positions.kind == "positions"
    assert track.positions.position_W.shape == (50, 3)
    assert waypoints.positions.kind == "waypoints"
    assert waypoints.positions.position_W.shape == (2, 2)
    assert waypoints.attributes["person"] == "ann"


def test_patterns_lists_and_folders_select_the_same_recordings(tmp_path):
    path = _archive(tmp_path / "walks.h5")
    of_ann = [Path(f"{path}:a"), Path(f"{path}:c")]
    for where in ({"person": ["ann"]}, {"person": ["a*"], "name": ["[ac]"]}):
        assert archive_members(path, where) == of_ann
    assert find_recordings(tmp_path, where={"person": ["ann"]}) == of_ann
    listed = tmp_path / "split.txt"
    listed.write_text('walks.h5:b\nwalks.h5 person=ann name=a  # hers\nwalks.h5 person="ann"\n')
    assert find_recordings(listed) == [Path(f"{path}:b"), *of_ann]
    assert find_recordings(listed, where={"name": ["c"]}) == of_ann[1:]


def test_what_is_not_in_an_archive_is_refused_with_what_is(tmp_path):
    path = _archive(tmp_path / "walks.h5")
    with pytest.raises(ReadError, match=r"person=eve: .* one of ann, bob"):
        find_recordings(path, where={"person": ["eve"]})
    for name, words in ((":d", "'d', .* a, b, c"), ("", r"3 recordings, .*use walks\.h5:a")):
        with pytest.raises(ReadError, match=words):
            read_recording(f"{path}{name}")
    with path.open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(ReadError, match="close it in the program that writes it"):
            read_recording(f"{path}:a")
    with h5py.File(path, "a") as file:
        for group in file.values():
            del group["imu"]
    with pytest.raises(ReadError, match="imu/t: found none in the whole archive"):
        find_recordings(path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["data"] = np.zeros((5, 7))
    with pytest.raises(ReadError, match="recordings: found no group, expected one for each"):
        read_recording(tmp_path / "other.h5", format="archive")
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(ReadError, match=r"walks\.h5: content: .*truncated.*complete"):
        read_recording(path)


@pytest.mark.parametrize(
    ("field", "values", "error"),
    [
        ("imu/gyro", np.zeros((49, 3)), r"gyro: found shape \(49, 3\), expected \(50, 3\)"),
        ("imu/t", [b"now"] * 50, r"imu/t: found .*, expected an array of numbers"),
        ("mag/field", np.ones((9, 3)), r"s field: found shape \(9, 3\), expected \(10, 3\)"),
        ("truth/quat_xyzw", np.ones((50, 3)), r"found shape \(50, 3\), expected \(50, 4\)"),
        ("truth/valid", np.ones(9, dtype=bool), r"valid: found shape \(9,\), expected \(50,\)"),
        ("truth/p", np.full((50, 3), np.nan), "position_W: found a value that is not finite"),
        ("truth/quat_xyzw", np.full((50, 4), np.nan), "row 1, truth/quat_xyzw: .* in truth/valid"),
    ],
)
def test_a_dataset_of_another_shape_or_type_is_named(tmp_path, field, values, error):
    path = _archive(tmp_path / "walks.h5")
    with h5py.File(path, "a") as file:
        if field in file["a"]:
            del file["a"][field]
        file["a"][field] = values
    with pytest.raises(ReadError, match=rf"walks\.h5:a: .*{error}"):
        read_recording(f"{path}:a")


def test_other_groups_and_attributes_are_passed_over(tmp_path):
    path = _archive(tmp_path / "walks.h5")
    with h5py.File(path, "a") as file:
        file["a"].attrs["name"] = "b"  # the name of a recording is that of its group
        file.create_group("Empty")
        file["Notes"] = [1.0, 2.0]
        del file["b/imu/accel"]
        file.create_group("b/imu/accel")
    assert archive_members(path, {"name": ["a"]}) == [Path(f"{path}:a")]
    assert len(find_recordings(path)) == 3
    with pytest.raises(ReadError, match="imu/accel: found no such dataset"):
        read_recording(f"{path}:b")


@pytest.mark.skipif(not ARCHIVES.is_dir(), reason="the development recordings are not here")
def test_mean_specific_force_points_up_in_the_true_frame_of_the_archives():
    for name in ("tyrex.h5:Thibaud_Nexus5_NoDist_Texting", "ridi.h5:dan_bag1", "kipd.h5:07CL"):
        assert_upright(read_recording(ARCHIVES / name), 3.0, 0.4)
