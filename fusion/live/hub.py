"""All devices of a server: a session for each, and notifications for viewers."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Set
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from stario.fusion.live.drawn import Point
from stario.fusion.live.payload import Batch
from stario.fusion.live.places import Earth, Place
from stario.fusion.live.session import Session
from stario.fusion.navigator import Navigator
from stario.sequences.errors import InputError

MAX_DEVICES = 16
"""Maximum number of devices at once; further ones are refused to bound memory."""

SILENT_SECONDS = 60.0
"""Time without data after which a device makes room for another."""

MAX_SENT = 3000
"""Maximum number of points of a device in one message, as to a new viewer."""

T = TypeVar("T")

_log = logging.getLogger(__name__)


class Hub:
    """Sessions by device, with notifications for viewers.

    Each device has a thread, in which its batches are processed one after the other: neither a slow
    displacement network nor another device's batch blocks the server.

    Args:
        folder: folder for recordings.
        new_navigator: returns a new navigator for each track.

    Attributes:
        earth: where on the earth the map lies that all devices share.
        refused: number of refused messages.
        viewers: number of pages that watch.
        ending: whether the server is stopping and viewers must be disconnected.
    """

    def __init__(self, folder: Path, new_navigator: Callable[[], Navigator]) -> None:
        self._folder, self._new_navigator = folder, new_navigator
        self.sessions: dict[str, Session] = {}
        self.earth = Earth()
        self.refused, self.viewers, self.ending = 0, 0, False
        self._news = asyncio.Event()

    async def take(self, *batches: Batch, accel_factor: float = 1.0) -> int:
        """Process the batches of a message; return the number of samples they completed.

        Raises:
            InputError: there are too many devices, or two of one name; nothing is then processed.
                Or a recording cannot be written.
        """
        received = time.time()
        # A push without readings tests the connection: it makes no device known.
        known = [b for b in batches if b.readings or b.device in self.sessions]
        for batch in known:
            if batch.device in self.sessions:
                self.sessions[batch.device].check(batch)
        self._make_room({batch.device for batch in known})
        for batch in known:
            if batch.device not in self.sessions:
                navigators = self._new_navigator
                session = Session(batch.device, self._folder, navigators, self.earth)
                self.sessions[batch.device] = session
            self.sessions[batch.device].received = received
        count = 0
        for session, batch in [(self.sessions[batch.device], batch) for batch in known]:
            count += await self._in_thread(session, session.take, batch, received, accel_factor)
        return count

    async def command(self, device: str, name: str, **values: float) -> None:
        """Run a command on a device's session: start, stop, zero or fix.

        Raises:
            InputError: the device is unknown, or the command is not possible now.
        """
        if device not in self.sessions:
            devices = ", ".join(self.sessions) or "none yet"
            raise InputError("device", repr(device), f"a device that has sent data: {devices}")
        session = self.sessions[device]
        await self._in_thread(session, partial(session.command, name, **values))

    async def release(self) -> None:
        """Process the pushes that have waited long enough for one before them."""
        now = time.time()
        due = [session for session in self.sessions.values() if session.order.is_due(now)]
        tasks = (self._in_thread(session, session.release, now) for session in due)
        for result in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(result, Exception):
                _log.error("a push that waited is lost: %s", result)

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
            self._close(session)

    async def _in_thread(self, session: Session, action: Callable[..., T], *arguments: Any) -> T:
        """Run an action of a session after those before it, and tell the viewers."""
        session.pending += 1
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(session.thread, action, *arguments)
        finally:
            session.pending -= 1
            self.announce()

    def _make_room(self, devices: Set[str]) -> None:
        """Close the sessions that have been silent longest, as many as new devices need.

        A stopped one that still sends stays: its next batch would start it again.
        """
        new = devices - set(self.sessions)
        surplus = len(self.sessions) + len(new) - MAX_DEVICES
        if surplus <= 0:
            return
        silent = sorted(
            (each for name, each in self.sessions.items() if not (name in devices or each.pending)),
            key=lambda session: session.received,
        )[:surplus]
        if len(silent) < surplus or time.time() - silent[-1].received <= SILENT_SECONDS:
            found = f"{len(new)} new: {', '.join(sorted(new))[:80]}"
            expected = f"at most {MAX_DEVICES} devices at once"
            fix = f"one that sends nothing for {SILENT_SECONDS:g} s makes room"
            raise InputError("device", found, expected, fix)
        for session in silent:
            self._close(session)
            del self.sessions[session.device]

    def _close(self, session: Session) -> None:
        """Close a recording after all that was to be processed before."""
        try:
            session.thread.submit(session.close).result()
        except (OSError, InputError) as error:  # of pushes that still waited
            _log.error("%s: the end of its recording is lost: %s", session.device, error)
        session.thread.shutdown()


class Viewer:
    """One viewer and the points it has received, so that only new ones are sent."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._sent: dict[str, tuple[list[Point], int]] = {}
        self._places: dict[str, list[Place]] = {}

    def message(self) -> dict[str, Any]:
        """Return every device's status and its points since the last message.

        If `fresh` is true, `points` replace all the viewer has; otherwise they are appended.
        `places` are there if they have changed, all of them.
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
            news: dict[str, Any] = {"fresh": fresh, "points": new}
            places = session.track.places.drawn
            if places is not self._places.get(device):
                self._places[device] = news["places"] = places
            devices.append(session.status() | news)
        return {"time": time.time(), "devices": devices, "refused": self._hub.refused}
