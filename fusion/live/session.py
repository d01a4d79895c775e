"""One device: decides which of its recordings a batch belongs to, and starts new ones."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from stario.fusion.live.payload import BACKWARD, Batch
from stario.fusion.live.places import Earth
from stario.fusion.live.track import LiveTrack
from stario.fusion.navigator import Navigator
from stario.sequences.arrays import check_choice
from stario.sequences.errors import InputError

FORWARD = 60 * 10**9
"""A jump of the device's clock ahead by this [ns], or back by `BACKWARD`, starts a new track."""


class Session:
    """Stream of one device. Not thread-safe: after its first batch use it in its thread only.

    Args:
        device: name of the device.
        folder: folder for recordings.
        new_navigator: returns a new navigator for each track.
        earth: where the map lies that all devices share.

    Attributes:
        received: time of the last receipt [s since 1970], set by the hub.
        running: whether data are processed.
        pending: number of the hub's calls that are not done.
        order: its pushes that wait for one before them.
    """

    def __init__(
        self,
        device: str,
        folder: Path,
        new_navigator: Callable[[], Navigator],
        earth: Earth | None = None,
    ) -> None:
        self.device, self._earth = device, earth or Earth()
        self._folder, self._new_navigator = folder, new_navigator
        self.received, self._factor = 0.0, 1.0
        self.thread, self.pending = ThreadPoolExecutor(1), 0
        self.order = PushOrder()
        self._previous, self._opened_ns = "", 0  # recording before this, start of this
        self._begin()

    def command(self, name: str, **values: float) -> None:
        """Do what the page asks for: start, stop, zero or fix.

        Raises:
            InputError: it is not possible now.
            OSError: it cannot be written.
        """
        commands: dict[str, Callable[..., None]] = {"start": self.start, "stop": self.stop}
        commands |= {"zero": self.track.zero, "fix": self.track.fix}
        commands[check_choice("command", name, commands)](**values)

    def start(self) -> None:
        """Start a new track and a new recording."""
        self.close()
        self.order = PushOrder()  # pushes that came after `stop` are not missing
        self._begin()

    def _begin(self, recording: str = "") -> None:
        self._recording, self._number = recording, -1
        self.track = LiveTrack(self.device, self._folder, self._new_navigator(), self._earth)
        self.running = True

    def take(self, batch: Batch, received: float, accel_factor: float = 1.0) -> int:
        """Pass a batch to its track at its turn; return the number of samples processed.

        Args:
            batch: batch of this device, which has passed `check`.
            received: time of receipt [s since 1970].
            accel_factor: factor from its accelerometer's unit to specific force in m/s^2.

        Raises:
            InputError, OSError: the recording cannot be written.
        """
        self._factor = accel_factor
        if not self.running:
            return 0
        if self._is_of_previous(batch):
            self.track.delayed += len(batch.readings)
            return 0
        self.order.add(batch, received)
        return self.release(received)

    def check(self, batch: Batch) -> None:
        """Check that a batch does not continue the recording before this, unless it comes late.

        Raises:
            InputError: it does: two devices have one name.
        """
        if not (self.running and self._is_of_previous(batch)):
            return
        if batch.number < 0 or batch.middle_ns >= self._opened_ns:
            found = f"samples of two recordings in turn from {self.device!r}"
            fix = "give each phone a name of its own"
            raise InputError("device", found, "one at a time", fix)

    def release(self, now: float) -> int:
        """Process the pushes whose turn it is at a time [s]; return their number of samples."""
        return sum(self._process(*each) for each in self.order.ready(now))

    def _process(self, batch: Batch, received: float) -> int:
        if not batch.readings:
            return 0
        if self._is_new(batch):
            self.track.close()
            self._previous, self._opened_ns = self._recording, batch.middle_ns
            self._begin(batch.recording)
        self._recording, self._number = batch.recording, max(self._number, batch.number)
        return self.track.process(batch, received, self._factor)

    def stop(self) -> None:
        """End the track; ignore data until `start`."""
        self.release(math.inf)
        self.running = False

    def close(self) -> None:
        """Process what still waits, and close the recording."""
        try:
            self.release(math.inf)
        finally:
            self.track.close()

    def status(self) -> dict[str, Any]:
        """Return what the page shows of the device."""
        known = {"id": self.device, "running": self.running, "received": self.received}
        return known | self.track.status()

    def _is_new(self, batch: Batch) -> bool:
        """Return whether a batch belongs to a different recording than those before."""
        newest = self.track.newest_ns
        if newest < 0:
            return False
        if self._recording and batch.recording and self._recording != batch.recording:
            return True
        first = min(reading.time_ns for reading in batch.credible())
        delayed = 0 <= batch.number < self._number  # rather than after the clock was set back
        set_back = batch.middle_ns - newest <= -BACKWARD and not delayed
        return first - newest >= FORWARD or set_back

    def _is_of_previous(self, batch: Batch) -> bool:
        """Return whether a batch is one of the recording before this."""
        named = batch.recording and batch.recording == self._previous != self._recording
        return bool(named and batch.readings)


MAX_DELAY = 0.8
"""Maximum time for which pushes wait for a missing one before them [s]; if the program is killed
they are lost, with the second before that."""


class PushOrder:
    """Order of one device's pushes; those without a number keep their order of arrival.

    The later of two pushes may arrive first, and one that failed is repeated after others. Sensor
    Logger numbers the pushes of a recording, so that one that comes too early waits for its turn.
    """

    def __init__(self) -> None:
        self._recording, self._next = "", 0
        self._recordings, self._arrivals = 0, 0
        self._waiting: list[tuple[int, int, int, float, Batch]] = []

    def add(self, batch: Batch, received: float) -> None:
        """Add a batch received at a time [s since 1970]."""
        if batch.recording != self._recording:
            self._recording, self._next = batch.recording, batch.number
            self._recordings += 1
        self._arrivals += 1
        entry = (self._recordings, batch.number, self._arrivals, received, batch)
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
