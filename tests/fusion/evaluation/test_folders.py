"""A set of results takes the place of an earlier one when it is whole, or not at all."""

import errno
from pathlib import Path

import pytest

from stario.fusion.evaluation.folders import results_folder
from stario.sequences.errors import InputError
from stario.sequences.files import write_json


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def write_set(folder: Path, value: int) -> None:
    with results_folder(folder) as new:
        for name in ("metrics.json", "config.json", "run.json"):
            write_json(new / name, value)
        with results_folder(new / "walk") as inner:
            write_json(inner / "health.json", value)


@pytest.mark.parametrize("failing", range(4))
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("earlier", [True, False])
def test_a_run_that_fails_at_any_write_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int, error: Exception, earlier: bool
) -> None:
    out = tmp_path / "out"
    if earlier:
        write_set(out, 1)
        (out / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    calls = iter(range(4))

    def full(path: Path, value: object) -> None:
        path.write_text("partial")
        if next(calls) == failing:
            raise error

    monkeypatch.setattr(f"{__name__}.write_json", full)
    with pytest.raises((InputError, KeyboardInterrupt)):
        write_set(out, 2)
    assert contents(tmp_path) == before
    assert list(tmp_path.iterdir()) == ([out] if earlier else [])


def test_a_later_set_replaces_results_and_removes_those_without_a_successor(tmp_path: Path) -> None:
    write_set(tmp_path / "out", 1)
    for name in ("walk/plan.png", "walk/filtered.tum", "walk/notes.txt", "other/health.json"):
        path = tmp_path / "out" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("1")
    write_set(tmp_path / "out", 2)
    kept = {"walk/notes.txt": "1", "other/health.json": "1"}
    new = dict.fromkeys(("metrics.json", "config.json", "run.json", "walk/health.json"), "2\n")
    assert contents(tmp_path) == {f"out/{name}": text for name, text in (kept | new).items()}
