"""Results of a navigator: states, poses, tracks and innovations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.values.health import Health
from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import BoolArray, FloatArray, Trajectory

T = TypeVar("T")


def changed(state: T, **attributes: Any) -> T:
    """Return a copy of a frozen dataclass with some attributes replaced, the others shared.

    Like `dataclasses.replace` in a quarter of its time, as the filter makes dozens per interval:
    attributes are neither looked up nor checked again, so it is only for states without
    `__post_init__`.
    """
    new = object.__new__(type(state))
    vars(new).update(vars(state))
    vars(new).update(attributes)
    return new


def _pose_text(pose: NavState | SmoothedPose | ContinuousPose) -> str:
    """Return a pose's `repr`: time and position, in one line."""
    p_W = np.array2string(pose.p_W, precision=3, suppress_small=True)
    return f"{type(pose).__name__}(time={pose.time:.3f} s, p_W={p_W} m)"


@dataclass(frozen=True, eq=False, repr=False)
class NavState:
    """Estimated state at one time.

    Attributes:
        time: [s].
        R_WB: (3, 3) attitude, body to world.
        v_W: (3,) velocity [m/s].
        p_W: (3,) position [m]; zero at the start unless a prior or a fix places the track.
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        covariance: (15, 15) of rotation about W's axes [rad], velocity, position, b_g, b_a; each
            error is true minus estimate. The properties below give its blocks.
        in_gap: whether the interval that ends here is a gap without samples.
        map_frame: number of frame transforms so far (`filter.map_frame`); states with different
            numbers must not be compared.
    """

    time: float
    R_WB: FloatArray
    v_W: FloatArray
    p_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    covariance: FloatArray
    in_gap: bool = False
    map_frame: int = 0
    __repr__ = _pose_text

    @property
    def quat_xyzw(self) -> FloatArray:
        """Attitude as a unit quaternion (4,), xyzw."""
        return np.asarray(Rotation.from_matrix(self.R_WB).as_quat())

    @property
    def attitude_WB(self) -> Rotation:
        """Attitude, body to world."""
        return Rotation.from_matrix(self.R_WB)

    @property
    def attitude_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the rotation about W's axes [rad^2]."""
        return self.covariance[0:3, 0:3]

    @property
    def velocity_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the velocity [m^2/s^2]."""
        return self.covariance[3:6, 3:6]

    @property
    def position_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the position [m^2]."""
        return self.covariance[6:9, 6:9]

    @property
    def gyro_bias_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the gyroscope bias [rad^2/s^2]."""
        return self.covariance[9:12, 9:12]

    @property
    def accel_bias_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the accelerometer bias [m^2/s^4]."""
        return self.covariance[12:15, 12:15]

    def shifted(self, by: FloatArray) -> NavState:
        """Express the state in a frame whose origin lies at -`by` (3,) [m]."""
        return changed(self, p_W=self.p_W + by)


@dataclass(frozen=True, eq=False, repr=False)
class SmoothedPose:
    """A pose estimated one window later, using the measurements made since.

    Attributes:
        time: of the pose [s].
        R_WB: (3, 3) attitude, body to world.
        p_W: (3,) position [m].
        covariance: (6, 6) of rotation about W's axes [rad] and position [m].
        map_frame: as in `NavState`.
    """

    time: float
    R_WB: FloatArray
    p_W: FloatArray
    covariance: FloatArray
    map_frame: int = 0
    __repr__ = _pose_text


MAX_STEP = 0.01
"""Largest part of the correction bled in from one state to the next [m]."""

BLEED_SECONDS = 1.0
"""Time constant for bleeding in a small correction [s]."""


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousPose:
    """A pose whose position does not step at updates.

    Attributes:
        time: [s].
        p_W: (3,) position [m].
        R_WB: (3, 3) attitude, that of the corrected state.
        v_W: (3,) velocity of the corrected state [m/s].
        correction_W: (3,) corrected minus continuous position, not yet bled in [m].
        map_frame: as in `NavState`; the position is reset when fixes move the frame.
    """

    time: float
    p_W: FloatArray
    R_WB: FloatArray
    v_W: FloatArray
    correction_W: FloatArray
    map_frame: int = 0
    __repr__ = _pose_text


def advanced(before: ContinuousPose | None, state: NavState) -> ContinuousPose:
    """Advance the pose to a state: by the mean velocity and a bounded part of the correction.

    It starts at the corrected position, and is reset to it when the frame moves and after a gap,
    in which the motion is unknown.

    Args:
        before: pose at the previous state, None at first.
        state: the newest state.
    """
    p_W = state.p_W
    if before is not None and before.map_frame == state.map_frame and not state.in_gap:
        dt = state.time - before.time
        integrated = before.p_W + 0.5 * dt * (before.v_W + state.v_W)
        error = state.p_W - integrated
        part = -math.expm1(-dt / BLEED_SECONDS) * error
        p_W = integrated + part * min(1.0, MAX_STEP / max(float(np.linalg.norm(part)), 1e-12))
    correction_W = state.p_W - p_W
    return ContinuousPose(state.time, p_W, state.R_WB, state.v_W, correction_W, state.map_frame)


def copied(pose: ContinuousPose) -> ContinuousPose:
    """Return a copy whose arrays the caller may write to."""
    arrays = {k: v.copy() for k, v in vars(pose).items() if isinstance(v, np.ndarray)}
    return changed(pose, **arrays)


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations (measured minus predicted displacement) of all updates.

    Attributes:
        time: (M,) end of the window [s].
        residual_W: (M, 3) innovation [m].
        sigma: (M, 3) predicted standard deviations [m].
        nis: (M,) normalised innovation squared, before any inflation.
        gated: (M,) whether the covariance was inflated.
    """

    time: FloatArray
    residual_W: FloatArray
    sigma: FloatArray
    nis: FloatArray
    gated: BoolArray


@dataclass(frozen=True, eq=False, repr=False)
class Track:
    """An estimated track.

    Attributes:
        trajectory: poses, velocities and position covariances at the output times.
        b_g: (N, 3) gyroscope bias [rad/s], None if not estimated.
        b_a: (N, 3) accelerometer bias [m/s^2], None if not estimated.
        covariance: (N, 15, 15) as in `NavState`, None if not estimated.
        innovations: innovations of the network's measurements, None without a filter.
        health: report of the run, None without a filter.
        filtered: the filter's track, in which each state uses only the measurements until then, as
            a stream's does; None if this is it, or there is no filter.
        georeference: place of the track's frame on the earth, None if unknown.
        seconds_network: computing time of the network [s].
        seconds_filter: computing time of everything else [s].
    """

    trajectory: Trajectory
    b_g: FloatArray | None = None
    b_a: FloatArray | None = None
    covariance: FloatArray | None = None
    innovations: Innovations | None = None
    health: Health | None = None
    filtered: Track | None = None
    georeference: Georeference | None = None
    seconds_network: float = 0.0
    seconds_filter: float = 0.0

    @classmethod
    def from_states(cls, states: Sequence[NavState]) -> Track:
        """Return the track of a stream's states, as `push` returned them, to be drawn or written.

        Raises:
            InputError: there is none, one is something else, or they are in several map frames.
        """
        listed = list(states)
        for state in listed:
            check_type("states", state, NavState, "collect what push returns, but None")
        frames = {state.map_frame for state in listed}
        if len(frames) != 1:
            found = f"those of {len(frames)} map frames" if frames else "none"
            fix = "keep those with the last `map_frame`" if frames else ""
            raise InputError("states", found, "states in one frame", fix)
        return track_from_states(listed)

    def __repr__(self) -> str:
        nis = "" if self.nis is None else f", mean NIS {self.nis:.2f}"
        return f"Track({self.trajectory!r}{nis})"

    @property
    def time(self) -> FloatArray:
        """Times (N,) [s]."""
        return self.trajectory.time

    @property
    def nis(self) -> float | None:
        """Mean NIS, None without a filter."""
        return None if self.health is None else self.health.mean_nis

    def arrays(self) -> dict[str, Any]:
        """Return all arrays by name, for an npz file."""
        arrays = {
            "time": self.time,
            "position_W": self.trajectory.position_W,
            "quat_xyzw_WB": self.trajectory.quat_xyzw,
            "velocity_W": self.trajectory.velocity_W,
            "valid": self.trajectory.valid,
            "gyro_bias_B": self.b_g,
            "accel_bias_B": self.b_a,
            "covariance": self.covariance,
        }
        return {name: value for name, value in arrays.items() if value is not None}


def track_from_states(states: Sequence[NavState]) -> Track:
    """Stack states into a track; the first state after a gap is marked invalid."""
    covariance = np.array([s.covariance for s in states])
    trajectory = Trajectory(
        time=np.array([s.time for s in states]),
        position_W=np.array([s.p_W for s in states]),
        attitude_WB=Rotation.from_matrix(np.array([s.R_WB for s in states])),
        velocity_W=np.array([s.v_W for s in states]),
        position_covariance_W=covariance[:, 6:9, 6:9],
        valid=np.array([not s.in_gap for s in states]),
    )
    return Track(
        trajectory=trajectory,
        b_g=np.array([s.b_g for s in states]),
        b_a=np.array([s.b_a for s in states]),
        covariance=covariance,
    )
