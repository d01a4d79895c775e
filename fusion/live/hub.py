"""All devices of a server: a session for each, and notifications for viewers."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from stario.fusion.live.drawn import Point
from stario.fusion.live.payload import Batch
from stario.fusion.live.session import Session
from stario.fusion.navigator import Navigator
from stario.sequences.errors import InputError

MAX_DEVICES = 16
"""Maximum number of devices at once; further ones are refused to bound memory."""

SILENT_SECONDS = 60.0
"""Time without data after which a device makes room for another."""

MAX_SENT = 3000
"""Maximum number of points of a device in one message, as to a new viewer."""

_log = logging.getLogger(__name__)


class Hub:
    """Sessions by device, with notifications for viewers.

    Each device has a lock: its batches are processed one after the other, in a thread, so that
    neither a slow displacement network nor another device's batch blocks the server.

    Args:
        folder: folder for recordings.
        new_navigator: returns a new navigator for each track.

    Attributes:
        sessions: sessions by device.
        refused: number of refused messages by transport.
        ending: whether the server is stopping and viewers must be disconnected.
    """

    def __init__(self, folder: Path, new_navigator: Callable[[], Navigator]) -> None:
        self._folder, self._new_navigator = folder, new_navigator
        self.sessions: dict[str, Session] = {}
        self.refused: Counter[str] = Counter()
        self.ending = False
        self._locks: dict[str, asyncio.Lock] = {}
        self._news = asyncio.Event()

    async def take(self, batch: Batch, accel_factor: float = 1.0) -> int:
        """Process a batch; return the number of samples it completed.

        Raises:
            InputError: there are too many devices, or the recording cannot be written.
        """
        received = time.time()
        if not batch.readings and batch.device not in self.sessions:
            return 0  # an empty push that tests the connection
        session = self._session(batch.device)
        async with self._locks[batch.device]:
            count = await asyncio.to_thread(session.take, batch, received, accel_factor)
        self.announce()
        return count

    async def command(self, device: str, name: str, **values: float) -> None:
        """Run a command on a device's session: start, stop, zero or fix.

        Raises:
            InputError: the device is unknown, or the command is not possible now.
        """
        if device not in self.sessions:
            devices = ", ".join(self.sessions) or "none yet"
            raise InputError("device", repr(device), f"a device that has sent data: {devices}")
        action = getattr(self.sessions[device], name)
        async with self._locks[device]:
            await asyncio.to_thread(action, **values)
        self.announce()

    def announce(self) -> None:
        """Wake all tasks that wait for news."""
        self._news.set()
        self._news = asyncio.Event()

    async def news(self, seconds: float) -> None:
        """Wait for news, but no longer than `seconds`."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._news.wait(), seconds)

    def end(self) -> None:
        """Disconnect the viewers."""
        self.ending = True
        self.announce()

    def close(self) -> None:
        """Close all recordings."""
        for session in self.sessions.values():
            _close(session)

    def _session(self, device: str) -> Session:
        if device not in self.sessions:
            if len(self.sessions) >= MAX_DEVICES:
                self._make_room(device)
            self.sessions[device] = Session(device, self._folder, self._new_navigator)
            self._locks[device] = asyncio.Lock()
        return self.sessions[device]

    def _make_room(self, device: str) -> None:
        """Close the session that has been silent longest.

        A stopped one that still sends stays: its next batch would start it again.
        """
        idle = [
            session for name, session in self.sessions.items() if not self._locks[name].locked()
        ]
        oldest = min(idle, key=lambda session: session.received, default=None)
        if oldest is None or time.time() - oldest.received < SILENT_SECONDS:
            expected = f"at most {MAX_DEVICES} devices at once"
            fix = f"one that sends nothing for {SILENT_SECONDS:g} s makes room"
            raise InputError("device", f"a new one, {device!r}", expected, fix)
        del self.sessions[oldest.device], self._locks[oldest.device]
        _close(oldest)


class Viewer:
    """One viewer and the points it has received, so that only new ones are sent.

    Args:
        hub: hub to watch.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._sent: dict[str, tuple[list[Point], int]] = {}

    def message(self) -> dict[str, Any]:
        """Return every device's status and its points since the last message.

        If `fresh` is true, `points` replace all the viewer has; otherwise they are appended.
        """
        devices = []
        for device, session in list(self._hub.sessions.items()):
            points = session.track.drawn.points
            earlier, sent = self._sent.get(device, ([], 0))
            fresh = points is not earlier
            count = len(points)
            new = points[0 if fresh else sent : count]
            if len(new) > MAX_SENT:
                new = [*new[: -1 : -(-len(new) // MAX_SENT)], new[-1]]
            self._sent[device] = (points, count)
            devices.append(session.status() | {"fresh": fresh, "points": new})
        return {"time": time.time(), "devices": devices, "refused": dict(self._hub.refused)}


def _close(session: Session) -> None:
    try:
        session.close()
    except (OSError, InputError) as error:  # of pushes that still waited
        _log.error("%s: the end of its recording is lost: %s", session.device, error)
