"""Problems of a recording's ground truth: against the IMU, and by itself.

`examine_truth` compares everything, for an inspection. `truth_findings` and `check_truth` serve
commands that use the truth, and cost little where it is right: acceleration from positions can only
agree with the accelerometer, rotated by the true attitude, if attitude, clocks and positions are
all right, so the slower fit to the gyroscope is needed only where they disagree.

What is compared is in `fit` (attitude against gyroscope) and `positions` (against accelerometer);
here are the limits beyond which it is told, and the words.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import check_type, rms, runs, scatter
from stario.sequences.attitude.mounts import MIN_FIT_S
from stario.sequences.clean_samples import usable
from stario.sequences.conventions import axes_matrix, axes_named, permuted
from stario.sequences.errors import InputError
from stario.sequences.findings import Assessment, Finding, warn
from stario.sequences.legs import jumps
from stario.sequences.sequence import (
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
    is_gap,
    low_rate_message,
)
from stario.sequences.truth.fit import (
    EDGE_S,
    MAX_OFFSET_S,
    TruthFit,
    YawDrift,
    fit_truth,
    yaw_drift,
)
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
            found.append(_truth_finding("uncompared", text))
        return TruthFindings(findings=tuple(found))
    found += fit_findings(fit, refusal)
    positions = None
    near = fit.consistent and not fit.jumps and fit.misalignment < _NEAR_AXES_RAD
    if near or fit.one_axis:  # whose clock and axes are unknown: as they are
        positions = fit_positions(tracked, 0.0 if fit.one_axis else fit.time_offset)
        same = positions and (not fit.one_axis or positions.correlation > _AGREEING)
        if positions and same and not refusal:  # the accelerometer's unit would explain all
            found += _position_fit_findings(positions)
    return TruthFindings(truth, fit, positions, tuple(found))


def assess_truth(sequence: ImuSequence, refusal: str) -> tuple[Assessment, TruthFit | None]:
    """Assess true poses or known positions; arguments and None of the fit as `examine_truth`."""
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
        gyro, accel = _assessed_fit(fit, yaw), _assessed_positions(found.positions)
        against_gyro, against_accel = gyro.figures, accel.figures or None
        lines += gyro.lines + accel.lines
        findings += gyro.findings
    figures = {
        "truth": coverage,
        "truth_against_gyroscope": against_gyro,
        "positions_against_accelerometer": against_accel,
    }
    return Assessment(figures, lines, findings + _jumps_of_positions(sequence.positions)), fit


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
            return [*found, *_position_fit_findings(positions)]
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
        return [_truth_finding("poses", text, fix, count=count)]
    if slow := low_rate_message(truth):
        return [_truth_finding("rate", slow, spoils=False)]
    if _compared_s(sequence, truth) > 0.0:
        return []
    known, time = truth.time[truth.valid], sequence.time
    text = (
        f"poses from {known[0]:.6g} to {known[-1]:.6g} s, none of them at a sample's time "
        f"({np.nanmin(time):.6g} to {np.nanmax(time):.6g} s)"
    )
    fix = "use one clock for both, or shift the truth's times in the file"
    return [_truth_finding("clock", text, fix)]


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
    found = []
    if stretches := [(float(time[first]), float(time[last])) for first, last in frozen]:
        start, stop = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
        seconds = sum(b - a for a, b in stretches)
        text = (
            f"a position that repeats exactly for {seconds:.1f} s while the device moves, "
            f"longest from {start:.1f} to {stop:.1f} s"
        )
        fix = "leave the truth's cells blank where its tracking is lost"
        found.append(_truth_finding("frozen", text, fix, seconds=seconds, start_s=start))
    # The steps into and out of a frozen stretch are part of that fault.
    return truth, found + _jumps(truth.time[truth.valid], truth.position_W[truth.valid])


def _jumps(time: FloatArray, position: FloatArray) -> list[Finding]:
    """Report the longest jump of the positions (N, 3)."""
    if len(time) < _NEIGHBOURS:
        return []
    steps, lengths = np.diff(time), np.linalg.norm(np.diff(position, axis=0), axis=1)
    speeds = lengths / steps
    usual = median_filter(speeds, _NEIGHBOURS, mode="nearest")
    jump = (lengths > _JUMP_M) & (speeds > _FASTEST_M_S) & (speeds > _FASTER * usual)
    jump &= ~is_gap(steps)
    if not jump.any():
        return []
    longest, count = int(np.argmax(np.where(jump, lengths, 0.0))), int(jump.sum())
    at, length = time[longest + 1], float(lengths[longest])
    others = f", the longest of {count} jumps" if count > 1 else ""
    text = f"a position that jumps by {length:.3g} m at {at:.2f} s{others}"
    fix = "leave the truth's cells blank around a glitch, or split the recording there"
    return [_truth_finding("jumps", text, fix, count=count, longest_m=length)]


def _moves(sequence: ImuSequence, start: float, stop: float) -> bool:
    inside = (sequence.time >= start) & (sequence.time <= stop)
    values = np.column_stack([sequence.gyro, sequence.accel])[inside]
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        return False
    return rms(values[:, :3]) > _MOVING_RAD_S and scatter(values[:, 3:]) > _MOVING_M_S2


# --- what is told, and from where on -------------------------------------------------------------

_LATE_S = 0.02
_TURNED_RAD = math.radians(5.0)
_LEANING_RAD = math.radians(3.0)
"""Offset, misalignment and tilt above which the truth is reported as a problem."""

_FAR_OFF_S, _FAR_TURNED_RAD = 0.1, math.radians(20.0)
"""Offset and misalignment above which the truth is not trained on."""

_LOST = 0.02
"""Largest share of gravity that a mount may remove; it leans by 11 degrees then."""

_SCALED = 0.06
"""Gyroscope scale error above which it is reported; recorded phones reach at most 0.03."""

_EXPLAINED_RAD, _UNMISTAKABLE = math.radians(10.0), 0.5
"""Residual yaw above which the drift is that of a truth that jumped, unless the scale error is
larger than a jump or two can feign."""

_UNITS = {"mm": 1000.0, "cm": 100.0, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048, "km": 0.001}
_SAME_UNIT = 1.2
"""Factor within which a scale counts as that of a unit."""

_POSITIONS_SCALED = 2.0
"""Factor of the positions' scale, or its inverse, above which it is reported. In 153 recordings it
lies between 0.65 and 1.3."""

_DISAGREEING = 0.3
"""Correlation, after any turn and mirroring, below which positions and accelerometer did not
measure the same motion; recordings have at least 0.5, all but seven of 153 above 0.85."""

_POSITIONS_TURNED_RAD, _NEAR_RAD = math.radians(30.0), math.radians(20.0)
"""Turn of the positions that is reported (recordings reach 11 degrees), and largest one from axes
that are named."""


def _truth_finding(
    code: str, found: str, fix: str = "", spoils: bool = True, **values: object
) -> Finding:
    """Return a finding about the truth; `spoils` if a network must not be trained on it."""
    return Finding(f"truth_{code}", f"truth: {found}", fix, values=values, spoils_truth=spoils)


def _assessed_fit(fit: TruthFit, yaw: YawDrift | None) -> Assessment:
    """Return the fit and the gyroscope's drift as figures and lines, and a scale that is wrong."""
    figures = {
        "time_offset_s": fit.time_offset,
        "correlation": fit.correlation,
        "misalignment_rad": fit.misalignment,
        "misalignment_rotvec_rad": fit.R_TB.as_rotvec(),
        "world_tilt_rad": fit.tilt,
        "agreeing": fit.agreeing,
        "jumps": fit.jumps,
        "one_axis": fit.one_axis,
        "axes": fit.axes(),
        "yaw": yaw and {"scale": yaw.scale, "bias_rad_s": yaw.bias, "left_rad": yaw.residual_rms},
    }
    if fit.one_axis:
        line = "  against the gyroscope: one axis of rotation determines neither clock nor axes"
        return Assessment(figures, [line], [])
    lines = [
        f"  against the gyroscope: time offset {1e3 * fit.time_offset:+.1f} ms, "
        f"misalignment {math.degrees(fit.misalignment):.2f} deg, "
        f"correlation {fit.correlation:.3f}, "
        f"world tilted by {math.degrees(fit.tilt):.2f} deg"
    ]
    if yaw is None:
        return Assessment(figures, lines, [])
    reads = f"reads {100 * abs(yaw.scale):.1f} % too {'high' if yaw.scale > 0.0 else 'low'}"
    lines.append(
        f"  yaw: the gyroscope {reads} and drifts by {math.degrees(yaw.bias):+.3f} deg/s; "
        f"residual {math.degrees(yaw.residual_rms):.1f} deg"
    )
    same_frames = fit.misalignment < _TURNED_RAD and fit.tilt < _LEANING_RAD  # else yaws differ
    jumped = yaw.residual_rms > _EXPLAINED_RAD and abs(yaw.scale) < _UNMISTAKABLE
    wrong = abs(yaw.scale) > _SCALED and fit.consistent and same_frames and not jumped
    text = f"gyroscope: {reads}, compared with the truth"
    found = [Finding("gyro_scale", text, values={"scale": yaw.scale})] if wrong else []
    return Assessment(figures, lines, found)


def fit_findings(fit: TruthFit, refusal: str) -> list[Finding]:
    """Return what stands out where truth and gyroscope are compared, but a `refusal`'s causes."""
    if fit.one_axis:  # a single axis, as of a robot on wheels, fits any mount about it
        return []
    if not fit.consistent:
        return [_inconsistent(fit)]
    found, degrees = [], math.degrees(fit.misalignment)
    if abs(fit.time_offset) > _LATE_S:
        fix = f"add {fit.time_offset:+.3f} s to its times in the file"
        far = abs(fit.time_offset) > _FAR_OFF_S
        found.append(
            _truth_finding("clock", "a clock that is off", fix, far, offset_s=fit.time_offset)
        )
    if fit.misalignment > _TURNED_RAD and fit.accel_against > _LOST:
        text = (
            "an attitude that agrees with the accelerometer but not with the gyroscope "
            f"({degrees:.0f} degrees off)"
        )
        fix = "the gyroscope: its axes or signs are not those of the accelerometer"
        return [*found, _truth_finding("gyro_axes", text, fix, misalignment_deg=degrees)]
    remedy = fit.axes_remedy()
    if remedy and remedy not in refusal:
        text = f"axes {degrees:.0f} degrees off the IMU's"
        found.append(_truth_finding("axes", text, remedy, misalignment_deg=degrees))
    elif not remedy and fit.misalignment > _TURNED_RAD:
        text = f"axes {degrees:.1f} degrees off the IMU's, which no option fixes"
        far, fix = fit.misalignment > _FAR_TURNED_RAD, "rotate its attitude in the file"
        found.append(_truth_finding("axes", text, fix, far, misalignment_deg=degrees))
    if fit.tilt > _LEANING_RAD and not refusal:
        tilt = math.degrees(fit.tilt)
        text = f"a world tilted by {tilt:.1f} degrees"
        found.append(_truth_finding("tilted", text, spoils=False, tilt_deg=tilt))
    if fit.jumps:
        times = "once" if fit.jumps == 1 else f"{fit.jumps} times"
        text = f"an attitude that jumps {times}, unlike the gyroscope's"
        fix = "split the recording there, or leave the truth's cells blank"
        found.append(_truth_finding("attitude_jumps", text, fix, count=fit.jumps))
    return found


def _inconsistent(fit: TruthFit) -> Finding:
    if abs(fit.time_offset) > MAX_OFFSET_S - EDGE_S and fit.agrees:
        text = f"a clock that is off by {MAX_OFFSET_S:.0f} s or more"
        fix = f"add {fit.time_offset:+.2f} s to its times in the file and inspect it again"
        return _truth_finding("clock", text, fix, offset_s=fit.time_offset)
    return _truth_finding(
        "disagrees",
        f"an attitude that disagrees with the gyroscope (correlation {fit.correlation:.2f}, "
        f"{fit.agreeing:.0%} of the poses agree)",
        f"are the clocks more than {MAX_OFFSET_S:.0f} s apart, is the truth of another recording, "
        "or has the gyroscope a wrong axis or sign?",
        correlation=fit.correlation,
        agreeing=fit.agreeing,
    )


def _assessed_positions(fit: PositionFit | None) -> Assessment:
    """Return the comparison as figures, and as a line that says why there is none."""
    if fit is None:
        why = "too little motion, or a wrong attitude"
        return Assessment({}, [f"  against the accelerometer: positions not compared ({why})"], [])
    axes = ["xyz"[axis] for axis in fit.axes]
    figures = {
        "correlation": fit.correlation,
        "correlation_turned": fit.turned_correlation,
        "scale": fit.scale,
        "turned_rad": fit.turned,
        "mirrored": fit.mirrored,
        "axes": axes,
    }
    line = (
        f"  against the accelerometer: positions scaled by {fit.scale:.3g}, "
        f"turned by {math.degrees(fit.turned):.0f} deg{' and mirrored' if fit.mirrored else ''}, "
        f"correlation {fit.correlation:.3f} in {', '.join(axes)}"
    )
    return Assessment(figures, [line], [])


def _position_fit_findings(fit: PositionFit) -> list[Finding]:
    """Return what stands out where the truth's positions and the accelerometer are compared."""
    if fit.turned_correlation < _DISAGREEING:
        text = (
            "positions that do not move as the accelerometer measures (correlation "
            f"{fit.turned_correlation:.2f})"
        )
        fix = "are they of another recording, clock or device?"
        return [_truth_finding("positions", text, fix, correlation=fit.turned_correlation)]
    found = []
    if not 1.0 / _POSITIONS_SCALED < fit.scale < _POSITIONS_SCALED:
        text = f"positions that move {fit.scale:.3g} times as far as the accelerometer measures"
        fix = "convert them to metres in the file"
        for unit, per_metre in _UNITS.items():
            if 1.0 / _SAME_UNIT < fit.scale / per_metre < _SAME_UNIT:
                text = f"positions that seem to be in {unit}"
                fix = f"divide them by {per_metre:.4g} in the file"
        found.append(_truth_finding("positions_scale", text, fix, scale=fit.scale))
    if fit.mirrored or fit.turned > _POSITIONS_TURNED_RAD:
        kind = "mirrored" if fit.mirrored else f"turned by {math.degrees(fit.turned):.0f} degrees"
        text = f"positions {kind} relative to the world of the attitudes"
        found.append(_truth_finding("positions_axes", text, _axes_fix(fit), mirrored=fit.mirrored))
    return found


def _axes_fix(fit: PositionFit) -> str:
    sign = -1.0 if fit.mirrored else 1.0
    nearest = sign * axes_matrix(axes_named(sign * fit.Q_PW))
    if Rotation.from_matrix(nearest.T @ fit.Q_PW).magnitude() > _NEAR_RAD:
        return "give both in the same world, with z up"
    return f"write {permuted(nearest.T, ('px', 'py', 'pz'))} as px,py,pz in the file"


def _jumps_of_positions(track: PositionTrack | None) -> list[Finding]:
    if track is None or not (lengths := jumps(track).tolist()):
        return []
    text = f"positions: found jumps of up to {max(lengths):.0f} m, expected a path at walking speed"
    fix = "satellite positions are poor indoors"
    return [Finding("positions_jump", text, fix, values={"longest_m": max(lengths)})]
