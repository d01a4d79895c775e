"""Many recordings in one comparison; the example's test covers the cluster."""

from __future__ import annotations

from stario.fusion.evaluation.many import distinct_name


def test_recordings_with_the_same_name_get_distinct_folders() -> None:
    taken: set[str] = set()
    for name in ("walk", "walk", "walk-2", "walk"):
        taken.add(distinct_name(name, taken))
    assert taken == {"walk", "walk-2", "walk-2-2", "walk-3"}
