"""Whole sets and groups that are left out of a training."""

from pathlib import Path

import pytest

from stario.fusion.commands import evaluate
from stario.fusion.commands.training_data import packaged_lists
from stario.network.training import splits
from stario.network.training.splits import read_packaged_list
from stario.sequences.readers.archive import split_name


def test_what_is_left_out_is_neither_learned_from_nor_selected_on(tmp_path: Path) -> None:
    for line in _names():
        file = split_name(tmp_path / line)[0]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    entries = read_packaged_list("all", tmp_path)
    groups = {entry.path: entry.group for entry in entries}

    learned, selected = packaged_lists(tmp_path, ["tyrex", "ridi dan"], "all")

    used = {groups[path] for path in learned + selected}
    assert not {g for g in used if g.startswith("tyrex")} | ({"ridi dan"} & used)
    holdout = {entry.path for entry in read_packaged_list("holdout", tmp_path)}
    assert set(selected) <= holdout
    assert not set(learned) & holdout
    left_out = sum(g.startswith("tyrex") or g == "ridi dan" for g in groups.values())
    assert len(learned) + len(selected) == len(entries) - left_out


def _names() -> list[str]:
    lists = Path(splits.__file__).parent / "all.txt"
    lines = lists.read_text().splitlines()
    return [line.partition(",")[0] for line in lines if line and not line.startswith("#")]


def test_set_in_the_name_of_weights_is_the_first_word_of_a_group(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(evaluate, "_loaded", loaded.append)

    evaluate._for_group("runs/{set}/{group}.safetensors", "ridi dan")

    assert loaded == ["runs/ridi/ridi_dan.safetensors"]
