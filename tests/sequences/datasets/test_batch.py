import importlib.resources
import os
import time
from pathlib import Path

import pytest
from joblib import parallel_config

from stario.network.training.splits import NAMES, read_packaged_list
from stario.sequences import InputError, ReadError, find_recordings
from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.datasets.splits import hold_out_group, random_split, read_list


@pytest.mark.parametrize("jobs", [None, 1, 2])
def test_a_failing_item_is_skipped_with_its_reason(jobs):
    """The errors take arguments of their own, with which plain pickling between processes fails."""

    def halve(number):
        if number % 2:
            raise InputError("number", str(number), "an even one")
        return number // 2

    odd = Skipped("3", "number: found 3, expected an even one")
    outcomes = list(each(halve, [2, 3, 8], jobs))
    assert outcomes == [1, odd, 4]
    skipped = []
    assert list(without_skipped(outcomes, skipped)) == [1, 4]
    assert skipped == [odd]


def test_results_are_yielded_one_by_one_and_an_exception_costs_one(caplog):
    processed = []

    def record(number):
        processed.append(number)
        return number

    results = each(record, range(10))
    assert next(results) == 0
    assert len(processed) < 10
    assert list(results) == list(range(1, 10))
    outcomes = list(each(lambda number: 1 // number, [1, 0, -1]))
    assert outcomes[::2] == [1, -1]
    assert outcomes[1].reason.startswith("ZeroDivisionError")
    assert "Traceback" in caplog.text


def double(number: int) -> int:
    return 2 * number


def test_a_backend_that_returns_nothing_before_the_end_works_too():
    """Like Ray's; joblib's own backend of this kind runs processes without loky."""
    with parallel_config("multiprocessing"):
        assert list(each(double, [1, 2, 3], 2)) == [2, 4, 6]


def test_several_jobs_run_in_separate_processes():
    def process(delay):
        time.sleep(delay)
        return os.getpid()

    assert os.getpid() not in set(each(process, [0.2] * 4, 2))
    assert set(each(process, [0.0], 1)) == {os.getpid()}


ROW = "t,gx,gy,gz,ax,ay,az\n0.0,0.1,0.2,0.3,1.0,2.0,9.0\n"


def test_the_papers_split_is_by_recording_and_reproducible_by_seed():
    paths = [Path(f"{k:02d}.csv") for k in range(40)]
    split = random_split(paths, seed=7)
    assert [len(split.training), len(split.validation), len(split.test)] == [32, 4, 4]
    assert sorted([*split.training, *split.validation, *split.test]) == paths
    assert random_split(reversed(paths), seed=7) == split
    assert random_split(paths, seed=8) != split
    few = random_split(paths[:3], seed=0)
    assert [len(few.training), len(few.validation), len(few.test)] == [1, 1, 1]


def test_a_list_may_mix_formats_folders_and_duplicates(tmp_path):
    imu = tmp_path / "handheld/data1/syn/imu1.csv"
    for folder in (tmp_path / "a000_1", imu.parent):
        folder.mkdir(parents=True)
    (tmp_path / "a000_1/data.hdf5").touch()
    imu.write_text(",".join(["1.5e11", *["0.1"] * 6, "0,0,-1", *["0.1"] * 6]) + "\n")
    (tmp_path / "own.csv").write_text(ROW)
    (tmp_path / "mine.txt").write_text("a000_1\nown.csv\nhandheld\nown.csv\n")
    found = find_recordings(tmp_path / "mine.txt")
    assert found == [tmp_path / "a000_1", tmp_path / "own.csv", imu]


def test_wrong_entries_are_named_and_the_others_kept(tmp_path):
    (tmp_path / "own.csv").write_text(ROW)
    (tmp_path / "empty").mkdir()
    path = tmp_path / "list.txt"
    path.write_text("own.csv\n\n,handheld\ngone.csv\nempty\nlist.txt\n# end\n")
    with pytest.raises(ReadError, match=r"list\.txt: line 3: found an empty entry"):
        find_recordings(path)
    errors = []
    assert find_recordings(path, errors.append) == [tmp_path / "own.csv"]
    messages = [str(error).removeprefix(str(tmp_path)) for error in errors]
    assert [text.split(", expected")[0] for text in messages] == [
        "/list.txt: line 3: found an empty entry",
        "/list.txt: line 4: found 'gone.csv', which does not exist",
        "/empty: content: found a folder with nothing",
        "/list.txt: list: found another list, list.txt",
    ]
    path.write_text("# nothing\n\n")
    with pytest.raises(ReadError, match="no entry"):
        find_recordings(path)


def test_a_text_of_something_else_is_one_error(tmp_path):
    """A log of a serial port, or a list of a hundred recordings next to another data folder."""
    path = tmp_path / "serial.txt"
    path.write_text("".join(f"t: {k} ax: 0.1 ay: 0.2 az: 9.8\n" for k in range(100)))
    errors = []
    with pytest.raises(ReadError, match=r"100 lines .* such as t: 0 "):
        find_recordings(path, errors.append)
    assert errors == []


def test_lists_name_recordings_below_a_folder_and_their_groups(tmp_path):
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
    outside, inside = hold_out_group(found, "home")
    assert [one.path.name for one in outside] == ["walks.h5:two"]
    assert len(inside) == 2
    assert read_packaged_list(str(file), tmp_path) == found
    with pytest.raises(InputError, match="home anna"):
        hold_out_group(found, "office")
    (tmp_path / "a.csv").unlink()
    with pytest.raises(InputError, match="--data"):
        read_list(file, tmp_path)


def test_the_packaged_lists_keep_groups_apart():
    folder = importlib.resources.files("stario.network.training.splits")
    names = {}
    for name in NAMES:
        lines = folder.joinpath(f"{name}.txt").read_text().splitlines()
        names[name] = dict(line.split(", ") for line in lines if not line.startswith("#"))
    assert len(names["test"]) == len(names["validation"]) == 4
    assert not set(names["test"]) & set(names["all"])
    held_out = set(names["holdout"])
    assert held_out < set(names["all"])
    assert not held_out & set(names["training"])
    assert set(names["open"]) < set(names["all"])
    assert not any(word in name for name in names["open"] for word in ("ridi", "kipd", "rocip"))
    kept = {group for name, group in names["all"].items() if name not in held_out}
    for group in ("tyrex Thibaud", "ridi dan", "ridi huayi", "kipd yk", "ilc site2 F1"):
        assert group in names["holdout"].values()
        assert group not in kept
