"""Connections that keep the server waiting: limits and a deadline, whoever they belong to.

A connection waits if the server needs more from it before it can answer: a header, a body, or the
next request. That costs a client nothing, with or without a token, so such connections are closed
after a while, and earlier if there are too many: first those without a request yet, the oldest
first. A phone sends a push at once and is never among them.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_WAITING, MAX_WAITING_OF_ADDRESS = 100, 40
"""Maximum number of connections that wait, in all and of one address."""

REQUEST_SECONDS = 20.0
"""Maximum time from a connection or a request's first byte to its last [s]."""


class Connection(H11Protocol):
    """HTTP connection that knows for how long the server has waited for its client."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start to wait; close another connection if too many do."""
        super().connection_made(transport)
        self._since, self._answered, self._idle = self.loop.time(), False, False
        waiting = [each for each in _of(self.connections) if each._is_waiting()]
        of_address = [each for each in waiting if each._address() == self._address()]
        for crowd, limit in ((of_address, MAX_WAITING_OF_ADDRESS), (waiting, MAX_WAITING)):
            if len(crowd) > limit:
                min(crowd, key=lambda each: (each._answered, each._since)).transport.abort()
                return

    def data_received(self, data: bytes) -> None:
        """Process data, which may begin a request."""
        if self._idle:
            self._since, self._idle = self.loop.time(), False
        super().data_received(data)

    def on_response_complete(self) -> None:
        """Wait for the next request; uvicorn closes a connection that sends none for seconds."""
        self._since, self._answered, self._idle = self.loop.time(), True, True
        super().on_response_complete()

    def _is_waiting(self) -> bool:
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def _address(self) -> str:
        return self.client[0] if self.client else ""


def close_overdue(connections: Iterable[object], now: float) -> None:
    """Close the connections that have waited too long at a time of the event loop [s]."""
    for each in _of(connections):
        if each._is_waiting() and now - each._since > REQUEST_SECONDS:
            each.transport.abort()


def _of(connections: Iterable[object]) -> list[Connection]:
    return [each for each in connections if isinstance(each, Connection)]
