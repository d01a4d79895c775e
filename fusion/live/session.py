"""One device: passes its samples to a recording, a navigator and the displayed track."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from stario.fusion.fixes import position_fix
from stario.fusion.live.drawn import DisplayedTrack
from stario.fusion.live.merging import MAX_WAIT, Field, Merger, Sample
from stario.fusion.live.ordering import PushOrder
from stario.fusion.live.payload import Batch, Vector
from stario.fusion.live.storage import LiveFile
from stario.fusion.live.times import BACKWARD, middle_time, with_credible_time
from stario.fusion.navigator import Navigator
from stario.fusion.report.health import findings
from stario.fusion.state import NavState
from stario.sequences.errors import InputError

FORWARD = 60 * 10**9
"""A jump of the device's clock ahead by this [ns], or back by `BACKWARD`, starts a new track."""

_MAX_UNWRITTEN = 6000
"""Maximum number of samples kept for the next attempt to write: a minute of a phone's."""

_HEALTH_SECONDS = 1.0

_CERTAIN = 0.7
"""Cosine between the vertical and the force above which the force's sign is certain."""


class Session:
    """Stream of one device. Not thread-safe: the caller must hold the hub's lock for the device.

    Args:
        device: name of the device.
        folder: folder for recordings.
        new_navigator: returns a new navigator for each track.
    """

    def __init__(self, device: str, folder: Path, new_navigator: Callable[[], Navigator]) -> None:
        self.device = device
        self._folder, self._new_navigator = folder, new_navigator
        self.received, self._factor = 0.0, 1.0
        self._file: LiveFile | None = None
        self._order = PushOrder()
        self._previous, self._opened_ns = "", 0  # recording before this, start of this
        self._begin()

    def start(self) -> None:
        """Start a new track and a new recording."""
        self.close()
        self._order = PushOrder()  # pushes that came after `stop` are not missing
        self._begin()

    def _begin(self, recording: str = "") -> None:
        if self._file is not None:
            self._file.close()
        self._recording, self._number, self._merger = recording, -1, Merger()
        self._navigator, self._file = self._new_navigator(), None
        self._first_ns = self._newest_ns = -1
        self._health_time = -math.inf
        self.drawn = DisplayedTrack()
        self._push_error = self._write_error = ""
        self.words: list[dict[str, str]] = []
        self._unwritten: tuple[list[Sample], list[Field]] = [], []
        self.samples = self.fixes = self._delayed = self._stray = self._lost = 0
        self.rate = 0.0
        self.running = True

    @property
    def path(self) -> Path | None:
        """Path of the current recording, or of the last; None before the first sample."""
        return None if self._file is None else self._file.path

    def take(self, batch: Batch, received: float, accel_factor: float = 1.0) -> int:
        """Write a batch to disk, then pass it to the navigator, once its turn has come.

        Args:
            batch: batch of this device.
            received: time of receipt [s since 1970].
            accel_factor: factor from its accelerometer's unit to specific force in m/s^2.

        Returns:
            Number of samples processed.

        Raises:
            InputError: the batch continues the recording before this: two devices have one name.
        """
        self.received, self._factor = received, accel_factor
        if not self.running:
            return 0
        if self._is_of_previous(batch):
            if batch.number >= 0 and middle_time(batch) < self._opened_ns:
                self._delayed += len(batch.readings)
                return 0
            if batch.recording:
                found = f"samples of two recordings in turn from {self.device!r}"
                fix = "give each phone a name of its own"
                raise InputError("device", found, "one at a time", fix)
        self._order.add(batch, received)
        return self._process_ready(received)

    def _process_ready(self, now: float) -> int:
        return sum(self._process(*each) for each in self._order.ready(now))

    def _process(self, batch: Batch, received: float) -> int:
        if not batch.readings:
            return 0
        if self._is_new(batch):
            self._previous, self._opened_ns = self._recording, middle_time(batch)
            self._begin(batch.recording)
        self._recording, self._number = batch.recording, max(self._number, batch.number)
        factor, readings = self._factor, with_credible_time(batch)
        self._stray += len(batch.readings) - len(readings)
        samples = [
            (time, gyro, (factor * a[0], factor * a[1], factor * a[2]))
            for time, gyro, a in self._merger.add(readings)
        ]
        # Samples wait until they are on disk: when a failed push is repeated, they count as late.
        samples = [*self._unwritten[0], *samples]
        if not samples:
            return 0
        fields = [*self._unwritten[1], *self._merger.fields()]
        self._write(samples, received, fields)
        pending = deque(fields)
        for time_ns, gyro, accel in samples:
            while pending and pending[0][0] <= time_ns:
                self._push_field(*pending.popleft())
            self._push((time_ns - self._first_ns) / 1e9, gyro, accel)
        for time_ns, field in pending:  # ahead of the samples, which wait for the accelerometer
            self._push_field(time_ns, field)
        self._count(samples[0][0], samples[-1][0], len(samples))
        return len(samples)

    def _write(self, samples: list[Sample], received: float, fields: list[Field]) -> None:
        """Write to disk, or keep for the next attempt as much as memory allows."""
        try:
            if self._file is None:
                self._file = LiveFile(self._folder, self.device)
            self._file.append(samples, received, fields)
        except (OSError, InputError) as error:
            self._write_error = f"the recording cannot be written: {error}"
            self._lost += max(0, len(samples) - _MAX_UNWRITTEN)
            self._unwritten = samples[-_MAX_UNWRITTEN:], fields[-_MAX_UNWRITTEN:]
            raise
        self._write_error, self._unwritten = "", ([], [])
        if self._first_ns < 0:
            self._first_ns = samples[0][0]

    def stop(self) -> None:
        """End the track; ignore data until `start`."""
        self._process_ready(math.inf)
        self.running = False

    def zero(self) -> None:
        """Display the newest position as the origin, without changing estimate or recording.

        Raises:
            InputError: there is no position yet.
        """
        self.drawn.origin = self._state().p_W.copy()

    def fix(self, x: float, y: float, sigma: float) -> None:
        """Apply a fix at x, y of the displayed map [m] with sigma [m]; the height is left free.

        Raises:
            InputError: there is no position yet.
        """
        before = self._state()
        p_W = np.array([x, y, 0.0]) + self.drawn.origin
        p_W[2] = before.p_W[2]
        covariance = np.diag([sigma**2, sigma**2, 1e6])  # a tap says nothing about the height
        self._navigator.update_position(before.time, p_W, covariance)
        assert self._file is not None  # there is a state
        self._file.append_fix(position_fix(before.time, p_W, covariance))
        self.fixes += 1
        after = self._state()
        if after.map_frame != self.drawn.map_frame:
            self.drawn.move(before, after)
        self.drawn.add(after)
        self._update_health(after.time)

    def close(self) -> None:
        """Process what still waits, and close the recording."""
        try:
            self._process_ready(math.inf)
        finally:
            if self._file is not None:
                self._file.close()

    def status(self) -> dict[str, Any]:
        """Return what the page shows next to the track."""
        return {
            "id": self.device,
            "running": self.running,
            "samples": self.samples,
            "rate": round(self.rate, 1),
            "received": self.received,
            "origin": self.drawn.origin.round(4).tolist(),
            "fixes": self.fixes,
            "dropped": self._dropped(),
            "file": None if self.path is None else self.path.name,
            "problem": self._problem(),
            "health": self.words,
        }

    def _problem(self) -> str:
        """Return what keeps the track from being right, in words; empty if nothing does."""
        if self._write_error or self._push_error:
            return self._write_error or self._push_error
        if self._merger.missing:
            return f"no samples of {self._merger.missing}: enable it in the logger"
        if self._merger.silent:
            return f"no samples of {self._merger.silent} for {MAX_WAIT / 1e9:g} s: the track waits"
        if self._factor * self._merger.upward < -_CERTAIN:
            other = "-m/s2" if self._factor > 0 else "m/s2"
            return (
                "the accelerometer points down where the phone's own attitude points up, as on an "
                f"iPhone: send to the address with accel_unit={other}"
            )
        return ""

    def _dropped(self) -> dict[str, int]:
        dropped = self._merger.dropped
        late = dropped.get("late", 0) + self._delayed
        counts = dropped | {"late": late, "wrong time": self._stray, "not written": self._lost}
        return {reason: count for reason, count in counts.items() if count}

    def _is_new(self, batch: Batch) -> bool:
        """Return whether a batch belongs to a different recording than those before."""
        if self._newest_ns < 0:
            return False
        if self._recording and batch.recording and self._recording != batch.recording:
            return True
        waiting = self._unwritten[0]
        middle, newest = middle_time(batch), waiting[-1][0] if waiting else self._newest_ns
        first = min(reading.time_ns for reading in with_credible_time(batch))
        delayed = 0 <= batch.number < self._number  # rather than after the clock was set back
        return first - newest >= FORWARD or (middle - newest <= -BACKWARD and not delayed)

    def _is_of_previous(self, batch: Batch) -> bool:
        """Return whether a batch is one of the recording before this."""
        of_this = not batch.readings or batch.recording == self._recording
        return batch.recording == self._previous and not of_this

    def _push_field(self, time_ns: int, field: Vector) -> None:
        self._navigator.push_magnetometer((time_ns - self._first_ns) / 1e9, field)

    def _push(self, time: float, gyro: Any, accel: Any) -> None:
        try:
            state = self._navigator.push(time, gyro, accel)
        except InputError as error:
            self._push_error = str(error)
            return
        if state is None:
            return
        self._push_error = ""
        self.drawn.add(state)
        self._update_health(state.time)

    def _update_health(self, time: float) -> None:
        if time - self._health_time < _HEALTH_SECONDS:
            return
        self._health_time = time
        health, late = self._navigator.health, self._dropped().get("late", 0)
        # The navigator never sees them; if the clock was set back a little, it sees no gap either.
        health = replace(health, samples=health.samples | {"late": late})
        self.words = [asdict(finding) for finding in findings(health)]

    def _count(self, first_ns: int, last_ns: int, count: int) -> None:
        """Update the number of samples and their rate, smoothed over some batches."""
        since = self._newest_ns if self._newest_ns >= 0 else first_ns
        self._newest_ns = max(self._newest_ns, last_ns)
        self.samples += count
        if last_ns > since:
            rate = 1e9 * count / (last_ns - since)
            weight = min(1.0, (last_ns - since) / 2e9) if self.rate else 1.0
            self.rate += weight * (rate - self.rate)

    def _state(self) -> NavState:
        state = self._navigator.state
        if state is None:
            raise InputError(self.device, "no position yet", "a second of samples first")
        return state
