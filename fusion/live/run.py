"""The complete live server: page, pushes, lines and polled phones in one event loop."""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import uvicorn

from stario.fusion.live.hub import Hub
from stario.fusion.live.lines import LineServer
from stario.fusion.live.phyphox import Phyphox, follow
from stario.fusion.live.server import live_app
from stario.fusion.navigator import Navigator
from stario.sequences.errors import InputError

_POLL_SECONDS = 0.1
"""Interval between checks for a signal to stop [s]."""


class LiveServer:
    """Server of `stario live`.

    Args:
        new_navigator: returns a new navigator for each track.
        out: folder for recordings.
        host: address to listen on; unless it is loopback, there is a token.
        port: port of the page; 0 for a free one.
        lines_port: port of the lines of JSON; 0 for a free one.
        phones: addresses of phones running phyphox.

    Attributes:
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
        lines_port: int = 8001,
        phones: Iterable[str] = (),
    ) -> None:
        self.token = "" if is_loopback(host) else secrets.token_urlsafe(12)
        self.hub = Hub(out, new_navigator)
        self._out, self._host, self._lines_port = out, host, lines_port
        self._phones = [Phyphox(address) for address in phones]
        self._lines = LineServer(self.hub, self.token)
        self._socket = _bound(host, port)
        self.port = int(self._socket.getsockname()[1])
        config = uvicorn.Config(
            live_app(self.hub, self.token),
            log_level="warning",
            lifespan="off",
            timeout_graceful_shutdown=1,
            limit_concurrency=200,
        )
        self._server = uvicorn.Server(config)

    @property
    def lines_port(self) -> int:
        """Port of the lines of JSON."""
        return self._lines.port

    def run(self, started: Callable[[], None] = lambda: None) -> None:
        """Serve until stopped by a signal or `stop`; `started` is called once all are listening."""
        with suppress(KeyboardInterrupt):
            asyncio.run(self._run(started))

    def stop(self) -> None:
        """End `run`; may be called from another thread."""
        self._server.should_exit = True

    def addresses(self) -> list[str]:
        """Return lines of text with the addresses to open and to send to."""
        end = f"?token={self.token}" if self.token else ""
        host = self._host if self._host not in ("0.0.0.0", "::") else _own_address()
        url_host = f"[{host}]" if ":" in host else host
        page = f"http://{url_host}:{self.port}"
        lines = [
            f"page:           {page}/{end}",
            f"Sensor Logger:  {page}/data{end}",
            f"lines of JSON:  {url_host} port {self.lines_port}, TCP or UDP",
            f"recordings:     {self._out}",
        ]
        if self.token:
            lines.append(f'token:          {self.token} (lines begin with {{"token": "..."}})')
        else:
            lines.append("only this computer can connect; use --host 0.0.0.0 for phones")
        return lines

    async def _run(self, started: Callable[[], None]) -> None:
        phones: list[asyncio.Task[None]] = []
        try:
            async with self._lines.listening(self._host, self._lines_port):
                phones += [asyncio.create_task(follow(self.hub, phone)) for phone in self._phones]
                web = asyncio.create_task(self._server.serve(sockets=[self._socket]))
                while not self._server.started and not web.done():
                    await asyncio.sleep(0.01)
                started()
                while not self._server.should_exit:
                    await asyncio.sleep(_POLL_SECONDS)
                self.hub.end()
                await web
        except OSError as error:
            found = f"{self._lines_port}: {error.strerror or error}"
            raise InputError("lines-port", found, "a free port", "--lines-port N") from error
        finally:
            for phone in phones:
                phone.cancel()
            await asyncio.gather(*phones, return_exceptions=True)
            self._socket.close()
            self.hub.close()


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
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()  # or the lines could listen on the same port
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
