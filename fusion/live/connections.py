"""Connections that keep the server waiting: deadlines and limits, whoever they belong to.

A connection waits if the server needs more from its client before it can answer: a header, a body,
or another request. Such connections cost a client nothing, with or without a token, and would keep
others out if there were no end to them. A phone sends its push at once and is not affected.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterable

from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_SECONDS = 20.0
"""Maximum time from a connection or a request's first byte to its last [s]."""

MAX_WAITING = 500
"""Maximum number of waiting connections; for one more the address with the most loses its oldest.
They are accepted hundreds at a time, so that a lower number could hit one that has just come."""


class Connection(H11Protocol):
    """HTTP connection that knows for how long the server has waited for its client.

    Attributes:
        since: time of the event loop at which a connection, or its present request, began [s].
        answered: whether a request was answered.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait, in the place of another if too many do."""
        super().connection_made(transport)
        self.since, self.answered, self._idle = self.loop.time(), False, False
        waiting = _waiting(self.connections)
        if len(waiting) > MAX_WAITING:
            [(crowded, _)] = Counter(each.address for each in waiting).most_common(1)
            crowd = (each for each in waiting if each.address == crowded)
            min(crowd, key=lambda each: (each.answered, each.since)).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Process data, which may begin a request."""
        if self._idle:
            self.since, self._idle = self.loop.time(), False
        super().data_received(data)

    def on_response_complete(self) -> None:
        """Wait for another request; uvicorn closes a connection that sends none for seconds."""
        self.since, self.answered, self._idle = self.loop.time(), True, True
        super().on_response_complete()

    @property
    def waits(self) -> bool:
        """Whether the server needs more from the client before it can answer."""
        if self.transport.is_closing():
            return False
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    @property
    def address(self) -> str:
        """The client's address."""
        return self.client[0] if self.client else ""


def close_overdue(connections: Iterable[object], now: float) -> None:
    """Close the connections that have waited too long at a time of the event loop [s]."""
    for each in _waiting(connections):
        if now - each.since > REQUEST_SECONDS:
            each.transport.abort()


def _waiting(connections: Iterable[object]) -> list[Connection]:
    return [each for each in connections if isinstance(each, Connection) and each.waits]
