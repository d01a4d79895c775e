"""The complete live server: page, pushes and polled phones in one event loop.

A connection waits if the server needs more from its client before it can answer: a header, a body,
or another request. Such connections cost a client nothing, with or without a token, and would keep
others out if there were no end to them. A phone sends its push at once and is not affected.
"""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import signal
import socket
import statistics
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from types import FrameType

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from stario.fusion.live.demo import walk
from stario.fusion.live.hub import Hub
from stario.fusion.live.phyphox import Phyphox, follow
from stario.fusion.live.server import live_app
from stario.fusion.navigator import Navigator
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

_POLL_SECONDS = 0.1
"""Interval between checks for the server's end, and for what has waited too long [s]."""

_MAX_CONNECTIONS = 800
"""Maximum number of connections; those that wait for their clients are fewer."""

REQUEST_SECONDS = 20.0
"""Maximum time from a connection or a request's first byte to its last [s]."""

MAX_WAITING = 500
"""Maximum number of waiting connections; for one more the address with the most loses its oldest.
They are accepted hundreds at a time, so that a lower number could hit one that has just come."""


class LiveServer:
    """Server of `stario live`.

    Args:
        new_navigator: returns a new navigator for each track.
        out: folder for recordings.
        host: address to listen on; unless it is loopback, there is a token.
        port: port of the page; 0 for a free one.
        phones: addresses of phones running phyphox.
        demo: recording that a simulated phone sends, at its own speed; None for no such phone.
        tiles: address of a map server's tiles, with {z}, {x} and {y}, as the page's background once
            a track lies on the earth; the browser asks it. Empty for none.

    Attributes:
        hub: hub of the devices.
        port: port of the page.
        token: access token; empty on loopback.

    Raises:
        InputError: a phone's address is invalid, or the port is in use.
    """

    def __init__(
        self,
        new_navigator: Callable[[], Navigator],
        out: Path,
        host: str = "127.0.0.1",
        port: int = 8000,
        phones: Iterable[str] = (),
        demo: ImuSequence | None = None,
        tiles: str = "",
    ) -> None:
        self.token = "" if is_loopback(host) else secrets.token_urlsafe(12)
        self.hub = Hub(out, new_navigator)
        self._out, self._demo = out, demo
        self._phones = [Phyphox(address) for address in phones]
        self._socket = _bound(host, port)
        self.port = int(self._socket.getsockname()[1])
        own = host if host not in ("0.0.0.0", "::") else _own_address()
        self._netloc = f"[{own}]:{self.port}" if ":" in own else f"{own}:{self.port}"
        known_as = self._netloc if self.token else ""
        config = uvicorn.Config(
            live_app(self.hub, self.token, known_as, tiles, self._beside),
            http=Connection,
            log_config=None,
            log_level="warning",
            timeout_graceful_shutdown=1,
            limit_concurrency=_MAX_CONNECTIONS,
        )
        self._server = _Server(config)
        self._started: Callable[[], None] = lambda: None

    def run(self, started: Callable[[], None] = lambda: None) -> None:
        """Serve until stopped by a signal or `stop`; `started` is called once it is listening."""
        self._started = started
        try:
            asyncio.run(self._server.serve(sockets=[self._socket]))
        finally:
            self._socket.close()

    def stop(self) -> None:
        """End `run`; may be called from another thread."""
        self._server.should_exit = True

    def addresses(self) -> list[str]:
        """Return lines of text with the addresses to open and to send to."""
        end = f"?token={self.token}" if self.token else ""
        lines = [
            f"page:           http://{self._netloc}/{end}",
            f"Sensor Logger:  http://{self._netloc}/data{end}",
            f"recordings:     {self._out}",
        ]
        if not self.token:
            lines.append("only this computer can connect; use --host 0.0.0.0 for phones")
        return lines

    @asynccontextmanager
    async def _beside(self, app: Starlette) -> AsyncIterator[None]:
        """Poll phones, let the simulated one walk and watch the clock; at last close recordings."""
        work = [self._watch(), *(follow(self.hub, phone) for phone in self._phones)]
        if self._demo is not None:
            work.append(walk(self.hub, self._demo))
        tasks = [asyncio.create_task(each) for each in work]
        self._started()
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.hub.close()

    async def _watch(self) -> None:
        """End what has waited long enough, and the viewers' connections if the server stops."""
        while True:
            await asyncio.sleep(_POLL_SECONDS)
            now = asyncio.get_running_loop().time()
            for each in _waiting(self._server.server_state.connections):
                if now - each.since > REQUEST_SECONDS:
                    each.transport.abort()
            await self.hub.release()
            if self._server.should_exit:
                self.hub.end()


class _Server(uvicorn.Server):
    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop at a signal, which uvicorn would raise again; the next one ends the program."""
        self.should_exit = True
        signal.signal(sig, signal.SIG_DFL if sig != signal.SIGINT else signal.default_int_handler)


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
            addresses = [each.client and each.client[0] for each in waiting]
            crowded = statistics.mode(addresses)
            crowd = (c for c, at in zip(waiting, addresses, strict=True) if at == crowded)
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

    def waits(self) -> bool:
        """Return whether the server needs more from the client before it can answer."""
        if self.transport.is_closing():
            return False
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body


def _waiting(connections: Iterable[object]) -> list[Connection]:
    return [each for each in connections if isinstance(each, Connection) and each.waits()]


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached only from this computer."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _bound(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Only with the protocol named does asyncio switch off Nagle's delay of 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()  # or another program could listen on the same port
    except OSError as error:
        listener.close()
        if isinstance(error, socket.gaierror):
            raise InputError("--host", host, "an address of this computer, or 0.0.0.0") from error
        found = f"{host} {port}: {error.strerror or error}"
        raise InputError("port", found, "a free port of this computer", "--port N") from error
    return listener


def _own_address() -> str:
    """Return this computer's address in its network, found without sending anything."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()
