"""Data recorded alongside an IMU: positions, the magnetic field, the device's own attitude."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, Self, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import (
    BoolArray,
    FloatArray,
    check_choice,
    check_rotations,
    checked_array,
    checked_time,
    checked_valid,
)
from stario.sequences.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Timed:
    """Rows at increasing times.

    Like `ImuSequence`, subclasses keep checked copies of their arguments: `vars(self).update`.
    """

    time: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        rate = f" at {self.rate:.1f} Hz" if len(self) > 1 else ""
        span = f"{self.time[0]:.2f} to {self.time[-1]:.2f} s"
        return f"{type(self).__name__}({len(self)} rows, {span}{rate})"

    @property
    def rate(self) -> float:
        """Median rate [Hz]; 0 for a single row."""
        return float(1.0 / np.median(np.diff(self.time))) if len(self) > 1 else 0.0

    def select(self, keep: BoolArray) -> Self:
        """Return the rows for which `keep` (N,) is True."""
        rows = {k: v for k, v in vars(self).items() if v is not None and k != "kind"}
        return replace(self, **{name: values[keep] for name, values in rows.items()})

    def slice(self, start: float, stop: float) -> Self | None:
        """Return the rows with start <= time <= stop [s], or None if there are none."""
        keep = (self.time >= start) & (self.time <= stop)
        return self.select(keep) if keep.any() else None


Kind = Literal["positions", "waypoints"]


@dataclass(frozen=True, eq=False, repr=False)
class PositionTrack(Timed):
    """Known positions without attitude: a position track, or waypoints that the user passed.

    Attributes:
        time: (N,) [s], strictly increasing.
        position_W: (N, 3), or horizontal (N, 2) [m].
        kind: "positions" (a continuous track) or "waypoints" (single instants).
        valid: (N,) bool, False where the position must not be used; all True by default.
        sigma: (N,) standard deviations [m] per horizontal axis that their source states, for
            example a satellite receiver; None if it states none.

    Raises:
        InputError: lengths differ, time does not increase, a valid value is not finite, a valid
            standard deviation is not positive, or the kind is another.
    """

    position_W: FloatArray
    kind: Kind
    valid: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    sigma: FloatArray | None = None

    def __post_init__(self) -> None:
        check_choice("positions' kind", self.kind, get_args(Kind))
        time = checked_time("positions' time", self.time)
        valid = checked_valid("positions' valid", self.valid, time)
        columns = 2 if np.ndim(self.position_W) == 2 and np.shape(self.position_W)[1] == 2 else 3
        shape = (len(time), columns)
        position_W = checked_array("positions", self.position_W, shape, where=valid)
        if self.sigma is not None:
            sigma = checked_array("positions' sigma", self.sigma, time.shape, where=valid)
            if sigma[valid].min(initial=math.inf) <= 0.0:
                raise InputError("positions' sigma", f"{sigma[valid].min():g}", "above 0 m")
            vars(self).update(sigma=sigma)
        vars(self).update(time=time, position_W=position_W, valid=valid)

    @property
    def typical_sigma(self) -> float | None:
        """Median of the valid standard deviations [m]; None if the source states none."""
        if self.sigma is None or not self.valid.any():
            return None
        return float(np.median(self.sigma[self.valid]))


@dataclass(frozen=True, eq=False, repr=False)
class Magnetometer(Timed):
    """Magnetic field measured alongside the IMU, at its own times.

    Attributes:
        time: (M,) [s], on the IMU's clock, strictly increasing.
        field: (M, 3) magnetic flux density in B [uT].

    Raises:
        InputError: the shapes do not agree, time does not increase or a value is not finite.
    """

    field: FloatArray

    def __post_init__(self) -> None:
        time = checked_time("magnetometer's time", self.time)
        field = checked_array("magnetic field", self.field, (len(time), 3))
        vars(self).update(time=time, field=field)


@dataclass(frozen=True, eq=False, repr=False)
class DeviceAttitude(Timed):
    """Attitude estimated by the device's own sensor fusion, in its own world frame with z up.

    Attributes:
        time: (M,) [s], on the IMU's clock, strictly increasing.
        attitude_WB: M rotations taking body B to that world.

    Raises:
        InputError: the lengths differ or time does not increase.
    """

    attitude_WB: Rotation

    def __post_init__(self) -> None:
        time = checked_time("device attitude's time", self.time)
        check_rotations("device attitude's attitude_WB", self.attitude_WB, time)
        vars(self).update(time=time)
