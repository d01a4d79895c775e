"""Lines of JSON over TCP and UDP, for any device other than a phone with an app.

Each line is one sample (see `payload`); a UDP packet holds one or several. An invalid line is
answered with `{"error": ...}` over TCP and counted over UDP. If the server has a token, a TCP
connection and each UDP packet must begin with the line `{"token": "..."}`. A connection whose first
line is invalid is closed: any web page can make a browser send HTTP to this port, with lines of
JSON as its body.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from stario.fusion.live.hub import Hub
from stario.fusion.live.payload import Batch, joined, object_from, parse_line
from stario.fusion.live.server import tokens_match
from stario.sequences.errors import InputError

MAX_LINE = 64 * 1024
"""Maximum length of a line [bytes]."""

MAX_CONNECTIONS = 32
TOKEN_SECONDS = 10.0
"""Time [s] within which a connection must send the token, if there is one."""

MAX_WAITING = 2000
"""Maximum number of queued UDP packets; further ones are dropped and counted."""

_log = logging.getLogger(__name__)


class LineServer:
    """Server for lines over TCP and UDP on one port.

    Args:
        hub: hub that takes the samples.
        token: required token; empty for none.

    Attributes:
        port: the port while listening.
    """

    def __init__(self, hub: Hub, token: str = "") -> None:
        self._hub, self._token = hub, token
        self._connections = 0
        self._packets: asyncio.Queue[tuple[bytes, str]] = asyncio.Queue(MAX_WAITING)
        self.port = 0

    @asynccontextmanager
    async def listening(self, host: str, port: int) -> AsyncIterator[None]:
        """Listen within the context.

        Raises:
            OSError: the port is in use.
        """
        loop = asyncio.get_running_loop()
        server = await asyncio.start_server(self._connected, host, port, limit=MAX_LINE)
        self.port = server.sockets[0].getsockname()[1]
        transport, _ = await loop.create_datagram_endpoint(
            lambda: _Packets(self._packets, self._hub), local_addr=(host, self.port)
        )
        packets = asyncio.create_task(self._process_packets())
        try:
            yield
        finally:
            packets.cancel()
            transport.close()
            server.close()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        sender = f"tcp {writer.get_extra_info('peername')[0]}"
        try:
            if self._connections > MAX_CONNECTIONS:
                found, expected = "one more", f"at most {MAX_CONNECTIONS} at once"
                await self._answer(writer, [str(InputError("connection", found, expected))])
            else:
                await self._read(reader, writer, sender)
        except ConnectionError as error:
            _log.info("%s: %s", sender, error)
        except asyncio.CancelledError:
            pass  # the server stops; asyncio would report the task that ends so
        finally:
            self._connections -= 1
            writer.close()

    async def _read(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, sender: str
    ) -> None:
        try:
            first = await self._first_line(reader, sender)
        except InputError as error:
            await self._answer(writer, [str(error)])
            return
        await self._answer(writer, await self._take([first], sender))
        rest = b""
        while data := await reader.read(MAX_LINE):
            *lines, rest = (rest + data).split(b"\n")
            errors = await self._take(lines, sender)
            if len(rest) > MAX_LINE:
                errors.append(f"line: found a longer line, expected at most {MAX_LINE} bytes")
                rest = b""
            await self._answer(writer, errors)
        await self._answer(writer, await self._take([rest], sender))

    async def _first_line(self, reader: asyncio.StreamReader, sender: str) -> bytes:
        """Return a connection's first line; empty instead of the token.

        Raises:
            InputError: it is invalid, too long, or not the token.
        """
        try:
            async with asyncio.timeout(TOKEN_SECONDS if self._token else None):
                line = await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError as error:
            line = error.partial  # the connection ends with it
        except asyncio.LimitOverrunError:
            raise InputError("line", "a longer line", f"at most {MAX_LINE} bytes") from None
        except TimeoutError:
            raise InputError("token", f"none for {TOKEN_SECONDS:g} s", "it at once") from None
        if self._token and line:
            if not self._is_token(line):
                raise InputError("token", "none or another", 'the line {"token": "..."} first')
            return b""
        if line.strip():
            parse_line(line, sender)
        return line

    async def _answer(self, writer: asyncio.StreamWriter, errors: Sequence[str]) -> None:
        for error in errors:
            self._hub.refused["tcp"] += 1
            writer.write(json.dumps({"error": error}).encode() + b"\n")
        await writer.drain()

    async def _process_packets(self) -> None:
        while True:
            data, sender = await self._packets.get()
            lines = data.split(b"\n")
            try:
                trusted = not self._token or self._is_token(lines.pop(0))
                refused = len(await self._take(lines, sender)) if trusted else 1
                self._hub.refused["udp"] += refused
            except Exception:  # no packet, whatever it holds, may stop the server
                _log.exception("%s: a packet is skipped", sender)
                self._hub.refused["udp"] += 1

    async def _take(self, lines: Sequence[bytes], sender: str) -> list[str]:
        """Process lines, batched by device; return the errors of those that fail."""
        errors: list[str] = []
        batches: list[Batch] = []
        for line in filter(bytes.strip, lines):
            try:
                batches.append(parse_line(line, sender))
            except InputError as error:
                errors.append(str(error))
        for batch in joined(batches):
            try:
                await self._hub.take(batch)
            except (InputError, OSError) as error:
                errors.append(str(error))
        return errors

    def _is_token(self, line: bytes) -> bool:
        try:
            token = object_from("line", line).get("token")
        except InputError:
            return False
        return isinstance(token, str) and tokens_match(token, self._token)


class _Packets(asyncio.DatagramProtocol):
    def __init__(self, queue: asyncio.Queue[tuple[bytes, str]], hub: Hub) -> None:
        self._queue, self._hub = queue, hub

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        try:
            self._queue.put_nowait((data, f"udp {addr[0]}"))
        except asyncio.QueueFull:
            self._hub.refused["udp"] += 1
