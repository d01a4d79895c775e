"""Fixes: external measurements of position, yaw or velocity.

They are given in the map frame, z up, and place and orient a track that starts without a pose
(`filter.map_frame`). Yaw is that of the twist about the vertical (`lie`): for a level device, the
direction of its x axis, counter-clockwise from the map's x axis.
"""

from __future__ import annotations

import bisect
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from stario.fusion.values.checked import floored, shaped
from stario.fusion.values.health import Health
from stario.sequences.arrays import check_type, short_repr
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray

FixKind = Literal["position", "yaw", "velocity"]

log = logging.getLogger(__name__)

MAX_YAW = 20.0 * math.pi
"""Largest plausible yaw [rad]: more than ten turns indicate other units or another quantity."""

KINDS: dict[str, int] = {"position": 3, "velocity": 3, "yaw": 1}
"""Kinds of fixes, with the dimension of each."""

MAX_WAITING = 10_000
"""Maximum number of fixes of a stream that wait for their time, to bound memory."""

_MAX_VALUE, _MAX_VARIANCE = 1e9, 1e100
"""Largest number in the value of a fix and in its covariance. More stands for "unknown" in the
output of receivers: it would place the track where 64 bits have no digits for metres, and the
squares that an update needs are not finite."""

_HIGH_M, _HIGHEST_M = 150.0, 9e3
"""Heights of places on earth, but not within a map that is less than 180 m wide."""

UNKNOWN_HEIGHT = 1e3
"""Standard deviation of the height [m] of a position without one."""

_MIN_SIGMA = 1e-4
"""Smallest standard deviation of a fix [m], [m/s], [rad]."""

_MIN_EIGENVALUE = 1e-12
"""Smallest eigenvalue of its correlation matrix: less is a singular matrix with its rounding, which
some factorisations take for positive definite and others do not."""


@dataclass(frozen=True, eq=False)
class Fix:
    """One fix, created by `position_fix`, `yaw_fix` or `velocity_fix`.

    Attributes:
        time: [s].
        kind: measured quantity.
        value: (3,) position [m] or velocity [m/s] in W, or (1,) yaw [rad].
        covariance: (3, 3) or (1, 1).
    """

    time: float
    kind: FixKind
    value: FloatArray
    covariance: FloatArray

    @property
    def has_height(self) -> bool:
        """Whether a position's height is known at all."""
        return bool(self.covariance[2, 2] < UNKNOWN_HEIGHT**2)

    def shifted(self, by: FloatArray) -> Fix:
        """Express the fix in a frame whose origin lies at -`by` (3,) [m]."""
        return replace(self, value=self.value + by) if self.kind == "position" else self

    def fault(self) -> str:
        """Return why the fix cannot be used; empty if it can."""
        numbers = (np.atleast_1d(self.time), self.value, self.covariance)
        if not all(np.isfinite(array).all() for array in numbers):
            return "value that is not finite"
        if self.kind == "yaw" and abs(self.value[0]) > MAX_YAW:
            return "yaw not in radians"
        C = self.covariance
        if np.abs(self.value).max() > _MAX_VALUE or np.abs(C).max() > _MAX_VARIANCE:
            return "value too large"
        if np.abs(C - C.T).max() > 1e-6 * np.abs(C).max() or not C.diagonal().min() > 0.0:
            return "covariance not positive definite"
        sigma = np.sqrt(C.diagonal())
        if np.linalg.eigvalsh(C / sigma / sigma[:, None]).min() < _MIN_EIGENVALUE:
            return "covariance not positive definite"
        return ""


FixOutcome = Literal["applied", "inflated", "waiting", "refused"]
"""What became of a fix: applied, applied with a larger covariance as an outlier, waiting for its
time, or refused (`Health.fixes` counts the reasons)."""


class Accepted(NamedTuple):
    """A fix applied by a filter."""

    fix: Fix
    scale: float
    """Factor applied to its covariance."""

    @property
    def outcome(self) -> FixOutcome:
        """Whether it was an outlier."""
        return "inflated" if self.scale > 1.0 else "applied"

    @property
    def inflated(self) -> Fix:
        """The fix with its covariance as applied."""
        return replace(self.fix, covariance=self.scale * self.fix.covariance)


def position_fix(time: float, p_W: Any, covariance: Any) -> Fix:
    """Create a fix of position (3,) [m] with covariance (3, 3) [m^2].

    Raises:
        InputError: a value does not have that shape, or the position can only be latitude and
            longitude in degrees with a height.
    """
    fix = make_fix(time, "position", p_W, covariance)
    latitude, longitude, height = np.abs(fix.value)
    if latitude <= 90.0 and longitude <= 180.0 and _HIGH_M < height < _HIGHEST_M:
        remedy = "give metres east, north and up of a place nearby; if these are, take it higher up"
        found = f"{short_repr(fix.value.tolist())}, as of latitude, longitude and height"
        raise InputError("position", found, "metres in the map's frame", remedy)
    return fix


def velocity_fix(time: float, v_W: Any, covariance: Any) -> Fix:
    """Create a fix of velocity (3,) [m/s] in W with covariance (3, 3) [m^2/s^2].

    Raises:
        InputError: a value does not have that shape.
    """
    return make_fix(time, "velocity", v_W, covariance)


def yaw_fix(time: float, yaw: Any, sigma: Any) -> Fix:
    """Create a fix of the body's yaw [rad] with its standard deviation [rad].

    Raises:
        InputError: a value is not a number.
    """
    sigma = shaped("sigma", sigma, ())
    with np.errstate(over="ignore"):  # `fault` refuses what is not finite
        # Squaring would hide a wrong sign from `fault`.
        variance = np.reshape(sigma * np.abs(sigma), (1, 1))
    return make_fix(time, "yaw", np.atleast_1d(shaped("yaw", yaw, ())), variance)


def fix_list(fixes: Iterable[Fix]) -> list[Fix]:
    """Return fixes as a list; `InputError` if there is anything else among them."""
    check_type("fixes", fixes, Iterable, "a list of them")
    listed = list(fixes)
    for fix in listed:
        check_type("fixes", fix, Fix, "position_fix, velocity_fix and yaw_fix create one")
    return listed


def by_time(fix: Fix) -> tuple[float, str]:
    """Return the sort key, which makes the result independent of the order of arrival."""
    return fix.time, fix.kind


class FixQueue:
    """Fixes waiting for their time, in order of time.

    Args:
        fixes: initial fixes.
        most: maximum number of waiting fixes; beyond it, those furthest ahead are refused.

    Attributes:
        waiting: the waiting fixes.
        refused: number of refused fixes, by reason.
        kinds: number of valid fixes, by kind.
    """

    def __init__(self, fixes: Iterable[Fix] = (), most: float = MAX_WAITING) -> None:
        self._most = most
        self.waiting: list[Fix] = []
        self.refused: dict[str, int] = {}
        self.kinds: dict[str, int] = {}
        for fix in fix_list(fixes):
            self.add(fix)

    def add(self, fix: Fix) -> FixOutcome:
        """Keep a fix until it is due; invalid ones are refused and counted."""
        if reason := fix.fault():
            self.refuse(reason)
            return "refused"
        self.count(fix)
        bisect.insort(self.waiting, fix, key=by_time)
        if len(self.waiting) > self._most:
            furthest = self.waiting.pop()
            self.refuse("too many waiting")
            if furthest is fix:
                return "refused"
        return "waiting"

    def count(self, fix: Fix) -> None:
        """Count a valid fix by its kind."""
        self.kinds[fix.kind] = self.kinds.get(fix.kind, 0) + 1

    def due(self, time: float) -> list[Fix]:
        """Remove and return the fixes up to a time [s], in order."""
        if not self.waiting or self.waiting[0].time > time:
            return []
        n = bisect.bisect_right(self.waiting, time, key=lambda fix: fix.time)
        due, self.waiting = self.waiting[:n], self.waiting[n:]
        return due

    def refuse(self, reason: str, count: int = 1) -> None:
        """Count refused fixes; the first one for each reason is logged."""
        if count:
            if reason not in self.refused:
                log.warning("fix refused: %s", reason)
            self.refused[reason] = self.refused.get(reason, 0) + count

    def start(self, time: float) -> None:
        """Refuse fixes before the time of the first state [s]."""
        self.refuse("before the start", len(self.due(np.nextafter(time, -math.inf))))

    def health(self, health: Health) -> Health:
        """Add the refused and the waiting fixes to a report."""
        waiting = {"waiting": len(self.waiting)} if self.waiting else {}
        fixes = health.fixes | self.refused | waiting
        return replace(health, fixes=fixes, fix_kinds=dict(self.kinds))


def make_fix(time: Any, kind: FixKind, value: Any, covariance: Any) -> Fix:
    """Create a fix of any kind; `InputError` if a value does not have the shape of that kind."""
    n = KINDS[kind]
    return Fix(
        time=shaped("time", time, ()).item(),
        kind=kind,
        value=shaped(kind, value, (n,)),
        covariance=floored(shaped("covariance", covariance, (n, n)), _MIN_SIGMA),
    )
