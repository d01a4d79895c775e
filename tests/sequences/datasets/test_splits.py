import importlib.resources
from pathlib import Path

import pytest

from stario.network.training.splits import NAMES, listed
from stario.sequences.datasets.splits import (
    OFFICIAL,
    leave_out,
    official_split,
    random_split,
    read_list,
)
from stario.sequences.errors import InputError, ReadError, StarioError
from stario.sequences.readers import find_recordings

ROW = "t,gx,gy,gz,ax,ay,az\n0.0,0.1,0.2,0.3,1.0,2.0,9.0\n"
PHONE = ",".join(["1.5e11", *["0.1"] * 6, "0,0,-1", *["0.1"] * 6]) + "\n"


def ronin(root: Path, *names: str) -> None:
    for name in names:
        (root / name).mkdir(parents=True)
        (root / name / "data.hdf5").touch()


def phone(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(PHONE)
    return path


def test_the_papers_split_is_by_recording_and_by_seed() -> None:
    paths = [Path(f"{k:02d}.csv") for k in range(40)]
    split = random_split(paths, seed=7)
    assert [len(split.training), len(split.validation), len(split.test)] == [32, 4, 4]
    assert sorted([*split.training, *split.validation, *split.test]) == paths
    assert random_split(reversed(paths), seed=7) == split
    assert random_split(paths, seed=8) != split
    few = random_split(paths[:3], seed=0)
    assert [len(few.training), len(few.validation), len(few.test)] == [1, 1, 1]
    with pytest.raises(InputError, match="at least 3"):
        random_split(paths[:2], seed=0)


def test_ronins_lists_stand_in_a_folder_of_their_own(tmp_path: Path) -> None:
    ronin(tmp_path / "train_dataset_1", "a000_1", "a001_2")
    ronin(tmp_path / "unseen_subjects_test_set", "a006_2")
    (tmp_path / "lists").mkdir()
    (tmp_path / "lists/list_train.txt").write_text("# names\na001_2\na000_1\n\n")
    (tmp_path / "lists/list_test_unseen.txt").write_text("a006_2\n")
    train = official_split("ronin", tmp_path, "training")
    assert train == [tmp_path / "train_dataset_1" / name for name in ("a001_2", "a000_1")]
    unseen = official_split("ronin", tmp_path, "test_unseen")
    assert unseen == [tmp_path / "unseen_subjects_test_set/a006_2"]
    with pytest.raises(ReadError, match=r"list_val\.txt: found no such list"):
        official_split("ronin", tmp_path, "validation")


def test_ridis_lines_carry_a_type(tmp_path: Path) -> None:
    for name in ("dan_body3", "ma_handheld2"):
        (tmp_path / name / "processed").mkdir(parents=True)
        (tmp_path / name / "processed/data.csv").write_text("time,rv_w,rv_x,grav_x\n")
    text = "# test\ndan_body3,body\n#dan_leg2,leg\nma_handheld2,handheld # good\n"
    (tmp_path / "list_test_publish_v2.txt").write_text(text)
    found = official_split("ridi", tmp_path, "test")
    assert found == [tmp_path / "dan_body3", tmp_path / "ma_handheld2"]


def test_oxiod_has_lists_for_each_carriage(tmp_path: Path) -> None:
    """Entries are files without their folder `syn`, or whole folders; carriages stay apart."""
    handheld = [phone(tmp_path / f"handheld/data1/syn/imu{k}.csv") for k in (1, 2)]
    phone(tmp_path / "handheld/data1/raw/imu1.csv")
    other = [phone(tmp_path / f"handheld/data5/syn/imu{k}.csv") for k in (1, 2)]
    pocket = phone(tmp_path / "pocket/data1/syn/imu1.csv")
    (tmp_path / "handheld/Train.txt").write_text("data1/imu2.csv\n")
    (tmp_path / "handheld/Test.txt").write_text("data5\n")
    (tmp_path / "pocket/Train.txt").write_text("data1\n")
    assert official_split("oxiod", tmp_path, "training") == [handheld[1], pocket]
    assert official_split("oxiod", tmp_path, "test") == other
    (tmp_path / "handheld/Train.txt").write_text("data7\n")
    with pytest.raises(ReadError, match="line 1: found data7, not there"):
        official_split("oxiod", tmp_path, "training")


def test_rnin_and_tlio(tmp_path: Path) -> None:
    for name in ("data_train/0", "data_train/10", "data_val/0"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "SenseINS.csv").touch()
    assert [p.name for p in official_split("rnin", tmp_path, "training")] == ["0", "10"]
    assert official_split("rnin", tmp_path, "validation") == [tmp_path / "data_val/0"]
    (tmp_path / "1108").mkdir()
    (tmp_path / "1108/imu0_resampled.npy").touch()
    (tmp_path / "val_list.txt").write_text("1108\n")
    assert official_split("tlio", tmp_path, "validation") == [tmp_path / "1108"]


def test_unknown_names_are_told() -> None:
    with pytest.raises(InputError, match="found 'kitti', expected one of ronin"):
        official_split("kitti", Path(), "test")
    with pytest.raises(InputError, match="found 'test', expected one of training, validation"):
        official_split("ronin", Path(), "test")
    assert all(OFFICIAL.values())


def test_a_list_of_any_mixture_is_read(tmp_path: Path) -> None:
    ronin(tmp_path, "a000_1")
    (tmp_path / "own.csv").write_text(ROW)
    imu = phone(tmp_path / "handheld/data1/syn/imu1.csv")
    (tmp_path / "mine.txt").write_text("a000_1\nown.csv\nhandheld\nown.csv\n")
    found = find_recordings(tmp_path / "mine.txt")
    assert found == [tmp_path / "a000_1", tmp_path / "own.csv", imu]


def test_wrong_entries_are_named_and_the_others_kept(tmp_path: Path) -> None:
    (tmp_path / "own.csv").write_text(ROW)
    (tmp_path / "empty").mkdir()
    path = tmp_path / "list.txt"
    path.write_text("own.csv\n\n,handheld\ngone.csv\nempty\nlist.txt\n# end\n")
    with pytest.raises(ReadError, match=r"list\.txt: line 2: found an empty entry"):
        find_recordings(path)
    errors: list[StarioError] = []
    assert find_recordings(path, errors.append) == [tmp_path / "own.csv"]
    told = [str(error).removeprefix(str(tmp_path)) for error in errors]
    assert [text.split(", expected")[0] for text in told] == [
        "/list.txt: line 2: found an empty entry",
        "/list.txt: line 3: found an empty entry",
        "/list.txt: line 4: found gone.csv, not there",
        "/empty: folder: found no recording",
        "/list.txt: list: found the list list.txt",
    ]
    path.write_text("# nothing\n\n")
    with pytest.raises(ReadError, match="no entry"):
        find_recordings(path)


def test_lists_name_recordings_below_a_folder_and_their_groups(tmp_path: Path) -> None:
    for name in ("a.csv", "walks.h5"):
        (tmp_path / name).touch()
    file = tmp_path / "list.txt"
    file.write_text("# who, where\na.csv, home anna\nwalks.h5:one, home bo\nwalks.h5:two\n\n")
    found = read_list(file, tmp_path)
    assert [one.path for one in found] == [
        tmp_path / name for name in ("a.csv", "walks.h5:one", "walks.h5:two")
    ]
    assert [one.group for one in found] == ["home anna", "home bo", ""]
    assert found[0].within("home")
    assert not found[0].within("home an")
    outside, inside = leave_out(found, "home")
    assert [one.path.name for one in outside] == ["walks.h5:two"]
    assert len(inside) == 2
    assert listed(str(file), tmp_path) == found
    with pytest.raises(InputError, match="home anna"):
        leave_out(found, "office")
    (tmp_path / "a.csv").unlink()
    with pytest.raises(InputError, match="--data"):
        read_list(file, tmp_path)


def test_the_packages_lists_hold_groups_apart() -> None:
    folder = importlib.resources.files("stario.network.training.splits")
    names = {}
    for name in NAMES:
        lines = folder.joinpath(f"{name}.txt").read_text().splitlines()
        names[name] = dict(line.split(", ") for line in lines if not line.startswith("#"))
    assert len(names["test"]) == len(names["validation"]) == 4
    assert not set(names["test"]) & set(names["all"])
    held = set(names["holdout"])
    assert held < set(names["all"])
    assert not held & set(names["training"])
    assert set(names["open"]) < set(names["all"])
    assert not any(word in name for name in names["open"] for word in ("ridi", "kipd", "rocip"))
    kept = {group for name, group in names["all"].items() if name not in held}
    for group in ("tyrex Thibaud", "ridi dan", "ridi huayi", "kipd yk", "ilc site2 F1"):
        assert group in names["holdout"].values()
        assert group not in kept
