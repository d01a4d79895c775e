"""Many recordings through one comparison; the cluster is that of the example's test."""

from __future__ import annotations

from stario.fusion.evaluation.many import distinct_name


def test_recordings_of_one_name_get_folders_of_their_own() -> None:
    taken: set[str] = set()
    for name in ("walk", "walk", "walk-2", "walk"):
        taken.add(distinct_name(name, taken))
    assert taken == {"walk", "walk-2", "walk-2-2", "walk-3"}
