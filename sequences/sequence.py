"""Recorded data: an IMU sequence and, where known, the true trajectory.

Frames: B is the body (the IMU's axes), W the world (z up, gravity along -z, yaw arbitrary).
`R_WB` takes vectors from B to W; quaternions are `quat_xyzw`; time is float64 seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import BoolArray as BoolArray
from stario.sequences.arrays import FloatArray as FloatArray
from stario.sequences.arrays import (
    as_float64,
    check_type,
    checked_time,
    finite_times,
    interpolated,
)
from stario.sequences.attitude.stacks import slerp
from stario.sequences.auxiliary import Barometer as Barometer
from stario.sequences.auxiliary import DeviceAttitude as DeviceAttitude
from stario.sequences.auxiliary import Magnetometer as Magnetometer
from stario.sequences.auxiliary import PositionTrack as PositionTrack
from stario.sequences.auxiliary import Satellites as Satellites
from stario.sequences.auxiliary import Timed
from stario.sequences.errors import InputError
from stario.sequences.time_order import ahead_mask, increasing_mask

STANDARD_GRAVITY = 9.80665
"""Default magnitude of gravity [m/s^2]."""

MAX_TRUTH_GAP = 0.1
"""Longest step [s] between two valid ground-truth samples that is interpolated across."""

MAX_SENSOR_VALUE = 1e5
"""Bound above any sensor's values in any unit used here; also catches infinities."""

GAP_STEPS = 1.8
"""A step longer than this many median steps has lost a sample."""

_ROUNDING_S = 1e-6
"""Rounding error allowed in a step [s]: 0.3 - 0.2 > 0.1, and more for seconds since 1970."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Timed):
    """A track of poses in the world frame W.

    Attributes:
        time: (N,) [s], strictly increasing.
        position_W: (N, 3) [m].
        attitude_WB: N rotations taking body B to world W.
        velocity_W: (N, 3) [m/s], or None where unknown.
        position_covariance_W: (N, 3, 3) [m^2], or None where unknown.
        valid: (N,) bool, False where the pose must not be used (glitch, gap); all True by default.

    Raises:
        InputError: lengths differ, time does not increase, a valid value is not finite, or a value
            has the wrong type.
    """

    position_W: FloatArray
    attitude_WB: Rotation
    velocity_W: FloatArray | None = None
    position_covariance_W: FloatArray | None = None
    valid: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))

    @property
    def quat_xyzw(self) -> FloatArray:
        """Attitude as unit quaternions (N, 4), x y z w, body to world."""
        return np.asarray(self.attitude_WB.as_quat(), dtype=np.float64)

    def at(self, time: FloatArray) -> Trajectory:
        """Interpolate at other times: linear in position, slerp in attitude.

        Never interpolates across a gap: times outside the track, or between valid samples more
        than `MAX_TRUTH_GAP` apart, are returned with `valid` False.

        Args:
            time: (M,) [s], strictly increasing.

        Raises:
            InputError: fewer than two valid samples to interpolate between.
        """
        covered = self.covers(time)
        known = np.flatnonzero(self.valid)
        t = self.time[known]
        clipped = np.clip(time, t[0], t[-1])
        velocity = (
            None if self.velocity_W is None else interpolated(clipped, t, self.velocity_W[known])
        )
        covariance = None
        if self.position_covariance_W is not None:
            flat = self.position_covariance_W[known].reshape(len(t), 9)
            covariance = interpolated(clipped, t, flat).reshape(-1, 3, 3)
        return Trajectory(
            time=time,
            position_W=interpolated(clipped, t, self.position_W[known]),
            attitude_WB=slerp(t, self.attitude_WB[known], clipped),
            velocity_W=velocity,
            position_covariance_W=covariance,
            valid=covered,
        )

    def covers(self, time: FloatArray, longest: float = MAX_TRUTH_GAP) -> BoolArray:
        """Return whether the pose is known at each time (M,): `valid` of `at`, but faster.

        Poses more than `longest` [s] apart have a gap between them.

        Raises:
            InputError: as for `at`.
        """
        time = checked_time("time", time)
        t = self.time[self.valid]
        if len(t) < 2:
            raise InputError("trajectory", f"{len(t)} valid samples", "at least 2")
        right = np.clip(np.searchsorted(t, time), 1, len(t) - 1)
        tolerance = max(1e-9, 4.0 * float(np.spacing(np.abs(t[[0, -1]]).max())))
        inside = (time >= t[0] - tolerance) & (time <= t[-1] + tolerance)
        bracketed = ~is_gap(t[right] - t[right - 1], longest)
        exact = np.minimum(np.abs(time - t[right]), np.abs(time - t[right - 1])) <= tolerance
        return np.asarray(inside & (bracketed | exact))

    def slice(self, start: float, stop: float) -> Trajectory:
        """Return the poses with start <= time <= stop [s].

        Raises:
            InputError: there are none.
        """
        return self.select((self.time >= start) & (self.time <= stop))

    def path_length(self, horizontal: bool = True) -> float:
        """Return the length of the path [m] along 1 s chords, so that sensor noise adds nothing.

        Args:
            horizontal: whether over ground, in x and y only.
        """
        known = np.flatnonzero(self.valid)
        if len(known) < 2:
            return 0.0
        t = self.time[known]
        ticks = np.append(whole_seconds(t), t[-1])
        axes = slice(2 if horizontal else 3)
        chords = np.diff(interpolated(ticks, t, self.position_W[known, axes]), axis=0)
        return float(np.linalg.norm(chords, axis=1).sum())


@dataclass(frozen=True, eq=False, repr=False)
class ImuSequence:
    """Recording of an inertial measurement unit, in body axes B.

    Samples are kept as they were recorded. NaN, repeated and out-of-order samples are allowed here,
    because the navigator drops them and counts them in its health report.

    Attributes:
        name: name of the recording in tables and file names.
        time: (N,) [s].
        gyro: (N, 3) angular rate of B relative to the inertial frame, in B [rad/s].
        accel: (N, 3) specific force in B [m/s^2]; at rest about 9.81, pointing up.
        truth: ground truth (the true trajectory), or None.
        converted: which of "gyro" and "accel" the reader has converted from a unit named in the
            file, and "sign" if it has turned Apple's, so that they are not converted again.
        magnetometer: magnetic field measured alongside the IMU, or None.
        positions: known positions if there are no poses (`truth`): a track or waypoints, or None.
        attributes: other metadata of the recording (person, device, place, carry, ...).
        device_attitude: attitude estimated by the device's own sensor fusion, or None.
        barometer: pressure of the air measured alongside the IMU, or None.
        satellites: positions reported by a satellite receiver, as measurements, or None.
        source: format or app of the recording, for display.
        axes: the axes x, y, z of all sensors in those of the file, see `with_axes`.
        maybe_apple: whether the accelerometer may have Apple's sign, which nothing in the file
            tells: `check_units` warns of it.
        alone_s: seconds for which a sensor of the file was recorded before the other began or after
            it ended, by its name, if that is a notable part; the reader has left such samples out,
            so that files written of the recording do not tell.

    Raises:
        InputError: the arrays' shapes do not agree, there is no sample, time, gyro or accel holds
            anything but numbers, or another part has the wrong type.
    """

    name: str
    time: FloatArray
    gyro: FloatArray
    accel: FloatArray
    truth: Trajectory | None = None
    converted: frozenset[str] = frozenset()
    magnetometer: Magnetometer | None = None
    positions: PositionTrack | None = None
    attributes: Mapping[str, str | float] = field(default_factory=dict)
    device_attitude: DeviceAttitude | None = None
    barometer: Barometer | None = None
    satellites: Satellites | None = None
    source: str = ""
    axes: str = "x,y,z"
    maybe_apple: bool = False
    alone_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_type("name", self.name, str, 'such as ImuSequence("walk", time, gyro, accel)')
        for name, kind in _PARTS.items():
            remedy = f"create one with {kind.__name__}(...)"
            check_type(name, getattr(self, name), kind, remedy, optional=True)
        time = finite_times("time", self.time)
        vectors = {name: as_float64(name, getattr(self, name)) for name in ("gyro", "accel")}
        for name, value in vectors.items():
            if value.shape != (len(time), 3):
                raise InputError(name, f"shape {value.shape}", f"({len(time)}, 3) as time")
        vars(self).update(vectors, time=time)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return f"ImuSequence({len(self)} samples of {self.summary()})"

    @property
    def duration(self) -> float:
        """Time between first and last sample [s], without those ahead of the ones after them."""
        time = self.time[np.isfinite(self.time)]
        return float(np.ptp(time[~ahead_mask(time, increasing_mask(time))])) if len(time) else 0.0

    @property
    def rate(self) -> float:
        """Median sampling rate [Hz]; 0 for a single sample."""
        steps = np.diff(self.time)
        steps = steps[np.isfinite(steps) & (steps > 0)]
        return float(1.0 / np.median(steps)) if len(steps) else 0.0

    def summary(self) -> str:
        """Return a description of the recording in one line."""
        field, own = self.magnetometer, self.device_attitude
        parts = [self.source] if self.source else []
        parts.append(f"{self.duration:.1f} s at {self.rate:.1f} Hz")
        parts.append("no magnetometer" if field is None else f"magnetometer at {field.rate:.0f} Hz")
        parts += [] if own is None else ["the device's own attitude"]
        parts += [] if self.barometer is None else [f"pressure at {self.barometer.rate:.0f} Hz"]
        parts += [] if self.satellites is None else [f"{len(self.satellites)} satellite positions"]
        return f"{self.name}: {', '.join(parts)}, truth: {self.truth_summary()}"

    def truth_summary(self) -> str:
        """Return a description of the ground truth in a few words."""
        if self.truth is not None:
            return f"{int(self.truth.valid.sum())} poses"
        if self.positions is None:
            return "none"
        words = f"{int(self.positions.valid.sum())} {self.positions.kind}"
        if sigma := self.positions.typical_sigma:
            words += f" (sigma {sigma:.2g} m per axis)"
        waypoints = self.positions.kind == "waypoints"
        return f"{words}, no poses" if waypoints else f"{words} without attitude, no poses"

    def without_truth(self) -> ImuSequence:
        """Return the recording without its ground truth."""
        return replace(self, truth=None, positions=None)

    def slice(self, start: float, stop: float) -> ImuSequence:
        """Return the samples with start <= time <= stop [s], and all other data within them.

        Raises:
            InputError: there are none.
        """
        inside = (self.time >= start) & (self.time <= stop)
        if not inside.any():
            found, has = f"{start:g} to {stop:g} s", f"{self.time[0]:g} to {self.time[-1]:g} s"
            raise InputError("slice", found, f"times within the recording's, {has}")
        parts = {name: getattr(self, name) for name in _PARTS}
        # Unlike `Trajectory.slice`, that of `Timed` returns None if nothing is left.
        rest: dict[str, Any] = {
            name: Timed.slice(part, start, stop) for name, part in parts.items() if part is not None
        }
        return replace(self.select(inside), **rest)

    def select(self, keep: BoolArray | NDArray[np.intp]) -> ImuSequence:
        """Return the recording with samples `keep` only: (N,) bool, or indices in their order."""
        return replace(self, time=self.time[keep], gyro=self.gyro[keep], accel=self.accel[keep])


_PARTS: dict[str, type[Timed]] = {
    "truth": Trajectory,
    "magnetometer": Magnetometer,
    "positions": PositionTrack,
    "device_attitude": DeviceAttitude,
    "barometer": Barometer,
    "satellites": Satellites,
}


def is_gap(steps: FloatArray, longest: float = MAX_TRUTH_GAP) -> BoolArray:
    """Return whether steps (N,) between neighbours exceed `longest` [s], allowing for rounding."""
    return np.asarray(steps > longest + _ROUNDING_S)


def low_rate_message(truth: Trajectory) -> str:
    """Return a message if the ground truth's median step counts as a gap, else an empty text."""
    step = float(np.median(np.diff(truth.time[truth.valid]))) if truth.valid.sum() > 1 else 0.0
    if not is_gap(np.array(step)):
        return ""
    return f"the truth is at {1.0 / step:.3g} Hz; at least {1.0 / MAX_TRUTH_GAP:.0f} Hz are needed"


def whole_seconds(time: FloatArray) -> FloatArray:
    """Return each second (M,) [s] from the first of increasing times (N,) to before the last.

    Seconds within a gap are skipped: the path there is straight, and a clock that jumps by decades
    must not cost memory.
    """
    seconds = np.floor(time - time[0])
    ticks = time[0] + np.union1d(seconds, seconds + 1.0)
    return np.asarray(ticks[ticks < time[-1]])
