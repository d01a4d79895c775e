"""Data recorded alongside an IMU: positions, magnetic field, pressure, satellites, own attitude."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self, get_args

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

_ROW_SHAPES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("position_W", "velocity_W", "field"), (3,)),
    "position_covariance_W": (3, 3),
    "latlon_deg": (2,),
    **dict.fromkeys(("pressure_hPa", "sigma", "floor"), ()),
    **dict.fromkeys(("altitude_m", "radius_m", "speed_m_s", "bearing_deg"), ()),
}
"""Shape of a row of each array that is recorded alongside an IMU."""

_MAY_BE_NAN = {"latlon_deg", "floor", "altitude_m", "radius_m", "speed_m_s", "bearing_deg"}
"""Those that are unknown in some rows; the others are finite wherever a row is valid."""


@dataclass(frozen=True, eq=False, repr=False)
class Timed:
    """Rows at increasing times.

    Like `ImuSequence`, subclasses keep checked copies of their arguments; `_OF` names them in
    errors.
    """

    _OF: ClassVar[str] = ""

    time: FloatArray

    def __post_init__(self) -> None:
        time = checked_time(f"{self._OF}time", self.time)
        kept: dict[str, Any] = {"time": time}
        where: BoolArray | bool = True
        if "valid" in vars(self):
            where = kept["valid"] = checked_valid(f"{self._OF}valid", vars(self)["valid"], time)
        if "attitude_WB" in vars(self):
            check_rotations(f"{self._OF}attitude_WB", vars(self)["attitude_WB"], time)
        for name, value in vars(self).items():
            if name in _ROW_SHAPES and value is not None:
                shape = (len(time), *self._row_shape(name))
                finite = False if name in _MAY_BE_NAN else where
                kept[name] = checked_array(f"{self._OF}{name}", value, shape, finite)
        vars(self).update(kept)

    def _row_shape(self, name: str) -> tuple[int, ...]:
        return _ROW_SHAPES[name]

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
        latlon_deg: (N, 2) latitude and longitude on WGS 84 [deg], NaN where unknown; None if the
            source has none.
        floor: (N,) floors as the source counts them, NaN where unknown; None if it has none.

    Raises:
        InputError: lengths differ, time does not increase, a valid value is not finite, a valid
            standard deviation is not positive, or the kind is another.
    """

    position_W: FloatArray
    kind: Kind
    valid: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    sigma: FloatArray | None = None
    latlon_deg: FloatArray | None = None
    floor: FloatArray | None = None

    _OF = "positions' "

    def __post_init__(self) -> None:
        check_choice("positions' kind", self.kind, get_args(Kind))
        super().__post_init__()
        least = math.inf if self.sigma is None else self.sigma[self.valid].min(initial=math.inf)
        if least <= 0.0:
            raise InputError("positions' sigma", f"{least:g}", "above 0 m")

    def _row_shape(self, name: str) -> tuple[int, ...]:
        flat = name == "position_W" and np.shape(self.position_W)[1:] == (2,)
        return (2,) if flat else super()._row_shape(name)

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

    _OF = "magnetometer's "


@dataclass(frozen=True, eq=False, repr=False)
class Barometer(Timed):
    """Pressure of the air measured alongside the IMU, at its own times.

    Attributes:
        time: (M,) [s], on the IMU's clock, strictly increasing.
        pressure_hPa: (M,) [hPa], about 1013 at sea level.

    Raises:
        InputError: the lengths differ, time does not increase or a value is not finite.
    """

    pressure_hPa: FloatArray

    _OF = "barometer's "


@dataclass(frozen=True, eq=False, repr=False)
class Satellites(Timed):
    """Positions that a satellite receiver reported alongside the IMU, as it reported them.

    Attributes:
        time: (M,) [s], on the IMU's clock, strictly increasing.
        latlon_deg: (M, 2) latitude and longitude on WGS 84 [deg].
        altitude_m: (M,) [m]; like all below NaN where unknown, None if never reported.
        radius_m: (M,) accuracy as phones state it: the radius [m] that holds 68 % of positions.
        speed_m_s: (M,) speed over ground [m/s], from Doppler shifts.
        bearing_deg: (M,) direction of that speed, clockwise from north [deg].

    Raises:
        InputError: the lengths differ, time does not increase, or a latitude or longitude is not
            finite or not within 90 or 360 degrees.
    """

    latlon_deg: FloatArray
    altitude_m: FloatArray | None = None
    radius_m: FloatArray | None = None
    speed_m_s: FloatArray | None = None
    bearing_deg: FloatArray | None = None

    _OF = "satellites' "

    def __post_init__(self) -> None:
        super().__post_init__()
        beyond = ~(np.abs(self.latlon_deg) <= [90.0, 360.0])  # or NaN
        if beyond.any():
            row, column = np.argwhere(beyond)[0]
            raise InputError(
                f"satellites' latlon_deg, row {row}",
                f"{self.latlon_deg[row, column]:g}",
                "latitude within 90 and longitude within 360 degrees",
                "give latitude first",
            )


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

    _OF = "device attitude's "
