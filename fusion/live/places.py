"""Places by satellites: drawn beside a device's track, and its fixes where they are to be used."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock

import numpy as np

from stario.fusion.live.payload import Vector
from stario.fusion.values.fixes import Fix
from stario.fusion.values.satellites import georeference_of, reliable, satellite_fixes
from stario.sequences.geodesy import Georeference
from stario.sequences.readers.checked import OPTIONAL, satellites
from stario.sequences.sequence import Satellites

Place = list[float]
"""t [s], x, y [m] in the map, and the stated radius [m]."""

MAX_PLACES = 600
"""Maximum number of places drawn; beyond it every second one is dropped."""

_RECENT_S = 30.0
"""Time [s] over which earlier places decide how much a new one tells: are they held, how often."""

_LATEST_S, _EARLIEST_S = 60.0, 5.0
"""Times [s] by which a place may be ahead of the newest state, and behind it, to be used."""


class Earth:
    """Where on the earth the map lies that all devices of a server share; known to all threads.

    Attributes:
        georeference: the map's place, with x east; None until it is known.
    """

    def __init__(self) -> None:
        self.georeference: Georeference | None = None
        self._lock = Lock()

    def begin(self, georeference: Georeference | None) -> None:
        """Let the map lie at a place, unless it has one."""
        self.georeference = self.georeference or georeference

    def fixes(self, reported: Satellites) -> list[Fix]:
        """Return a receiver's positions and velocities as fixes; a first good one begins it."""
        with self._lock:
            found = satellite_fixes(reported, self.georeference)
            if found is None:
                return []
            self.begin(found.origin)
        return found.fixes


class Places:
    """Places of one recording. Not thread-safe, like its track.

    Attributes:
        use: what becomes of them, as in `PlaceConfig.satellites`.
        drawn: those to be drawn. A list that never changes: another takes its place.
    """

    def __init__(self, use: str, earth: Earth) -> None:
        self.use, self._earth = use, earth
        self._recent: list[Vector] = []
        self._shown: list[Vector] = []
        self._waiting: list[Fix] = []
        self._changed = False
        self.count = 0
        self.drawn: list[Place] = []

    def add(self, time: float, value: Vector) -> None:
        """Add a place at a time [s]; one no newer than the last, as phones repeat it, is none."""
        if self.use == "ignore" or (self._recent and time <= self._recent[-1][0]):
            return
        row = (time, *value)
        self._recent = [row for row in self._recent if time - row[0] <= _RECENT_S] + [row]
        self._shown.append(row)
        if len(self._shown) > MAX_PLACES:
            self._shown = self._shown[::2]
        self.count, self._changed = self.count + 1, True
        reported = _reported(self._recent)
        if self.use == "use" and reported is not None:
            self._waiting += [fix for fix in self._earth.fixes(reported) if fix.time == time]

    def compare(self) -> None:
        """Use them no more: the track was placed in a map that lies nowhere on the earth."""
        self._waiting, self._changed = [], True
        self.use = "compare" if self.use == "use" else self.use

    def words(self) -> str:
        """Return how many places there are and what became of them, in words."""
        if not self.count:
            return ""
        become, place = "compared with the track", self._earth.georeference
        if self.use == "use":
            at = place and f", origin {place.latitude_deg:.6f},{place.longitude_deg:.6f}"
            become = f"used{at or ''}"
        return f"{self.count} satellite position{'s' * (self.count > 1)} {become}"

    def due(self, time: float) -> list[Fix]:
        """Remove and return the fixes up to the time of a state [s]."""
        due = [fix for fix in self._waiting if time - _EARLIEST_S <= fix.time <= time]
        self._waiting = [fix for fix in self._waiting if time < fix.time < time + _LATEST_S]
        return due

    def draw(self, points: Sequence[Sequence[float]]) -> None:
        """Update what is drawn next to a track's points, if there are new places.

        Those that are compared lie where they fit the track best, once both have gone far enough.
        """
        if not (self._changed and self._shown and points):
            return
        self._changed = False
        known = _reported(self._shown)
        known = known and known.slice(points[0][0], points[-1][0])
        if known is None or not (good := reliable(known)).any():
            return
        known, place = known.select(good), self._earth.georeference
        if self.use == "compare":
            time, x, y = np.array([[p[0], p[10], p[11]] for p in points]).T
            track = np.column_stack([np.interp(known.time, time, axis) for axis in (x, y)])
            place = georeference_of(known.latlon_deg, track)
        if place is None:
            return
        radius = np.zeros(len(known)) if known.radius_m is None else np.nan_to_num(known.radius_m)
        rows = np.column_stack([known.time, place.xy(known.latlon_deg), radius])
        self.drawn = rows.round(2).tolist()


def _reported(rows: Sequence[Vector]) -> Satellites | None:
    """Return rows of a time and a place as a receiver reports them; None if there is none."""
    table = np.array(rows)
    rest = dict(zip(OPTIONAL.values(), table.T[3:], strict=True))
    return satellites(table[:, 0], table[:, 1:3], rest)
