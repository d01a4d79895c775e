"""Report on the positions: a line, plain values and problems of their fit; jumps."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.conventions import axes_matrix, axes_named, permuted
from stario.sequences.legs import jumps
from stario.sequences.sequence import ImuSequence
from stario.sequences.truth.findings import TruthProblem
from stario.sequences.truth.positions import PositionFit

_UNITS = {"mm": 1000.0, "cm": 100.0, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048, "km": 0.001}
_SAME_UNIT = 1.2
"""Factor within which a scale counts as that of a unit."""

_SCALED = 2.0
"""Factor of the positions' scale, or its inverse, above which it is reported. In 153 recordings it
lies between 0.65 and 1.3."""

_DISAGREEING = 0.3
"""Correlation, after any turn and mirroring, below which positions and accelerometer did not
measure the same motion; recordings have at least 0.5, all but seven of 153 above 0.85."""

_TURNED_RAD, _NEAR_RAD = math.radians(30.0), math.radians(20.0)
"""Turn of the positions that is reported (recordings reach 11 degrees), and largest one from axes
that are named."""


def positions_as_dict(fit: PositionFit) -> dict[str, object]:
    """Return the comparison as plain values, with units in their names."""
    return {
        "correlation": fit.correlation,
        "correlation_turned": fit.turned_correlation,
        "scale": fit.scale,
        "turned_rad": fit.turned,
        "mirrored": fit.mirrored,
        "axes": ["xyz"[axis] for axis in fit.axes],
    }


def position_line(fit: PositionFit | None) -> str:
    """Return the comparison as a line to print."""
    if fit is None:
        why = "too little motion, or a wrong attitude"
        return f"  against the accelerometer: positions not compared ({why})"
    mirrored = " and mirrored" if fit.mirrored else ""
    axes = ", ".join("xyz"[axis] for axis in fit.axes)
    return (
        f"  against the accelerometer: positions scaled by {fit.scale:.3g}, "
        f"turned by {math.degrees(fit.turned):.0f} deg{mirrored}, "
        f"correlation {fit.correlation:.3f} in {axes}"
    )


def position_problems(fit: PositionFit) -> list[TruthProblem]:
    """Return the problems found by comparing positions and accelerometer."""
    if fit.turned_correlation < _DISAGREEING:
        return [
            TruthProblem(
                "positions that do not move as the accelerometer measures (correlation "
                f"{fit.turned_correlation:.2f})",
                "are they of another recording, clock or device?",
            )
        ]
    problems = []
    if not 1.0 / _SCALED < fit.scale < _SCALED:
        problems.append(_scale_problem(fit.scale))
    if fit.mirrored or fit.turned > _TURNED_RAD:
        problems.append(_axes_problem(fit))
    return problems


def _scale_problem(scale: float) -> TruthProblem:
    for unit, per_metre in _UNITS.items():
        if 1.0 / _SAME_UNIT < scale / per_metre < _SAME_UNIT:
            return TruthProblem(
                f"positions that seem to be in {unit}",
                f"divide them by {per_metre:.4g} in the file",
            )
    return TruthProblem(
        f"positions that move {scale:.3g} times as far as the accelerometer measures",
        "convert them to metres in the file",
    )


def _axes_problem(fit: PositionFit) -> TruthProblem:
    kind = "mirrored" if fit.mirrored else f"turned by {math.degrees(fit.turned):.0f} degrees"
    found = f"positions {kind} relative to the world of the attitudes"
    sign = -1.0 if fit.mirrored else 1.0
    nearest = sign * axes_matrix(axes_named(sign * fit.Q_PW))
    if Rotation.from_matrix(nearest.T @ fit.Q_PW).magnitude() > _NEAR_RAD:
        return TruthProblem(found, "give both in the same world, with z up")
    columns = permuted(nearest.T, ("px", "py", "pz"))
    return TruthProblem(found, f"write {columns} as px,py,pz in the file")


def position_time_problems(sequence: ImuSequence) -> list[str]:
    """Describe positions known without attitude at other times than the samples'."""
    track, time = sequence.positions, sequence.time[np.isfinite(sequence.time)]
    if track is None or not len(time) or not track.valid.any():
        return []
    known, start, stop = track.time[track.valid], float(time.min()), float(time.max())
    if ((known >= start) & (known <= stop)).sum() >= min(2, len(known)):
        return []
    return [
        f"{sequence.name}: positions: found times from {known[0]:.6g} to {known[-1]:.6g} s, "
        f"expected some during the samples, {start:.6g} to {stop:.6g} s; use one clock for both"
    ]


def jump_problems(sequence: ImuSequence) -> list[str]:
    """Describe jumps of positions known without attitude, as of satellites next to buildings."""
    found = () if sequence.positions is None else jumps(sequence.positions)
    if not len(found):
        return []
    return [
        f"{sequence.name}: positions: found jumps of up to {max(found):.0f} m, "
        "expected a path at walking speed; satellite positions are poor indoors"
    ]
