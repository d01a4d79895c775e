"""Split of recordings into training, validation and test."""

from __future__ import annotations

from pathlib import Path

import pytest
from recorded import DATA

from stario.fusion.paper_table import sets
from stario.fusion.paper_table.sets import ALL, FIRST, development_sets
from stario.network.training import splits
from stario.network.training.splits import learned_from
from stario.sequences.datasets.splits import ListEntry
from stario.sequences.errors import InputError

needs_data = pytest.mark.skipif(not (DATA / "archives").exists(), reason=f"no data in {DATA}")


def test_a_split_is_disjoint_complete_and_determined_by_the_seed() -> None:
    recordings = [ListEntry(Path(f"a.h5:{k:02d}"), "a") for k in range(40)]
    first, again, other = (sets._split("a", recordings, seed) for seed in (3, 3, 4))
    assert first == again
    assert first.test != other.test
    parts = [set(first.training), set(first.validation), {one.path for one in first.test}]
    assert [len(part) for part in parts] == [32, 4, 4]
    assert set.union(*parts) == {one.path for one in recordings}
    assert "seed 3" in first.words


def test_two_phones_on_one_walk_are_in_the_same_part() -> None:
    recordings = [
        ListEntry(Path(f"kipd.h5:Walk{k}{p}"), "kipd") for k in range(9) for p in ("S9", "S20")
    ]
    for seed in range(5):
        split = sets._split("kipd", recordings, seed)
        for part in (split.training, split.validation, [one.path for one in split.test]):
            walks = [path.name.removesuffix("S9").removesuffix("S20") for path in part]
            assert all(walks.count(walk) == 2 for walk in walks)


def test_two_phones_on_one_walk_are_validated_together(monkeypatch: pytest.MonkeyPatch) -> None:
    phones = [
        ListEntry(Path(f"kipd.h5:Walk{k}{p}"), "kipd") for k in range(9) for p in ("S9", "S20")
    ]
    held = [ListEntry(Path("ridi.h5:dan"), "ridi dan")]
    parts = {"all": [*phones, *held], "test": [], "holdout": held}
    for module in (sets, splits):
        monkeypatch.setattr(module, "read_packaged_list", lambda name, data: parts[name])
    for seed in range(9):
        [together] = development_sets(Path(), seed, 2, [ALL])
        names = [path.name.removesuffix("S9").removesuffix("S20") for path in together.validation]
        assert len(names) == 2
        assert len(set(names)) == 1


@needs_data
def test_the_main_sets_come_first_and_parts_of_a_set_are_disjoint() -> None:
    found = development_sets(DATA, 0, 2)
    assert tuple(one.name for one in found[:3]) == FIRST
    assert {one.name for one in found} == {*FIRST, "tyrex", "kipd", "ilc"}
    for one in found:
        test = {listed.path for listed in one.test}
        assert not test & set(one.training)
        assert not test & set(one.validation)
        assert not set(one.training) & set(one.validation)
        assert all((one.training, one.validation, test))
    with pytest.raises(InputError, match="'ronin'"):
        development_sets(DATA, 0, 2, ["ronin"])


@needs_data
def test_the_combined_set_is_tested_on_held_out_people_and_places() -> None:
    [together] = development_sets(DATA, 0, 2, [ALL])
    learned = [*together.training, *together.validation]
    assert not any("Thibaud" in str(path) or ":dan_" in str(path) for path in learned)
    assert not any("site2" in str(path) for path in learned)
    assert {"tyrex", "ridi", "kipd", "ilc", "rocip", "oxiod"} <= set(
        map(sets.set_of, together.test)
    )
    tested = [one.group for one in together.test]
    assert tested.count("tyrex Thibaud") == 2  # of his 41
    known = learned_from(DATA)
    assert not known["first-stage"] & {one.path for one in together.test}
    assert known["default"] >= {one.path for one in together.test}
