"""Problems of a recording's ground truth: against the IMU, and by itself.

`examine_truth` compares everything, for an inspection. `truth_findings` and `check_truth` serve
commands that use the truth, and cost little where it is right: acceleration from positions can only
agree with the accelerometer, rotated by the true attitude, if attitude, clocks and positions are
all right, so the slower fit to the gyroscope is needed only where they disagree.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from stario.sequences.arrays import check_type, rms, runs, scatter
from stario.sequences.attitude.mounts import MIN_FIT_S
from stario.sequences.clean_samples import usable
from stario.sequences.errors import InputError
from stario.sequences.findings import Assessment, Finding, warn
from stario.sequences.sequence import (
    FloatArray,
    ImuSequence,
    Trajectory,
    is_gap,
    low_rate_message,
)
from stario.sequences.truth.findings import (
    assessed_fit,
    assessed_positions,
    fit_findings,
    known_position_findings,
    position_fit_findings,
    truth_finding,
)
from stario.sequences.truth.fit import TruthFit, fit_truth, yaw_drift
from stario.sequences.truth.positions import PositionFit, fit_positions

_AGREEING = 0.85
"""Correlation of the accelerations that needs no further check: most recorded truths have more."""

_NEAR_AXES_RAD = np.deg2rad(20.0)
"""Misalignment above which gravity, rotated by the true attitude, hides the acceleration."""


_RESTING_RAD_S, _RESTING_RAD = 0.03, np.deg2rad(3.0)
"""Scatter of the gyroscope, and largest turn of the true attitude, of a device at rest: a phone's
noise, and a capture's."""


class TruthFindings(NamedTuple):
    """Poses compared, without those of lost tracking; both comparisons; what stands out.

    Each is None if there is nothing to compare, and that of the positions if the attitude is wrong.
    """

    truth: Trajectory | None = None
    fit: TruthFit | None = None
    positions: PositionFit | None = None
    findings: tuple[Finding, ...] = ()


def examine_truth(sequence: ImuSequence, refusal: str = "") -> TruthFindings:
    """Compare a recording's true poses with its gyroscope and accelerometer.

    Args:
        sequence: the recording.
        refusal: remedy for units or signs for which it is refused: what that explains is not told.
    """
    if sequence.truth is None:
        return TruthFindings()
    if unusable := _unusable_times(sequence, sequence.truth):
        return TruthFindings(findings=tuple(unusable))
    truth, found = tracked_truth(sequence)
    if _rests(sequence, truth):  # there is no rotation to compare
        return TruthFindings(truth, findings=tuple(found))
    tracked = replace(sequence, truth=truth)
    try:
        fit = fit_truth(tracked)
    except InputError as error:
        if _compared_s(tracked, truth) > 2.0 * MIN_FIT_S and not refusal:
            text = f"an attitude that cannot be compared with the gyroscope ({error})"
            found.append(truth_finding("uncompared", text))
        return TruthFindings(findings=tuple(found))
    found += fit_findings(fit, refusal)
    positions = None
    near = fit.consistent and not fit.jumps and fit.misalignment < _NEAR_AXES_RAD
    if near or fit.one_axis:  # whose clock and axes are unknown: as they are
        positions = fit_positions(tracked, 0.0 if fit.one_axis else fit.time_offset)
        same = positions and (not fit.one_axis or positions.correlation > _AGREEING)
        if positions and same and not refusal:  # the accelerometer's unit would explain all
            found += position_fit_findings(positions)
    return TruthFindings(truth, fit, positions, tuple(found))


def assess_truth(sequence: ImuSequence, refusal: str) -> tuple[Assessment, TruthFit | None]:
    """Assess a recording's true poses or known positions; arguments as `examine_truth`.

    Returns:
        The assessment, and the fit of truth and gyroscope; None if they cannot be compared.
    """
    found = examine_truth(sequence, refusal)
    findings, fit = [*found.findings], found.fit
    lines = [f"truth: {sequence.truth_summary()}"]
    coverage = against_gyro = against_accel = None
    if sequence.truth is not None:
        coverage = _coverage(sequence, sequence.truth)
        lines = [
            f"truth: covers {100 * coverage['coverage']:.1f} % of the samples, "
            f"{coverage['rate_hz']:.1f} Hz, {coverage['gaps']} gaps "
            f"(longest step {coverage['longest_gap_s']:.2f} s), path of {coverage['path_m']:.1f} m"
        ]
    if fit:
        yaw = None if fit.one_axis else yaw_drift(replace(sequence, truth=found.truth), fit)
        gyro, accel = assessed_fit(fit, yaw), assessed_positions(found.positions)
        against_gyro, against_accel = gyro.figures, accel.figures or None
        lines += gyro.lines + accel.lines
        findings += gyro.findings
    figures = {
        "truth": coverage,
        "truth_against_gyroscope": against_gyro,
        "positions_against_accelerometer": against_accel,
    }
    return Assessment(figures, lines, findings + known_position_findings(sequence)), fit


def _coverage(sequence: ImuSequence, truth: Trajectory) -> dict[str, Any]:
    """Return for how many samples the truth is known, its rate, its gaps and its path."""
    times = np.unique(sequence.time[np.isfinite(sequence.time)])
    known = truth.time[truth.valid]
    steps = np.diff(known)
    return {
        "coverage": float(truth.covers(times).mean()) if len(known) > 1 else 0.0,
        "rate_hz": float(1.0 / np.median(steps)) if len(steps) else 0.0,
        "gaps": int(is_gap(steps).sum()),
        "longest_gap_s": float(steps.max(initial=0.0)),
        "path_m": truth.path_length(),
    }


def truth_findings(sequence: ImuSequence) -> list[Finding]:
    """Return what is wrong with a recording's true poses; empty without any.

    Where positions and accelerometer agree well, the gyroscope is not compared: an offset of the
    clocks of a few hundredths of a second, or axes a few degrees off, are left to an inspection.

    Raises:
        InputError: the argument has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    if sequence.truth is None:
        return []
    if unusable := _unusable_times(sequence, sequence.truth):
        return unusable
    truth, found = tracked_truth(sequence)
    if truth is sequence.truth:
        positions = fit_positions(sequence, 0.0)
        if positions is not None and positions.correlation > _AGREEING:
            return [*found, *position_fit_findings(positions)]
    return list(examine_truth(sequence).findings)


def warn_of_truth(sequence: ImuSequence) -> None:
    """Log a warning for each problem of the true poses, which errors of tracks are relative to."""
    warn(sequence.name, truth_findings(sequence))


def check_truth(sequence: ImuSequence) -> None:
    """Check that a recording's true poses can be trained on.

    Raises:
        InputError: they contradict the IMU, or a tracking fault makes them absurd.
    """
    for found in truth_findings(sequence):
        if found.spoils_truth:
            raise InputError(
                f"{sequence.name}: truth", found.text.removeprefix("truth: "),
                "poses that agree with the IMU", found.advice,
            )  # fmt: skip


def _unusable_times(sequence: ImuSequence, truth: Trajectory) -> list[Finding]:
    """Return a finding if the true poses are too few, or at other times than the samples."""
    count = int(truth.valid.sum())
    if count < 2:
        text = f"only {count} usable pose{'s' * (count != 1)}"
        fix = "do its times increase, and are its quaternions of unit length?"
        return [truth_finding("poses", text, fix, count=count)]
    if slow := low_rate_message(truth):
        return [truth_finding("rate", slow, spoils=False)]
    if _compared_s(sequence, truth) > 0.0:
        return []
    known, time = truth.time[truth.valid], sequence.time
    text = (
        f"poses from {known[0]:.6g} to {known[-1]:.6g} s, none of them at a sample's time "
        f"({np.nanmin(time):.6g} to {np.nanmax(time):.6g} s)"
    )
    return [
        truth_finding(
            "clock", text, "use one clock for both, or shift the truth's times in the file"
        )
    ]


def _rests(sequence: ImuSequence, truth: Trajectory) -> bool:
    """Return whether neither the gyroscope nor the true attitude shows any rotation."""
    known, gyro = truth.attitude_WB[truth.valid], sequence.gyro[usable(sequence)]
    if not (len(known) and len(gyro)):
        return False
    turned = float((known[0].inv() * known).magnitude().max())
    return scatter(gyro) < _RESTING_RAD_S and turned < _RESTING_RAD


def _compared_s(sequence: ImuSequence, truth: Trajectory) -> float:
    """Return how long the true pose is known during the recording [s]."""
    times = np.unique(sequence.time[np.isfinite(sequence.time)])
    if len(times) < 2 or truth.valid.sum() < 2:
        return 0.0
    return float(truth.covers(times).mean() * (times[-1] - times[0]))


_JUMP_M, _FASTEST_M_S = 0.5, 15.0
"""Length [m] and speed [m/s] above which a step between successive poses may be a jump."""

_NEIGHBOURS, _FASTER = 21, 5.0
"""Number of steps whose median speed a jump exceeds by this factor: a vehicle's steps do not."""

_FROZEN_S = 2.0
"""Time [s] for which no tracked position repeats exactly while the device moves."""

_MOVING_RAD_S, _MOVING_M_S2 = 0.2, 0.5
"""Root mean square of the rate, and scatter of the force, above which a device moves."""


def tracked_truth(sequence: ImuSequence) -> tuple[Trajectory, list[Finding]]:
    """Return the true poses without those of lost tracking, and a finding for each kind of fault.

    Poses are lost that repeat exactly, position and attitude, while the device moves: they would be
    compared as rest. The truth itself is returned if there are none.
    """
    truth = sequence.truth
    assert truth is not None
    known = np.flatnonzero(truth.valid)
    time, position = truth.time[known], truth.position_W[known]
    same = (np.diff(position, axis=0) == 0.0).all(axis=1)
    frozen = [
        (first, last)
        for first, last in runs(same)
        if time[last] - time[first] >= _FROZEN_S and _moves(sequence, time[first], time[last])
    ]
    quat = truth.quat_xyzw[known]
    lost = np.zeros(len(truth), dtype=np.bool_)
    for first, last in frozen:
        lost[known[first : last + 1]] = (quat[first : last + 1] == quat[first]).all(axis=1)
    truth = replace(truth, valid=truth.valid & ~lost) if lost.any() else truth
    stretches = [(float(time[first]), float(time[last])) for first, last in frozen]
    # The steps into and out of a frozen stretch are part of that fault.
    jumps = _jumps(truth.time[truth.valid], truth.position_W[truth.valid])
    return truth, [*_frozen_findings(stretches), *_jump_findings(jumps)]


def _frozen_findings(frozen: list[tuple[float, float]]) -> list[Finding]:
    if not frozen:
        return []
    start, stop = max(frozen, key=lambda stretch: stretch[1] - stretch[0])
    seconds = sum(stop - start for start, stop in frozen)
    text = (
        f"a position that repeats exactly for {seconds:.1f} s while the device moves, "
        f"longest from {start:.1f} to {stop:.1f} s"
    )
    fix = "leave the truth's cells blank where its tracking is lost"
    return [truth_finding("frozen", text, fix, seconds=seconds, start_s=start)]


def _jump_findings(jumps: list[tuple[float, float]]) -> list[Finding]:
    if not jumps:
        return []
    at, length = max(jumps, key=lambda jump: jump[1])
    count = len(jumps)
    others = f", the longest of {count} jumps" if count > 1 else ""
    text = f"a position that jumps by {length:.3g} m at {at:.2f} s{others}"
    fix = "leave the truth's cells blank around a glitch, or split the recording there"
    return [truth_finding("jumps", text, fix, count=count, longest_m=length)]


def _jumps(time: FloatArray, position: FloatArray) -> list[tuple[float, float]]:
    """Return time [s] and length [m] of each jump of the positions (N, 3)."""
    if len(time) < _NEIGHBOURS:
        return []
    steps, lengths = np.diff(time), np.linalg.norm(np.diff(position, axis=0), axis=1)
    speeds = lengths / steps
    usual = median_filter(speeds, _NEIGHBOURS, mode="nearest")
    jump = (lengths > _JUMP_M) & (speeds > _FASTEST_M_S) & (speeds > _FASTER * usual)
    jump &= ~is_gap(steps)
    return [(float(time[k + 1]), float(lengths[k])) for k in np.flatnonzero(jump)]


def _moves(sequence: ImuSequence, start: float, stop: float) -> bool:
    inside = (sequence.time >= start) & (sequence.time <= stop)
    values = np.column_stack([sequence.gyro, sequence.accel])[inside]
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        return False
    return rms(values[:, :3]) > _MOVING_RAD_S and scatter(values[:, 3:]) > _MOVING_M_S2
