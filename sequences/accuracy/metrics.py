"""Errors of a track against the ground truth: ATE, RTE, PDE, AYE and NEES, each defined once.

Every error compares a pose of the estimate with the truth interpolated to its time, never across a
gap of the truth. `CONVENTIONS` defines each number in words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from stario.sequences.arrays import check_choice, check_type
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, Trajectory, low_rate_message

Alignment = Literal["none", "first", "yaw"]
Convention = Literal["rms", "ronin", "mean"]

CONVENTIONS: dict[str, str] = {
    "ate_m": "absolute trajectory error [m]: root mean square of the position error's norm",
    "rte_m": "relative trajectory error [m]: root mean square of the norm of the displacement "
    "error over 60 s, in world axes; for tracks shorter than that, the end-to-end displacement "
    "error scaled by 60 s / duration",
    "pde": "position drift error [1]: final position error / length of the true path",
    "aye_rad": "absolute yaw error [rad]: root mean square of the wrapped yaw error, which is the "
    "twist about the vertical of R_estimate R_truth^T",
    "nees": "normalised estimation error squared of the position [1]: error^T covariance^-1 error, "
    "3-D; its expectation is 3",
    "nis": "normalised innovation squared [1]: innovation^T S^-1 innovation; its expectation is "
    "the number of components",
    "coverage": "share [1] of the estimate's poses at times when the truth is known; the truth is "
    "interpolated linearly, never across its gaps",
    "path_m": "length of the true path [m] along 1 s chords, within the times compared",
    "duration_s": "time [s] between the first and the last pose compared",
    "alignment": "prior alignment of the estimate: none; first (yaw and position of the first "
    "common pose); yaw (least squares in yaw and position; at rest, yaw of the attitudes); tilt "
    "is never changed",
    "horizontal": "true: position errors and path in x and y only; false: in x, y and z",
    "convention": "rms as defined above; ronin also averages the squares over coordinates, as in "
    "RoNIN's code, so ATE and RTE are smaller by sqrt(2) in 2-D and sqrt(3) in 3-D; mean averages "
    "norms, not squares, as in TLIO's code; PDE and AYE are the same in all",
}


@dataclass(frozen=True)
class TrackMetrics:
    """Errors of one track, see `CONVENTIONS`; lengths in m, angles in rad, times in s.

    `rte_m` is NaN if gaps leave no pair of poses `rte_interval_s` apart, `pde` if the true path has
    no length. `rte_scaled` is True if the track was shorter than the interval.
    """

    ate_m: float
    rte_m: float
    pde: float
    aye_rad: float
    coverage: float
    path_m: float
    duration_s: float
    alignment: Alignment
    horizontal: bool
    convention: Convention
    rte_interval_s: float
    rte_scaled: bool


_PLACE_M = 0.05
"""A track that stays within this distance of its centre [m] is that of a device at rest."""


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Estimate minus truth at the M poses of the estimate where both are known.

    Attributes:
        estimate: the M poses of the estimate.
        truth: the truth at their times.
        position_W: (M, 3) [m].
        yaw: (M,) wrapped [rad].
        coverage: M / number of valid poses of the estimate.
    """

    estimate: Trajectory
    truth: Trajectory
    position_W: FloatArray
    yaw: FloatArray
    coverage: float


def pose_errors(estimate: Trajectory, truth: Trajectory) -> PoseErrors:
    """Compare two tracks without alignment, at the estimate's times.

    Raises:
        InputError: there is no time at which both are known.
    """
    at_estimate = truth.at(estimate.time)
    common = estimate.valid & at_estimate.valid
    if not common.any():
        raise InputError(
            "estimate",
            f"no overlap: {_span(estimate)} against truth {_span(truth)}",
            "a pose at a time when the truth is known",
            low_rate_message(truth),
        )
    estimated, true = estimate.select(common), at_estimate.select(common)
    return PoseErrors(
        estimate=estimated,
        truth=true,
        position_W=estimated.position_W - true.position_W,
        yaw=yaw_of(estimated.attitude_WB * true.attitude_WB.inv()),
        coverage=float(common.sum() / estimate.valid.sum()),
    )


def align(estimate: Trajectory, truth: Trajectory, mode: Alignment) -> Trajectory:
    """Rotate an estimate about the vertical and shift it onto the truth; tilt is unchanged.

    Position, attitude, velocity and covariance are rotated together.

    Args:
        estimate: the track to move.
        truth: the track to align it with.
        mode: "none"; "first", by yaw and position of the first common pose; "yaw", by the yaw and
            position of least squared position error (Horn 1987, restricted to the vertical axis).
            The positions of a stationary device give no yaw; there it comes from the attitudes.

    Raises:
        InputError: unknown mode, no overlap, or an argument has the wrong type.
    """
    check_type("estimate", estimate, Trajectory, "pass track.trajectory")
    check_type("truth", truth, Trajectory, "pass recording.truth, if it has poses")
    check_choice("alignment", mode, get_args(Alignment))
    if mode == "none":
        return estimate
    errors = pose_errors(estimate, truth)
    estimated, true = errors.estimate.position_W, errors.truth.position_W
    if mode == "first":
        return moved(estimate, -float(errors.yaw[0]), estimated[0], true[0])
    center, target = estimated.mean(axis=0), true.mean(axis=0)
    z, w = ((p - middle)[:, :2] @ [1.0, 1j] for p, middle in ((estimated, center), (true, target)))
    if min(np.abs(z).max(), np.abs(w).max()) < _PLACE_M:
        yaw = -np.angle(np.exp(1j * errors.yaw).mean())
    else:
        yaw = np.angle(np.vdot(z, w))
    return moved(estimate, float(yaw), center, target)


def evaluate_track(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    alignment: Alignment = "first",
    horizontal: bool = True,
    convention: Convention = "rms",
    rte_interval: float = 60.0,
) -> TrackMetrics:
    """Evaluate a track against the ground truth; `CONVENTIONS` defines the errors.

    Args:
        estimate: the track.
        truth: the true track; it may be sampled more coarsely and have gaps.
        alignment: see `align`.
        horizontal: whether to compare positions in x and y only.
        convention: how position errors are averaged.
        rte_interval: span of the relative error [s].

    Raises:
        InputError: no overlap, an unknown choice, an interval that is not positive, or an argument
            has the wrong type.
    """
    check_choice("convention", convention, get_args(Convention))
    if not (np.isfinite(rte_interval) and rte_interval > 0):
        raise InputError("rte_interval", repr(rte_interval), "seconds > 0")
    errors = pose_errors(align(estimate, truth, alignment), truth)
    time = errors.estimate.time
    error = errors.position_W[:, : 2 if horizontal else 3]
    path = errors.truth.path_length(horizontal)
    rte, scaled = _relative_error(time, error, rte_interval, convention)
    return TrackMetrics(
        ate_m=_average(error, convention),
        rte_m=rte,
        pde=float(np.linalg.norm(error[-1]) / path) if path > 0 else float("nan"),
        aye_rad=float(np.sqrt(np.mean(errors.yaw**2))),
        coverage=errors.coverage,
        path_m=path,
        duration_s=float(time[-1] - time[0]),
        alignment=alignment,
        horizontal=horizontal,
        convention=convention,
        rte_interval_s=rte_interval,
        rte_scaled=scaled,
    )


def _relative_error(
    time: FloatArray, error: FloatArray, interval: float, convention: Convention
) -> tuple[float, bool]:
    """Return the average displacement error over `interval` [m], and whether it had to be scaled.

    The displacement error between two poses is the difference of their position errors.
    """
    duration = time[-1] - time[0]
    # A partner may be half a step of the estimate off, but no more than 1 % of the interval.
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    tolerance = min(0.5 * step + 1e-6, 0.01 * interval)
    if duration < interval - tolerance:
        drift = (error[-1:] - error[:1]) * (interval / duration if duration > 0 else np.nan)
        return _average(drift, convention), True
    end = _nearest(time, time + interval)
    paired = np.abs(time[end] - time - interval) <= tolerance
    if not paired.any():
        return float("nan"), False
    return _average(error[end[paired]] - error[paired], convention), False


def _average(error: FloatArray, convention: Convention) -> float:
    square = np.sum(error**2, axis=1)
    if convention == "mean":
        return float(np.mean(np.sqrt(square)))
    coordinates = error.shape[1] if convention == "ronin" else 1
    return float(np.sqrt(np.mean(square) / coordinates))


def _nearest(time: FloatArray, wanted: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    right = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
    return right - (wanted - time[right - 1] < time[right] - wanted)


def moved(
    trajectory: Trajectory, yaw: float, pivot_W: FloatArray, target_W: FloatArray
) -> Trajectory:
    """Rotate by `yaw` [rad] about the vertical through `pivot_W`, then move that to `target_W`."""
    turn = about_z(yaw)
    R = turn.as_matrix()
    velocity, covariance = trajectory.velocity_W, trajectory.position_covariance_W
    return replace(
        trajectory,
        position_W=(trajectory.position_W - pivot_W) @ R.T + target_W,
        attitude_WB=turn * trajectory.attitude_WB,
        velocity_W=None if velocity is None else velocity @ R.T,
        position_covariance_W=None if covariance is None else R @ covariance @ R.T,
    )


def _span(trajectory: Trajectory) -> str:
    time = trajectory.time[trajectory.valid]
    return f"{time[0]:.3f} to {time[-1]:.3f} s" if len(time) else "no valid pose"
