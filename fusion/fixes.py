"""Fixes: what something else than the IMU knows of position, heading or velocity at some time.

A file of fixes is a CSV with the header `t,kind,x,y,z,sx,sy,sz` and one fix per line:

    t     time [s] since the recording's first sample
    kind  position, velocity or heading
    x y z position [m] or velocity [m/s] in W; a heading gives its yaw [rad] in x and leaves y, z
    sx    standard deviation [m], [m/s] or [rad]
    sy sz standard deviations of the other axes; empty where they equal sx

W is the fixes' own world, z up: for a track that starts without a pose they say where it is and
how it is turned (`world.WorldFrame`). Yaw is that of the twist about the vertical
(`jacobians.yaw_twist`): for a level device the direction its x axis points to, counted from W's x
axis towards y.
"""

from __future__ import annotations

import bisect
import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from stario.fusion.checked import floored, shaped
from stario.fusion.lie import FloatArray
from stario.sequences.errors import InputError, ReadError
from stario.sequences.sequence import ImuSequence

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from stario.fusion.imu.intervals import Epoch

FixKind = Literal["position", "heading", "velocity"]

KINDS: dict[str, int] = {"position": 3, "velocity": 3, "heading": 1}
"""Kinds of fixes and how many numbers each measures."""

MOST_HELD = 10_000
"""So many fixes may wait for their time; more are refused, since memory must not grow."""

_SMALLEST_SIGMA = 1e-4
"""Nothing is measured better than this [m], [m/s], [rad]."""

_SAME_TIME = 1e-6
"""Fixes this close [s] to an epoch's end are taken to be at it."""

_COLUMNS = ("t", "kind", "x", "y", "z", "sx", "sy", "sz")


@dataclass(frozen=True, eq=False)
class Fix:
    """One fix; made by `position_fix`, `heading_fix` or `velocity_fix`.

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
        """The fix in a world whose origin lies at -`by` (3,) [m]."""
        return replace(self, value=self.value + by) if self.kind == "position" else self

    def fault(self) -> str:
        """Why it cannot be used; empty where it can."""
        numbers = (np.atleast_1d(self.time), self.value, self.covariance)
        if not all(np.isfinite(array).all() for array in numbers):
            return "value that is not finite"
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
    return _fix(time, "position", p_W, covariance)


def velocity_fix(time: float, v_W: Any, covariance: Any) -> Fix:
    """Velocity (3,) [m/s] in W with covariance (3, 3) [m^2/s^2].

    Raises:
        InputError: a value does not have that shape.
    """
    return _fix(time, "velocity", v_W, covariance)


def heading_fix(time: float, yaw: Any, sigma: Any) -> Fix:
    """Yaw [rad] of the body with its standard deviation [rad].

    Raises:
        InputError: a value is no number.
    """
    sigma = shaped("sigma", sigma, ())
    # A square alone would hide a wrong sign, which `fault` is to see.
    variance = np.reshape(sigma * np.abs(sigma), (1, 1))
    return _fix(time, "heading", np.atleast_1d(shaped("yaw", yaw, ())), variance)


def by_time(fix: Fix) -> tuple[float, str]:
    """The order of fixes, whatever order they came in."""
    return fix.time, fix.kind


class FixQueue:
    """Fixes that wait for their time, and why others were refused."""

    def __init__(self, fixes: Iterable[Fix] = ()) -> None:
        self._held: list[Fix] = []
        self.refused: dict[str, int] = {}
        for fix in fixes:
            self.hold(fix)

    def __len__(self) -> int:
        return len(self._held)

    def hold(self, fix: Fix) -> None:
        """Keep a fix until `due`; one without meaning is refused and counted."""
        reason = fix.fault()
        if not reason and len(self._held) >= MOST_HELD:
            reason = "too many waiting"
        if reason:
            self.refuse(reason)
        else:
            bisect.insort(self._held, fix, key=by_time)

    def due(self, time: float) -> list[Fix]:
        """Give out the fixes up to a time [s], in their order."""
        if not self._held or self._held[0].time > time:
            return []
        n = bisect.bisect_right(self._held, time, key=lambda held: held.time)
        due, self._held = self._held[:n], self._held[n:]
        return due

    def refuse(self, reason: str, count: int = 1) -> None:
        """Count fixes that were left out."""
        if count:
            self.refused[reason] = self.refused.get(reason, 0) + count

    def start(self, time: float) -> None:
        """Refuse what lies before the first state's time [s]."""
        self.refuse("before the start", len(self.due(np.nextafter(time, -math.inf))))

    def checkpoint(self) -> dict[str, Any]:
        """Everything that `rewind` needs."""
        return {"held": [vars(fix) for fix in self._held], "refused": dict(self.refused)}

    def rewind(self, checkpoint: dict[str, Any]) -> None:
        """Go back to a checkpoint."""
        self._held = [Fix(**fix) for fix in checkpoint["held"]]
        self.refused = dict(checkpoint["refused"])

    @property
    def held(self) -> list[Fix]:
        """Those that wait, in the order of their times."""
        return list(self._held)


def parts(epoch: Epoch, fixes: Sequence[Fix]) -> list[tuple[Epoch | None, list[Fix]]]:
    """An epoch cut at its fixes' times: each piece, and the fixes at that piece's end.

    Fixes at the epoch's very start come first, with no piece before them.

    Args:
        epoch: the epoch.
        fixes: with start <= time <= stop, in order.
    """
    pieces: list[tuple[Epoch | None, list[Fix]]] = []
    rest = epoch
    for fix in fixes:
        if fix.time <= rest.start + _SAME_TIME:
            if not pieces:
                pieces.append((None, []))
        elif fix.time < rest.stop - _SAME_TIME:
            before, rest = cut(rest, fix.time)
            pieces.append((before, []))
        else:
            break
        pieces[-1][1].append(fix)
    taken = sum(len(due) for _, due in pieces)
    return [*pieces, (rest, list(fixes[taken:]))]


def cut(epoch: Epoch, time: float) -> tuple[Epoch, Epoch]:
    """An epoch before and after a time [s] inside it; the window and the update stay behind it."""
    k = int(np.searchsorted(epoch.time, time))
    weight = (time - epoch.time[k - 1]) / (epoch.time[k] - epoch.time[k - 1])
    first: dict[str, Any] = {"time": np.append(epoch.time[:k], time)}
    second: dict[str, Any] = {"time": np.append(time, epoch.time[k:])}
    if second["time"][1] - time < 1e-9:
        second["time"] = np.append(time, epoch.time[k + 1 :])
    for name in ("gyro", "accel"):
        values = getattr(epoch, name)
        at = (1.0 - weight) * values[k - 1] + weight * values[k]
        first[name] = np.vstack([values[:k], at])
        second[name] = np.vstack([at, values[len(values) - len(second["time"]) + 1 :]])
    return replace(epoch, **first, update=False, window=None, R_NB_window=None), replace(
        epoch, **second
    )


def read_fixes(path: Path | str) -> list[Fix]:
    """The fixes of a CSV file, in the format of this module's first lines.

    Raises:
        ReadError: the file cannot be read, its header or a line does not fit; names the line.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ReadError(path, "file", str(error), "a readable CSV of fixes") from error
    expected = ",".join(_COLUMNS)
    header = [word.strip() for word in rows[0]] if rows else []
    if header != list(_COLUMNS):
        raise ReadError(path, "line 1", ",".join(header) or "nothing", f"the header {expected}")
    return [_read_row(path, k, row) for k, row in enumerate(rows[1:], start=2) if any(row)]


def check_within(fixes: Sequence[Fix], sequence: ImuSequence) -> None:
    """Refuse fixes of which none is of the recording's time.

    Raises:
        InputError: they are of another clock.
    """
    times, start, stop = [fix.time for fix in fixes], sequence.time[0], sequence.time[-1]
    if times and not any(start <= t <= stop for t in times):
        found = f"times from {min(times):.6g} to {max(times):.6g} s"
        expected = f"some within the recording's, {start:.6g} to {stop:.6g} s"
        raise InputError("fixes", found, expected, "count them from the recording's first sample")


def _read_row(path: Path, number: int, row: list[str]) -> Fix:
    where = f"line {number}"
    if len(row) > len(_COLUMNS):
        raise ReadError(path, where, f"{len(row)} values", f"at most {len(_COLUMNS)}")
    cells = dict(zip(_COLUMNS, [*(word.strip() for word in row), *[""] * 8], strict=False))
    kind = cells["kind"]
    if kind not in KINDS:
        raise ReadError(path, f"{where}, kind", repr(kind), f"one of {', '.join(KINDS)}")
    axes = "xyz"[: KINDS[kind]]
    cells |= {f"s{a}": cells[f"s{a}"] or cells["sx"] for a in axes}

    def number_in(name: str) -> float:
        try:
            value = float(cells[name])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ReadError(path, f"{where}, {name}", repr(cells[name]), "a finite number")
        return value

    sigma = [number_in(f"s{a}") for a in axes]
    if min(sigma) <= 0.0:
        raise ReadError(path, f"{where}, sigma", repr(min(sigma)), "a standard deviation > 0")
    value = np.array([number_in(a) for a in axes])
    return _fix(number_in("t"), kind, value, np.diag(np.square(sigma)))  # type: ignore[arg-type]


def _fix(time: Any, kind: FixKind, value: Any, covariance: Any) -> Fix:
    n = KINDS[kind]
    return Fix(
        time=shaped("time", time, ()).item(),
        kind=kind,
        value=shaped(kind, value, (n,)),
        covariance=floored(shaped("covariance", covariance, (n, n)), _SMALLEST_SIGMA),
    )
