"""Report on how ground truth fits its IMU: printed lines, plain values and problems to fix."""

from __future__ import annotations

import math
from dataclasses import dataclass

from stario.sequences.truth.fit import EDGE_S, MAX_OFFSET_S, TruthFit
from stario.sequences.truth.yaw_drift import YawDrift

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


@dataclass(frozen=True)
class TruthProblem:
    """A problem of the ground truth.

    Attributes:
        found: what was found, without the recording's name.
        fix: what can be done about it; empty if nothing specific.
        unusable: whether a network must not be trained on this truth.
    """

    found: str
    fix: str = ""
    unusable: bool = True

    def line(self, name: str) -> str:
        """Return the problem in one line, for the recording of this name."""
        return f"{name}: truth: {self.found}" + (f": {self.fix}" if self.fix else "")


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


def scale_problem(name: str, fit: TruthFit, yaw: YawDrift | None) -> list[str]:
    """Return a line if the gyroscope's scale is wrong, where the truth can show it."""
    same_frames = fit.misalignment < _TURNED_RAD and fit.tilt < _LEANING_RAD  # else yaws differ
    if yaw is None or abs(yaw.scale) <= _SCALED or not (fit.consistent and same_frames):
        return []
    if yaw.residual_rms > _EXPLAINED_RAD and abs(yaw.scale) < _UNMISTAKABLE:
        return []
    return [f"{name}: gyroscope: {_scale_words(yaw)}, compared with the truth"]


def fit_problems(fit: TruthFit, known: str) -> list[TruthProblem]:
    """Return problems found by comparing truth and gyroscope, except those in the text `known`."""
    if not fit.consistent:
        return [_inconsistent(fit)]
    problems = []
    if abs(fit.time_offset) > _LATE_S:
        problems.append(
            TruthProblem(
                "a clock that is off",
                f"add {fit.time_offset:+.3f} s to its times in the file",
                unusable=abs(fit.time_offset) > _FAR_OFF_S,
            )
        )
    if fit.misalignment > _TURNED_RAD and fit.accel_against > _LOST:
        problems.append(
            TruthProblem(
                f"an attitude that agrees with the accelerometer but not with the gyroscope "
                f"({math.degrees(fit.misalignment):.0f} degrees off)",
                "the gyroscope: its axes or signs are not those of the accelerometer",
            )
        )
        return problems
    problems += _axes_problems(fit, known)
    if fit.tilt > _LEANING_RAD and not known:
        tilt = math.degrees(fit.tilt)
        problems.append(TruthProblem(f"a world tilted by {tilt:.1f} degrees", unusable=False))
    if fit.jumps:
        times = "once" if fit.jumps == 1 else f"{fit.jumps} times"
        problems.append(
            TruthProblem(
                f"an attitude that jumps {times}, unlike the gyroscope's",
                "split the recording there, or leave the truth's cells blank",
            )
        )
    return problems


def _inconsistent(fit: TruthFit) -> TruthProblem:
    if abs(fit.time_offset) > MAX_OFFSET_S - EDGE_S and fit.agrees:
        return TruthProblem(
            f"a clock that is off by {MAX_OFFSET_S:.0f} s or more",
            f"add {fit.time_offset:+.2f} s to its times in the file and inspect it again",
        )
    return TruthProblem(
        f"an attitude that disagrees with the gyroscope (correlation {fit.correlation:.2f}, "
        f"{fit.agreeing:.0%} of the poses agree)",
        f"are the clocks more than {MAX_OFFSET_S:.0f} s apart, is the truth of another recording, "
        "or has the gyroscope a wrong axis or sign?",
    )


def _axes_problems(fit: TruthFit, known: str) -> list[TruthProblem]:
    remedy, degrees = fit.axes_remedy(), math.degrees(fit.misalignment)
    if remedy and remedy not in known:
        return [TruthProblem(f"axes {degrees:.0f} degrees off the IMU's", remedy)]
    if not remedy and fit.misalignment > _TURNED_RAD:
        return [
            TruthProblem(
                f"axes {degrees:.1f} degrees off the IMU's, which no option fixes",
                "rotate its attitude in the file",
                unusable=fit.misalignment > _FAR_TURNED_RAD,
            )
        ]
    return []
