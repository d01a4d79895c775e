"""Rides: the network sees the device stand, and the IMU contradicts it for seconds.

README.md, "Gates". In a vehicle that starts, turns or brakes one stands or sits: the network's
displacement is one relative to the vehicle, and the IMU measures the vehicle's acceleration. False
displacements of a walk are larger, and shakes of a standing device cancel within a second. When
it began and how it went on is not told: it may last from the walk before to the walk after.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.values.state import changed
from stario.sequences.windows import WINDOW_SECONDS

_SECONDS, _SHARE = 5.0, 0.7
"""Share of the displacements within this time [s] that must contradict the IMU: a vehicle takes
longer to start or to brake; what a throw leaves behind is over after two seconds."""

_STANDING = 0.5
"""Mean displacement of a second [m] below which the device stands in something, or on it."""

_RIDING_NIS = 12.5
"""NIS that this share exceeds in a ride, halfway between what a device that stands or is thrown has
(up to 11) and in buses (from 14 on; EXPERIMENTS.md, "Rides")."""

_SPEED_SIGMA = 7.5
"""Standard deviation per axis of a vehicle's velocity [m/s]: uniform up to 15 m/s."""

RIDES_LISTED = 100
"""Number of rides that are kept, the latest ones."""


@dataclass(frozen=True)
class RideEvidence:
    """Whether the device rides, and when it did.

    Attributes:
        windows: end [s], NIS and length [m] of each displacement of the last seconds without rest.
        standing_since: time since which it has not walked [s]; infinity while it walks.
        riding: whether it was accelerated since then as no walk does.
        rides: for each ride, when it ceased to walk and when it walked again, or now [s].
    """

    windows: tuple[tuple[float, float, float], ...] = ()
    standing_since: float = math.inf
    riding: bool = False
    rides: tuple[tuple[float, float], ...] = ()

    def after(
        self, stop: float, offered: WindowDisplacement | None, outcome: UpdateResult | None
    ) -> RideEvidence:
        """Return the evidence after a displacement up to a time [s] and its outcome."""
        if offered is None or outcome is None or outcome.residual is None:
            return self
        latest = stop, outcome.nis, math.hypot(*offered.d_N[:2])
        windows = tuple(each for each in (*self.windows, latest) if each[0] > stop - _SECONDS)
        after = changed(self, windows=windows)
        if windows[0][0] > stop - _SECONDS + WINDOW_SECONDS:  # not all of the time yet
            return after
        _, nis, metres = np.array(windows).T
        if metres.mean() > _STANDING:
            return changed(after, standing_since=math.inf, riding=False)
        accelerated = bool(np.quantile(nis, 1.0 - _SHARE) > _RIDING_NIS)
        return after._standing(windows[0][0] - WINDOW_SECONDS, stop, accelerated)

    def way_variance(self, time: float, known: float) -> float:
        """Return the variance per axis of the way in rides between two times [m^2].

        Args:
            time: the later one [s].
            known: the earlier one, at which a position was known [s]; or minus infinity.
        """
        seconds = (min(until, time) - max(since, known) for since, until in self.rides)
        return (_SPEED_SIGMA * sum(each for each in seconds if each > 0.0)) ** 2

    def at_rest(self, stop: float) -> RideEvidence:
        """Return the evidence at rest: what follows is another acceleration."""
        return changed(self, windows=())._standing(stop, stop, False)

    def _standing(self, since: float, stop: float, accelerated: bool) -> RideEvidence:
        """Return the evidence of a device that does not walk."""
        since, rides = min(self.standing_since, since), self.rides
        riding = self.riding or accelerated
        if riding:
            before = rides[:-1] if self.riding else rides
            rides = (*before, (since, stop))[-RIDES_LISTED:]
        return changed(self, standing_since=since, riding=riding, rides=rides)
