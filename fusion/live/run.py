"""The complete live server: page, pushes and polled phones in one event loop."""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType

import uvicorn
from uvicorn.server import HANDLED_SIGNALS

from stario.fusion.live.connections import Connection, close_overdue
from stario.fusion.live.demo import walk
from stario.fusion.live.hub import Hub
from stario.fusion.live.phyphox import Phyphox, follow
from stario.fusion.live.server import live_app
from stario.fusion.navigator import Navigator
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

_POLL_SECONDS = 0.1
"""Interval between checks for a signal to stop, and for what has waited too long [s]."""

_MAX_CONNECTIONS = 800
"""Maximum number of connections; those that wait for their clients are fewer (`connections`)."""


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
        config = uvicorn.Config(
            live_app(self.hub, self.token, self._netloc if self.token else "", tiles),
            http=Connection,
            log_config=None,
            log_level="warning",
            lifespan="off",
            timeout_graceful_shutdown=1,
            limit_concurrency=_MAX_CONNECTIONS,
        )
        self._server = _Server(config)

    def run(self, started: Callable[[], None] = lambda: None) -> None:
        """Serve until stopped by a signal or `stop`; `started` is called once it is listening."""
        with self._stopped_by_signals():
            asyncio.run(self._run(started))

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

    async def _run(self, started: Callable[[], None]) -> None:
        tasks = [asyncio.create_task(follow(self.hub, phone)) for phone in self._phones]
        tasks.append(asyncio.create_task(self._watch()))
        try:
            web = asyncio.create_task(self._server.serve(sockets=[self._socket]))
            while not self._server.started and not web.done():
                await asyncio.sleep(0.01)
            started()
            if self._demo is not None:
                tasks.append(asyncio.create_task(walk(self.hub, self._demo)))
            while not self._server.should_exit:
                await asyncio.sleep(_POLL_SECONDS)
            self.hub.end()
            await web
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._socket.close()
            self.hub.close()

    async def _watch(self) -> None:
        """Close connections, and process pushes, that have waited long enough."""
        while True:
            await asyncio.sleep(_POLL_SECONDS)
            now = asyncio.get_running_loop().time()
            close_overdue(self._server.server_state.connections, now)
            await self.hub.release()

    @contextmanager
    def _stopped_by_signals(self) -> Iterator[None]:
        """Let the first signal stop the server, and the next one end the program as usual."""
        if threading.current_thread() is not threading.main_thread():
            yield  # signals go to the main thread only
            return
        usual = {number: signal.getsignal(number) for number in HANDLED_SIGNALS}

        def restore() -> None:
            for number, handler in usual.items():
                signal.signal(number, handler)

        def stop(number: int, frame: FrameType | None) -> None:
            restore()
            self.stop()

        for number in HANDLED_SIGNALS:
            signal.signal(number, stop)
        try:
            yield
        finally:
            restore()


class _Server(uvicorn.Server):
    def capture_signals(self) -> nullcontext[None]:  # type: ignore[override]
        """Leave the signals to `LiveServer`: uvicorn raises them before recordings are closed."""
        return nullcontext()


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
