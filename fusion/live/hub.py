"""All devices of a server: each worked off by itself, and news for those who watch."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stario.fusion.live.payload import Batch
from stario.fusion.live.session import Session
from stario.fusion.navigator import Navigator
from stario.sequences.errors import InputError

MOST_DEVICES = 16
"""At once; more are refused, since memory must not grow."""

MOST_SENT = 3000
"""Points of a device in one message to a viewer that knows none of them yet."""


class Hub:
    """The sessions by device, and whoever watches them.

    Each device has a lock: its batches are worked off one after the other, in a thread, so that
    neither a slow network nor another device's batch holds up the server.

    Args:
        folder: for recordings.
        new_navigator: makes a navigator for each track.

    Attributes:
        sessions: by device.
        refused: messages that could not be read, by where they came in.
        ending: whether the server is about to stop, and viewers are to be let go.
    """

    def __init__(self, folder: Path, new_navigator: Callable[[], Navigator]) -> None:
        self.ending = False
        self._folder, self._new_navigator = folder, new_navigator
        self.sessions: dict[str, Session] = {}
        self._locks: dict[str, asyncio.Lock] = {}
        self._news = asyncio.Event()
        self.refused: Counter[str] = Counter()

    async def take(self, batch: Batch, accel_factor: float = 1.0) -> int:
        """Take a batch in; returns how many samples it made.

        Raises:
            InputError: there are too many devices, or the recording cannot be written.
        """
        received = time.time()
        if not batch.readings and batch.device not in self.sessions:
            return 0  # a push to see whether somebody listens
        session = self._session(batch.device)
        async with self._locks[batch.device]:
            count = await asyncio.to_thread(session.take, batch, received, accel_factor)
        self.announce()
        return count

    async def command(self, device: str, name: str, **values: float) -> None:
        """Have a device's session do something: start, stop, zero or fix.

        Raises:
            InputError: there is no such device, or it cannot be done now.
        """
        if device not in self.sessions:
            known = ", ".join(self.sessions) or "none yet"
            raise InputError("device", repr(device), f"one that has sent something: {known}")
        action = getattr(self.sessions[device], name)
        async with self._locks[device]:
            await asyncio.to_thread(action, **values)
        self.announce()

    def refuse(self, where: str) -> None:
        """Count what could not be read, by where it came in."""
        self.refused[where] += 1

    def announce(self) -> None:
        """Wake all who wait for news."""
        self._news.set()
        self._news = asyncio.Event()

    async def news(self, seconds: float) -> None:
        """Wait for something new, but not longer than some seconds."""
        try:
            await asyncio.wait_for(self._news.wait(), seconds)
        except TimeoutError:
            return

    def end(self) -> None:
        """Let the viewers go."""
        self.ending = True
        self.announce()

    def close(self) -> None:
        """End all recordings."""
        for session in self.sessions.values():
            session.close()

    def _session(self, device: str) -> Session:
        if device not in self.sessions:
            if len(self.sessions) >= MOST_DEVICES:
                raise InputError(
                    "device", f"a further one, {device!r}", f"at most {MOST_DEVICES} at once"
                )
            self.sessions[device] = Session(device, self._folder, self._new_navigator)
            self._locks[device] = asyncio.Lock()
        return self.sessions[device]


class Viewer:
    """What one viewer knows already, so that only what is new is sent.

    Args:
        hub: to watch.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._known: dict[str, tuple[int, int]] = {}

    def message(self) -> dict[str, Any]:
        """Every device's status, and the points that are new since the last message.

        `points` replace all that the viewer has where `fresh` is true, else they follow them.
        """
        devices = []
        for device, session in list(self._hub.sessions.items()):
            drawn = session.drawn
            points, revision = drawn.points, drawn.revision
            known_revision, known = self._known.get(device, (-1, 0))
            fresh = revision != known_revision
            count = len(points)
            new = points[0 if fresh else known : count]
            if len(new) > MOST_SENT:
                new = [*new[: -1 : -(-len(new) // MOST_SENT)], new[-1]]
            self._known[device] = (revision, count)
            devices.append(session.status() | {"fresh": fresh, "points": new})
        refused = dict(self._hub.refused)
        return {"time": time.time(), "devices": devices, "refused": refused}
