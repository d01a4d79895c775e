"""Grouping of the results of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar


@dataclass(frozen=True)
class GroupedResult:
    """Result of one recording.

    Attributes:
        recording: name of the recording.
        group: group that it is counted in.
    """

    recording: str
    group: str


Result = TypeVar("Result", bound=GroupedResult)


def by_group(found: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """Return each group with its results, sorted by name, and all results if there are several."""
    groups = sorted({result.group for result in found})
    parts = [(group, [result for result in found if result.group == group]) for group in groups]
    return [*parts, ("all", list(found))] if len(groups) > 1 else parts
