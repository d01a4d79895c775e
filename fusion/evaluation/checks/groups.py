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
    """Return each group with its results, sorted by name; several are followed by all together."""
    groups = sorted({one.group for one in found})
    parts = [(group, [one for one in found if one.group == group]) for group in groups]
    return [*parts, ("all", list(found))] if len(groups) > 1 else parts
