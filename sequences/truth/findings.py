"""Report on how ground truth fits its IMU: printed lines, plain values and problems to fix."""

from __future__ import annotations

import math

from stario.sequences.truth.fit import MAX_OFFSET_S, TruthFit
from stario.sequences.truth.yaw_drift import YawDrift

_LATE_S = 0.02
_TURNED_RAD = math.radians(5.0)
_LEANING_RAD = math.radians(3.0)
"""Offset, misalignment and tilt above which the truth is reported as a problem."""

_LOST = 0.02
"""Largest share of gravity that a mount may remove; it leans by 11 degrees then."""

_SCALED = 0.06
"""Gyroscope scale error above which it is reported; recorded phones reach at most 0.03."""


def fit_as_dict(fit: TruthFit, yaw: YawDrift | None) -> dict[str, object]:
    """Return the fit as plain values, with units in their names."""
    return {
        "time_offset_s": fit.time_offset,
        "correlation": fit.correlation,
        "misalignment_rad": fit.misalignment,
        "misalignment_rotvec_rad": fit.R_TB.as_rotvec(),
        "world_tilt_rad": fit.tilt,
        "agreeing": fit.agreeing,
        "jumps": fit.jumps,
        "axes": fit.axes(),
        "yaw": yaw and {"scale": yaw.scale, "bias_rad_s": yaw.bias, "left_rad": yaw.residual_rms},
    }


def fit_lines(fit: TruthFit, yaw: YawDrift | None) -> list[str]:
    """Return the fit as lines to print."""
    lines = [
        f"  against the gyroscope: time offset {1e3 * fit.time_offset:+.1f} ms, "
        f"misalignment {math.degrees(fit.misalignment):.2f} deg, "
        f"correlation {fit.correlation:.3f}, "
        f"world tilted by {math.degrees(fit.tilt):.2f} deg"
    ]
    if yaw is not None:
        lines.append(
            f"  yaw: the gyroscope {_scale_words(yaw)} and drifts by "
            f"{math.degrees(yaw.bias):+.3f} deg/s; "
            f"residual {math.degrees(yaw.residual_rms):.1f} deg"
        )
    return lines


def _scale_words(yaw: YawDrift) -> str:
    return f"reads {100 * abs(yaw.scale):.1f} % too {'high' if yaw.scale > 0.0 else 'low'}"


def fit_problems(name: str, fit: TruthFit, yaw: YawDrift | None, known: str) -> list[str]:
    """Return problems found by comparing truth and gyroscope, except those in the text `known`."""
    field = f"{name}: truth"
    if not fit.consistent:
        return [
            f"{field}: its attitude and the gyroscope disagree (correlation {fit.correlation:.2f}, "
            f"{fit.agreeing:.0%} of the poses agree): clocks more than {MAX_OFFSET_S:.0f} s apart, "
            "truth of another recording, or a wrong axis or sign of the gyroscope"
        ]
    problems = []
    same_frames = fit.misalignment < _TURNED_RAD and fit.tilt < _LEANING_RAD  # else yaws differ
    if yaw is not None and abs(yaw.scale) > _SCALED and same_frames:
        problems.append(f"{name}: gyroscope: {_scale_words(yaw)}, compared with the truth")
    if abs(fit.time_offset) > _LATE_S:
        problems.append(
            f"{field}: its clock is off: add {fit.time_offset:+.3f} s to its times in the file"
        )
    axes, degrees = fit.axes(), math.degrees(fit.misalignment)
    if fit.misalignment > _TURNED_RAD and fit.accel_against > _LOST:
        problems.append(
            f"{name}: gyroscope: its axes or signs are not those of the accelerometer, which agree "
            f"with the truth ({degrees:.0f} degrees off)"
        )
        return problems
    if axes is not None and f"--axes={axes}" not in known:
        problems.append(
            f"{field}: its axes are {degrees:.0f} degrees off the IMU's: pass `--axes={axes}`"
        )
    elif axes is None and fit.misalignment > _TURNED_RAD:
        problems.append(
            f"{field}: its axes are {degrees:.1f} degrees off the IMU's, which no option fixes: "
            "rotate its attitude in the file"
        )
    if fit.tilt > _LEANING_RAD and not known:
        problems.append(f"{field}: its world is tilted by {math.degrees(fit.tilt):.1f} degrees")
    if fit.jumps:
        problems.append(f"{field}: its attitude jumps {fit.jumps} times, unlike the gyroscope's")
    return problems
