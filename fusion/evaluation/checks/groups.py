"""Results of recordings by the groups they are counted in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar


class Grouped(Protocol):
    """A result that belongs to a group."""

    @property
    def group(self) -> str:
        """Its name."""


Result = TypeVar("Result", bound=Grouped)


def by_group(found: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """Each group with its results, in order of their names; more than one also all together."""
    groups = sorted({one.group for one in found})
    parts = [(group, [one for one in found if one.group == group]) for group in groups]
    return [*parts, ("all", list(found))] if len(groups) > 1 else parts
