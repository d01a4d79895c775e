"""A set of results takes the place of an earlier one when it is whole, or not at all."""

import errno
from functools import partial
from pathlib import Path

import pytest

from stario.fusion.evaluation.results import RESULTS, Files, write_results
from stario.sequences.errors import InputError
from stario.sequences.files import write_json

NAMES = ("metrics.json", "config.json", "run.json", "walk/health.json")


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def files_of(value: int) -> Files:
    return {name: partial(write_json, obj=value) for name in NAMES}


@pytest.mark.parametrize("failing", NAMES)
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("earlier", [True, False])
def test_a_run_that_fails_at_any_write_leaves_what_was_there(tmp_path, failing, error, earlier):
    out = tmp_path / "out"
    if earlier:
        write_results(out, files_of(1))
        (out / "notes.txt").write_text("mine")
    before = contents(tmp_path)

    def full(path):
        path.write_text("partial")
        raise error

    with pytest.raises((InputError, KeyboardInterrupt)):
        write_results(out, {**files_of(2), failing: full})
    assert contents(tmp_path) == before
    assert list(tmp_path.iterdir()) == ([out] if earlier else [])


def test_a_later_set_replaces_results_and_removes_those_without_a_successor(tmp_path):
    write_results(tmp_path / "out", files_of(1))
    for name in ("walk/plan.png", "walk/filtered.tum", "walk/notes.txt", "other/health.json"):
        path = tmp_path / "out" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("1")
    written = write_results(tmp_path / "out", files_of(2))
    assert written == [tmp_path / "out" / name for name in NAMES]
    kept = {"walk/notes.txt": "1", "other/health.json": "1"}
    new = dict.fromkeys(NAMES, "2\n")
    assert contents(tmp_path) == {f"out/{name}": text for name, text in (kept | new).items()}


def test_a_removal_that_fails_is_named_and_can_be_repeated(tmp_path):
    for mark, names in RESULTS.items():
        for name in (mark, *names):
            (tmp_path / name).touch()
    (tmp_path / "network.npz").unlink()
    (tmp_path / "network.npz").mkdir()
    with pytest.raises(InputError, match=r"network\.npz"):
        write_results(tmp_path, {})
    (tmp_path / "network.npz").rmdir()
    write_results(tmp_path, {})
    assert not list(tmp_path.iterdir())


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="file"):
        write_results(tmp_path / "file" / "out", files_of(1))
