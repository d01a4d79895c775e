"""One recording of a device: samples go to disk, to a navigator, and to the displayed track."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from stario.fusion.live.drawn import DisplayedTrack
from stario.fusion.live.merging import MAX_WAIT, Merger, Sample
from stario.fusion.live.payload import LOCATION, MAG, Batch, Reading
from stario.fusion.live.places import Earth, Places
from stario.fusion.live.storage import LiveFile
from stario.fusion.navigator import Navigator
from stario.fusion.report.health import health_findings
from stario.fusion.values.fixes import Fix, position_fix
from stario.fusion.values.floors import floor_at
from stario.fusion.values.state import NavState
from stario.sequences.errors import InputError
from stario.sequences.findings import verdict
from stario.sequences.time_order import MAX_IMU_GAP

_MAX_UNWRITTEN = 6000
"""Maximum number of samples kept for the next attempt to write: a minute of a phone's."""

_HEALTH_SECONDS = 1.0

_FLOOR_SECONDS = 4.0
"""Time for which the height must have changed no more for a climb to be over [s]."""

_MANY_ALONE = 100
"""Number of readings of the gyroscope without acceleration that is a problem, if it is most."""

_START_SECONDS = 5.0
"""Time of samples [s] after which it is a problem that there is no position."""

_ERROR_SECONDS = 20.0
"""Time for which an error of the navigator is shown [s]: it begins again, and takes 13 s to see
that a gyroscope is not in rad/s."""

_CERTAIN = 0.7
"""Cosine between the vertical and the force above which the force's sign is certain."""


class LiveTrack:
    """Recording and track of one device. Not thread-safe, like its session.

    Args:
        device: name of the device.
        folder: folder for the recording, which is created with the first sample.
        navigator: a new navigator.
        earth: where on the earth the map lies.

    Attributes:
        delayed: number of readings that came after a later recording had begun.
    """

    def __init__(self, device: str, folder: Path, navigator: Navigator, earth: Earth) -> None:
        self._device, self._folder, self._navigator = device, folder, navigator
        self._earth = earth
        self._merger, self._factor = Merger(), 1.0
        self._file: LiveFile | None = None
        self._unwritten: tuple[list[Sample], list[Reading]] = [], []
        self._first_ns = self._newest_ns = -1
        self._push_error = self._write_error = ""
        self._health_time = self._error_time = -math.inf
        self._stray = self._lost = 0
        self.drawn = DisplayedTrack()
        self.places = Places(navigator.config.place.satellites, self._earth)
        self._georeferenced = navigator.config.place.origin is not None
        self._earth.begin(navigator.config.place.georeference)
        self._words: list[dict[str, str]] = []
        self._floor = ""
        self.samples = self.delayed = self._fixes = 0
        self._rate = 0.0

    @property
    def path(self) -> Path | None:
        """Path of the recording; None before the first sample."""
        return None if self._file is None else self._file.path

    @property
    def newest_ns(self) -> int:
        """Time of the newest sample on the device's clock [ns]; -1 before the first."""
        waiting = self._unwritten[0]
        return waiting[-1].time_ns if waiting and self._newest_ns >= 0 else self._newest_ns

    def process(self, batch: Batch, received: float, accel_factor: float) -> int:
        """Write a batch to disk, then pass it to the navigator, as `Session.take` got it."""
        readings = batch.credible()
        self._stray += len(batch.readings) - len(readings)
        self._factor = accel_factor
        # Samples wait until they are on disk: when a failed push is repeated, they count as late.
        samples = [
            *self._unwritten[0],
            *(
                sample._replace(accel=tuple(accel_factor * a for a in sample.accel))
                for sample in self._merger.add(readings, batch.places)
            ),
        ]
        if not samples:
            return 0
        aside = [*self._unwritten[1], *self._merger.aside()]
        self._write(samples, received, aside)
        self._navigate(samples, aside)
        self._count(samples)
        return len(samples)

    def close(self) -> None:
        """Close the recording."""
        if self._file is not None:
            self._file.close()

    def zero(self) -> None:
        """Display the newest position as the origin, without changing estimate or recording.

        Raises:
            InputError: there is no position yet, or the track lies on the earth.
        """
        if self._georeferenced:
            raise InputError("zero", "a track that lies on the earth", "one that does not")
        self.drawn.origin = self._state().p_W.copy()

    def fix(self, x: float, y: float, sigma: float) -> None:
        """Apply a fix at x, y of the displayed map [m] with sigma [m]; the height is left free.

        Raises:
            InputError: there is no position yet.
            OSError: it cannot be written; it is then not applied.
        """
        before = self._state()
        p_W = np.array([x, y, 0.0]) + self.drawn.origin
        p_W[2] = before.p_W[2]
        covariance = np.diag([sigma**2, sigma**2, 1e6])  # a tap says nothing about the height
        assert self._file is not None  # there is a state
        # First to disk, as samples: a fix that is not written moves nothing.
        fix = position_fix(before.time, p_W, covariance)
        self._file.append_fix(fix)
        if self._earth.georeference is None:
            self.places.compare()
        after = self._applied(fix)
        self._fixes += 1
        self._draw(after)
        self._health_time = -math.inf
        self._update_health(after.time)

    def status(self) -> dict[str, Any]:
        """Return what the page shows next to the track."""
        return {
            "samples": self.samples,
            "rate": round(self._rate, 1),
            "origin": self.drawn.origin.round(4).tolist(),
            "fixes": self._fixes,
            "dropped": self._dropped(),
            "file": None if self.path is None else self.path.name,
            "problem": self._problem(),
            "health": self._words,
            "floor": self._floor,
            "satellites": self.places.words(),
            "georeferenced": self._georeferenced,
        }

    def _problem(self) -> str:
        """Return what keeps the track from being right, in words; empty if nothing does."""
        if self._write_error:
            return self._write_error
        alone = self._merger.dropped["without acceleration"]
        if alone > max(_MANY_ALONE, self.samples):
            return (
                f"{alone} readings of the gyroscope have none of the acceleration within "
                f"{MAX_IMU_GAP:g} s before and after: log both at 50 Hz or more, on one clock"
            )
        if self._push_error:
            return self._push_error
        if self._merger.missing:
            return f"no samples of {self._merger.missing}: enable it in the logger"
        if self._merger.silent:
            return f"no samples of {self._merger.silent} for {MAX_WAIT / 1e9:g} s: the track waits"
        if self._navigator.state is None and self._seconds(self._newest_ns) > _START_SECONDS:
            return "no position so far: it takes a second of samples of both sensors without a gap"
        if self._factor * self._merger.upward < -_CERTAIN:
            other = "-m/s2" if self._factor > 0 else "m/s2"
            return (
                "the accelerometer points down where the phone's own attitude points up, as on an "
                f"iPhone: send to the address with accel_unit={other}"
            )
        return ""

    def _dropped(self) -> dict[str, int]:
        """Return the number of samples dropped, by reason."""
        here = {"late": self.delayed, "wrong time": self._stray, "not written": self._lost}
        return dict(self._merger.dropped + Counter(here))

    def _write(self, samples: list[Sample], received: float, aside: list[Reading]) -> None:
        """Write to disk, or keep for the next attempt as much as memory allows."""
        try:
            if self._file is None:
                self._file = LiveFile(self._folder, self._device)
            self._file.append(samples, received, aside)
        except (OSError, InputError) as error:
            self._write_error = f"the recording cannot be written: {error}"
            self._lost += max(0, len(samples) - _MAX_UNWRITTEN)
            self._unwritten = samples[-_MAX_UNWRITTEN:], aside[-_MAX_UNWRITTEN:]
            raise
        self._write_error, self._unwritten = "", ([], [])

    def _navigate(self, samples: list[Sample], aside: Sequence[Reading]) -> None:
        """Pass samples, fields and pressures to the navigator in the order of their times."""
        if self._first_ns < 0:
            self._first_ns = samples[0].time_ns
        # Some of the others may lie ahead of the samples, which wait for the accelerometer.
        events: Iterable[Sample | Reading] = heapq.merge(aside, samples, key=attrgetter("time_ns"))
        for each in events:
            time = self._seconds(each.time_ns)
            try:
                self._push(time, each)
            except InputError as error:  # in another unit
                self._push_error, self._error_time = str(error), time
        self._update_health(self._seconds(samples[-1].time_ns))  # with or without a position

    def _push(self, time: float, event: Sample | Reading) -> None:
        if isinstance(event, Sample):
            self._advance(self._navigator.push(time, event.gyro, event.accel))
        elif event.sensor == LOCATION:
            self.places.add(time, event.value)
        elif event.sensor == MAG:
            self._navigator.push_magnetometer(time, event.value)
        else:
            self._navigator.push_pressure(time, *event.value)

    def _advance(self, state: NavState | None) -> None:
        """Draw a new state, after the satellites' fixes up to its time."""
        if state is None:
            return
        if state.time - self._error_time > _ERROR_SECONDS:
            self._push_error = ""
        for fix in self.places.due(state.time):
            state = self._applied(fix)
        self._draw(state)

    def _applied(self, fix: Fix) -> NavState:
        """Apply a fix, which may move the track so far; return the state then."""
        before = self._state()
        navigator, arguments = self._navigator, (fix.time, fix.value, fix.covariance)
        if fix.kind == "velocity":
            navigator.update_velocity(*arguments)
        elif navigator.update_position(*arguments) != "refused" and self._earth.georeference:
            self._georeferenced, self.drawn.origin = True, np.zeros(3)
        after = self._state()
        if after.map_frame != before.map_frame:
            self.drawn.move(before, after)
        return after

    def _draw(self, state: NavState) -> None:
        pose = self._navigator.continuous
        assert pose is not None  # there is a state
        self.drawn.add(state, pose.p_W)

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._first_ns) / 1e9

    def _update_health(self, time: float) -> None:
        if time - self._health_time < _HEALTH_SECONDS:
            return
        self._health_time = time
        health, late = self._navigator.health, self._dropped().get("late", 0)
        # The navigator never sees them; if the clock was set back a little, it sees no gap either.
        health = replace(health, samples=health.samples | {"late": late})
        floor = ""  # as well when the stream began again and has no pressure yet
        if health.pressures:
            health.floors = self.drawn.floor_changes()
            floor = _floor_words(floor_at(health.floors, time - _FLOOR_SECONDS))
        self._floor = floor
        self.places.draw(self.drawn.points)
        self._words = [asdict(finding) for finding in verdict(health_findings(health))]

    def _count(self, samples: Sequence[Sample]) -> None:
        """Update the number of samples and their rate, smoothed over some batches."""
        last = samples[-1].time_ns
        since = self._newest_ns if self._newest_ns >= 0 else samples[0].time_ns
        self._newest_ns = max(self._newest_ns, last)
        self.samples += len(samples)
        if last > since:
            rate = 1e9 * len(samples) / (last - since)
            weight = min(1.0, (last - since) / 2e9) if self._rate else 1.0
            self._rate += weight * (rate - self._rate)

    def _state(self) -> NavState:
        state = self._navigator.state
        if state is None:
            raise InputError(self._device, "no position yet", "a second of samples first")
        return state


def _floor_words(floor: int | None) -> str:
    if floor is None:
        return "between floors"
    return f"floor {floor:+d}" if floor else "floor 0"
