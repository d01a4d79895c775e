"""Grouping of the results of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar


class Grouped(Protocol):
    """A result that belongs to a group."""

    @property
    def group(self) -> str:
        """Name of the group."""


Result = TypeVar("Result", bound=Grouped)


def by_group(found: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """Return each group with its results, sorted by name, and all results if there are several."""
    groups = sorted({result.group for result in found})
    parts = [(group, [result for result in found if result.group == group]) for group in groups]
    return [*parts, ("all", list(found))] if len(groups) > 1 else parts
