"""Fixes: what something else than the IMU knows of position, yaw or velocity at some time.

They are given in the map frame, z up: for a track that starts without a pose they say where it is
and how it is turned (`filter.map_frame`). Yaw is that of the twist about the vertical (`lie`): for
a level device the direction its x axis points to, counter-clockwise from the map's x axis.
"""

from __future__ import annotations

import bisect
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from stario.fusion.checked import check_type, floored, shaped
from stario.fusion.state import Health
from stario.sequences.sequence import FloatArray

FixKind = Literal["position", "yaw", "velocity"]

log = logging.getLogger(__name__)

LARGEST_YAW = 20.0 * math.pi
"""A yaw of more than ten turns [rad] is in other units, or no yaw at all."""

KINDS: dict[str, int] = {"position": 3, "velocity": 3, "yaw": 1}
"""Kinds of fixes and how many numbers each measures."""

MOST_WAITING = 10_000
"""So many fixes of a stream may wait for their time, since memory must not grow."""

_SMALLEST_SIGMA = 1e-4
"""Nothing is measured better than this [m], [m/s], [rad]."""


@dataclass(frozen=True, eq=False)
class Fix:
    """One fix; made by `position_fix`, `yaw_fix` or `velocity_fix`.

    Attributes:
        time: [s].
        kind: what is measured.
        value: (3,) position [m] or velocity [m/s] in W, or (1,) yaw [rad].
        covariance: (3, 3) or (1, 1).
    """

    time: float
    kind: FixKind
    value: FloatArray
    covariance: FloatArray

    def shifted(self, by: FloatArray) -> Fix:
        """The fix in a frame whose origin lies at -`by` (3,) [m]."""
        return replace(self, value=self.value + by) if self.kind == "position" else self

    def fault(self) -> str:
        """Why it cannot be used; empty where it can."""
        numbers = (np.atleast_1d(self.time), self.value, self.covariance)
        if not all(np.isfinite(array).all() for array in numbers):
            return "value that is not finite"
        if self.kind == "yaw" and abs(self.value[0]) > LARGEST_YAW:
            return "yaw not in radians"
        C = self.covariance
        if np.abs(C - C.T).max() > 1e-6 * np.abs(C).max() or np.linalg.eigvalsh(C).min() <= 0.0:
            return "covariance not positive definite"
        return ""


class Accepted(NamedTuple):
    """A fix that a filter took in."""

    fix: Fix
    scale: float
    """Factor by which its covariance was inflated."""

    @property
    def inflated(self) -> Fix:
        """The fix as it was taken in."""
        return replace(self.fix, covariance=self.scale * self.fix.covariance)


def position_fix(time: float, p_W: Any, covariance: Any) -> Fix:
    """Position (3,) [m] with covariance (3, 3) [m^2].

    Raises:
        InputError: a value does not have that shape.
    """
    return make_fix(time, "position", p_W, covariance)


def velocity_fix(time: float, v_W: Any, covariance: Any) -> Fix:
    """Velocity (3,) [m/s] in W with covariance (3, 3) [m^2/s^2].

    Raises:
        InputError: a value does not have that shape.
    """
    return make_fix(time, "velocity", v_W, covariance)


def yaw_fix(time: float, yaw: Any, sigma: Any) -> Fix:
    """Yaw [rad] of the body with its standard deviation [rad].

    Raises:
        InputError: a value is no number.
    """
    sigma = shaped("sigma", sigma, ())
    # A square alone would hide a wrong sign, which `fault` is to see.
    variance = np.reshape(sigma * np.abs(sigma), (1, 1))
    return make_fix(time, "yaw", np.atleast_1d(shaped("yaw", yaw, ())), variance)


def by_time(fix: Fix) -> tuple[float, str]:
    """The order of fixes, whatever order they came in."""
    return fix.time, fix.kind


class FixQueue:
    """Fixes that wait for their time, in its order.

    Args:
        fixes: to begin with.
        most: so many may wait; beyond, those that lie furthest ahead are refused.

    Attributes:
        waiting: the fixes.
        refused: how many others were left out, by reason.
    """

    def __init__(self, fixes: Iterable[Fix] = (), most: float = MOST_WAITING) -> None:
        self._most = most
        self.waiting: list[Fix] = []
        self.refused: dict[str, int] = {}
        for fix in fixes:
            self.add(fix)

    def add(self, fix: Fix) -> None:
        """Keep a fix until `due`; one without meaning is refused and counted."""
        check_type("fixes", fix, Fix, "position_fix, velocity_fix and yaw_fix make one")
        if reason := fix.fault():
            self.refuse(reason)
            return
        bisect.insort(self.waiting, fix, key=by_time)
        if len(self.waiting) > self._most:
            self.waiting.pop()
            self.refuse("too many waiting")

    def due(self, time: float) -> list[Fix]:
        """Give out the fixes up to a time [s], in their order."""
        if not self.waiting or self.waiting[0].time > time:
            return []
        n = bisect.bisect_right(self.waiting, time, key=lambda fix: fix.time)
        due, self.waiting = self.waiting[:n], self.waiting[n:]
        return due

    def refuse(self, reason: str, count: int = 1) -> None:
        """Count fixes that were left out; the first of a kind is told."""
        if count:
            if reason not in self.refused:
                log.warning("a fix is left out: %s", reason)
            self.refused[reason] = self.refused.get(reason, 0) + count

    def start(self, time: float) -> None:
        """Refuse what lies before the first state's time [s]."""
        self.refuse("before the start", len(self.due(np.nextafter(time, -math.inf))))

    def health(self, health: Health) -> Health:
        """A report with what was refused and what still waits."""
        waiting = {"waiting": len(self.waiting)} if self.waiting else {}
        return replace(health, fixes=health.fixes | self.refused | waiting)


def make_fix(time: Any, kind: FixKind, value: Any, covariance: Any) -> Fix:
    """A fix of any kind from numbers of the shapes that belong to it; `InputError` otherwise."""
    n = KINDS[kind]
    return Fix(
        time=shaped("time", time, ()).item(),
        kind=kind,
        value=shaped(kind, value, (n,)),
        covariance=floored(shaped("covariance", covariance, (n, n)), _SMALLEST_SIGMA),
    )
