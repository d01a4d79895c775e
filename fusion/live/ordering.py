"""Puts pushes that overtook one another back into order.

The later of two pushes may arrive first, and one that failed is repeated after others. Sensor
Logger numbers the pushes of a recording, so that one that comes too early can wait for its turn.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator

from stario.fusion.live.payload import Batch

MAX_DELAY = 0.8
"""Maximum time for which pushes wait for a missing one before them [s]; if the program is killed
they are lost, with the second before that."""


class PushOrder:
    """Order of one device's pushes; those without a number keep their order of arrival."""

    def __init__(self) -> None:
        self._recording, self._next = "", 0
        self._recordings, self._arrivals = 0, itertools.count()
        self._waiting: list[tuple[int, int, int, float, Batch]] = []

    def add(self, batch: Batch, received: float) -> None:
        """Add a batch received at a time [s since 1970]."""
        if batch.recording != self._recording:
            self._recording, self._next = batch.recording, batch.number
            self._recordings += 1
        entry = (self._recordings, batch.number, next(self._arrivals), received, batch)
        heapq.heappush(self._waiting, entry)

    def is_due(self, now: float) -> bool:
        """Return whether a batch has waited for the maximum time; may be called by any thread."""
        return any(now - entry[3] >= MAX_DELAY for entry in list(self._waiting))

    def ready(self, now: float) -> Iterator[tuple[Batch, float]]:
        """Yield the batches whose turn it is, each with the time of its receipt.

        A batch that comes after its turn is ready as well, since parts of it may be new.
        """
        while self._waiting:
            recording, number, _, received, batch = self._waiting[0]
            if recording == self._recordings and number >= self._next:
                since = min(entry[3] for entry in self._waiting)
                if number > self._next and now - since < MAX_DELAY:
                    return
                self._next = number + 1
            heapq.heappop(self._waiting)
            yield batch, received
