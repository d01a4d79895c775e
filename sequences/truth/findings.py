"""Findings about ground truth: against gyroscope and accelerometer, and by itself; lines, values.

What is compared is in `fit` (attitude against gyroscope) and `positions` (against accelerometer);
here are the limits beyond which it is told, and the words.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.conventions import axes_matrix, axes_named, permuted
from stario.sequences.findings import Assessment, Finding
from stario.sequences.legs import jumps
from stario.sequences.sequence import ImuSequence
from stario.sequences.truth.fit import EDGE_S, MAX_OFFSET_S, TruthFit, YawDrift
from stario.sequences.truth.positions import PositionFit

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


def truth_finding(
    code: str, found: str, fix: str = "", spoils: bool = True, **values: object
) -> Finding:
    """Return a finding about the truth; `spoils` if a network must not be trained on it."""
    return Finding(f"truth_{code}", f"truth: {found}", fix, values=values, spoils_truth=spoils)


def assessed_fit(fit: TruthFit, yaw: YawDrift | None) -> Assessment:
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
    wrong = abs(yaw.scale) > _SCALED and fit.consistent and same_frames
    if yaw.residual_rms > _EXPLAINED_RAD and abs(yaw.scale) < _UNMISTAKABLE:
        wrong = False
    text = f"gyroscope: {reads}, compared with the truth"
    found = [Finding("gyro_scale", text, values={"scale": yaw.scale})] if wrong else []
    return Assessment(figures, lines, found)


def fit_findings(fit: TruthFit, refusal: str) -> list[Finding]:
    """Return what stands out where truth and gyroscope are compared.

    Args:
        fit: the comparison.
        refusal: remedy for units or signs for which the recording is refused; what it explains is
            not told again.
    """
    if fit.one_axis:  # a single axis, as of a robot on wheels, fits any mount about it
        return []
    if not fit.consistent:
        return [_inconsistent(fit)]
    found, degrees = [], math.degrees(fit.misalignment)
    if abs(fit.time_offset) > _LATE_S:
        fix = f"add {fit.time_offset:+.3f} s to its times in the file"
        far = abs(fit.time_offset) > _FAR_OFF_S
        found.append(
            truth_finding("clock", "a clock that is off", fix, far, offset_s=fit.time_offset)
        )
    if fit.misalignment > _TURNED_RAD and fit.accel_against > _LOST:
        text = (
            "an attitude that agrees with the accelerometer but not with the gyroscope "
            f"({degrees:.0f} degrees off)"
        )
        fix = "the gyroscope: its axes or signs are not those of the accelerometer"
        return [*found, truth_finding("gyro_axes", text, fix, misalignment_deg=degrees)]
    remedy = fit.axes_remedy()
    if remedy and remedy not in refusal:
        text = f"axes {degrees:.0f} degrees off the IMU's"
        found.append(truth_finding("axes", text, remedy, misalignment_deg=degrees))
    elif not remedy and fit.misalignment > _TURNED_RAD:
        text = f"axes {degrees:.1f} degrees off the IMU's, which no option fixes"
        far, fix = fit.misalignment > _FAR_TURNED_RAD, "rotate its attitude in the file"
        found.append(truth_finding("axes", text, fix, far, misalignment_deg=degrees))
    if fit.tilt > _LEANING_RAD and not refusal:
        tilt = math.degrees(fit.tilt)
        text = f"a world tilted by {tilt:.1f} degrees"
        found.append(truth_finding("tilted", text, spoils=False, tilt_deg=tilt))
    if fit.jumps:
        times = "once" if fit.jumps == 1 else f"{fit.jumps} times"
        text = f"an attitude that jumps {times}, unlike the gyroscope's"
        fix = "split the recording there, or leave the truth's cells blank"
        found.append(truth_finding("attitude_jumps", text, fix, count=fit.jumps))
    return found


def _inconsistent(fit: TruthFit) -> Finding:
    if abs(fit.time_offset) > MAX_OFFSET_S - EDGE_S and fit.agrees:
        text = f"a clock that is off by {MAX_OFFSET_S:.0f} s or more"
        fix = f"add {fit.time_offset:+.2f} s to its times in the file and inspect it again"
        return truth_finding("clock", text, fix, offset_s=fit.time_offset)
    return truth_finding(
        "disagrees",
        f"an attitude that disagrees with the gyroscope (correlation {fit.correlation:.2f}, "
        f"{fit.agreeing:.0%} of the poses agree)",
        f"are the clocks more than {MAX_OFFSET_S:.0f} s apart, is the truth of another recording, "
        "or has the gyroscope a wrong axis or sign?",
        correlation=fit.correlation,
        agreeing=fit.agreeing,
    )


def assessed_positions(fit: PositionFit | None) -> Assessment:
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


def position_fit_findings(fit: PositionFit) -> list[Finding]:
    """Return what stands out where the truth's positions and the accelerometer are compared."""
    if fit.turned_correlation < _DISAGREEING:
        text = (
            "positions that do not move as the accelerometer measures (correlation "
            f"{fit.turned_correlation:.2f})"
        )
        fix = "are they of another recording, clock or device?"
        return [truth_finding("positions", text, fix, correlation=fit.turned_correlation)]
    found = []
    if not 1.0 / _POSITIONS_SCALED < fit.scale < _POSITIONS_SCALED:
        text = f"positions that move {fit.scale:.3g} times as far as the accelerometer measures"
        fix = "convert them to metres in the file"
        for unit, per_metre in _UNITS.items():
            if 1.0 / _SAME_UNIT < fit.scale / per_metre < _SAME_UNIT:
                text = f"positions that seem to be in {unit}"
                fix = f"divide them by {per_metre:.4g} in the file"
        found.append(truth_finding("positions_scale", text, fix, scale=fit.scale))
    if fit.mirrored or fit.turned > _POSITIONS_TURNED_RAD:
        kind = "mirrored" if fit.mirrored else f"turned by {math.degrees(fit.turned):.0f} degrees"
        text = f"positions {kind} relative to the world of the attitudes"
        found.append(truth_finding("positions_axes", text, _axes_fix(fit), mirrored=fit.mirrored))
    return found


def _axes_fix(fit: PositionFit) -> str:
    sign = -1.0 if fit.mirrored else 1.0
    nearest = sign * axes_matrix(axes_named(sign * fit.Q_PW))
    if Rotation.from_matrix(nearest.T @ fit.Q_PW).magnitude() > _NEAR_RAD:
        return "give both in the same world, with z up"
    return f"write {permuted(nearest.T, ('px', 'py', 'pz'))} as px,py,pz in the file"


def known_position_findings(sequence: ImuSequence) -> list[Finding]:
    """Report positions known without attitude at other times than the samples', and their jumps."""
    track, time = sequence.positions, sequence.time[np.isfinite(sequence.time)]
    if track is None or not len(time) or not track.valid.any():
        return []
    found = []
    known, start, stop = track.time[track.valid], float(time.min()), float(time.max())
    if ((known >= start) & (known <= stop)).sum() < min(2, len(known)):
        text = (
            f"positions: found times from {known[0]:.6g} to {known[-1]:.6g} s, expected some "
            f"during the samples, {start:.6g} to {stop:.6g} s"
        )
        found.append(Finding("positions_clock", text, "use one clock for both"))
    if len(lengths := jumps(track)):
        longest = float(max(lengths))
        text = f"positions: found jumps of up to {longest:.0f} m, expected a path at walking speed"
        fix = "satellite positions are poor indoors"
        found.append(Finding("positions_jump", text, fix, values={"longest_m": longest}))
    return found
