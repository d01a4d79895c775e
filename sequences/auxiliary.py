"""Data recorded alongside an IMU: positions, magnetic field, pressure, satellites, own attitude."""

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
        rest = {"latlon_deg": (len(time), 2), "floor": time.shape}
        vars(self).update(_optional_arrays(self, "positions'", rest))
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
class Barometer(Timed):
    """Pressure of the air measured alongside the IMU, at its own times.

    Attributes:
        time: (M,) [s], on the IMU's clock, strictly increasing.
        pressure_hPa: (M,) [hPa], about 1013 at sea level.

    Raises:
        InputError: the lengths differ, time does not increase or a value is not finite.
    """

    pressure_hPa: FloatArray

    def __post_init__(self) -> None:
        time = checked_time("barometer's time", self.time)
        pressure_hPa = checked_array("pressure_hPa", self.pressure_hPa, time.shape)
        vars(self).update(time=time, pressure_hPa=pressure_hPa)


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

    def __post_init__(self) -> None:
        time = checked_time("satellites' time", self.time)
        latlon_deg = checked_array("satellites' latlon_deg", self.latlon_deg, (len(time), 2))
        beyond = np.abs(latlon_deg) > [90.0, 360.0]
        if beyond.any():
            row, column = np.argwhere(beyond)[0]
            raise InputError(
                f"satellites' latlon_deg, row {row}",
                f"{latlon_deg[row, column]:g}",
                "latitude within 90 and longitude within 360 degrees",
                "give latitude first",
            )
        rest = dict.fromkeys(("altitude_m", "radius_m", "speed_m_s", "bearing_deg"), time.shape)
        vars(self).update(_optional_arrays(self, "satellites'", rest))
        vars(self).update(time=time, latlon_deg=latlon_deg)


def _optional_arrays(
    owner: Timed, words: str, shapes: dict[str, tuple[int, ...]]
) -> dict[str, FloatArray]:
    """Return the attributes of `shapes` that are known, checked; they may hold NaN."""
    return {
        name: checked_array(f"{words} {name}", value, shape, where=False)
        for name, shape in shapes.items()
        if (value := getattr(owner, name)) is not None
    }


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
