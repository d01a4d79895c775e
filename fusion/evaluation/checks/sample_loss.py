"""Shift of a track's end if samples are missing: results must not depend on a few samples.

A recording is run unmodified, with a short gap at each of several instants, and with samples
dropped at random; all tracks begin in the same pose, so their ends are compared without alignment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.corruption import drops, gap
from stario.fusion.evaluation.checks.groups import GroupedResult, by_group
from stario.fusion.imu.stateful import Predictor
from stario.fusion.lie import yaw_twist
from stario.fusion.navigator import Navigator
from stario.fusion.state import Track
from stario.sequences.drawing.text_table import aligned
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

GAP_SECONDS, DROPPED = 0.1, 0.05
"""Length of a gap [s], and the share of samples that is dropped."""

INSTANTS = 6
"""Number of instants at which a gap is placed, in a run each."""

MAX_SHIFT, MAX_TURN = 0.01, 3.0
"""Maximum acceptable shift of the end: in metres per metre of the path, and in yaw."""

_MIN_PATH = 1.0
"""Minimum path [m]: shifts are relative to the path."""


@dataclass(frozen=True)
class EndShift(GroupedResult):
    """Shift of a track's end caused by missing samples.

    Attributes:
        fault: what was missing.
        metres: horizontal distance between the ends, divided by the length of the track.
        degrees: absolute difference of their yaws [deg].
    """

    fault: str
    metres: float
    degrees: float


def end_shifts(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    group: str,
) -> list[EndShift]:
    """Run a recording with each of the faults and return the shifts of its end.

    Raises:
        InputError: the recording cannot be run, or its track is shorter than a metre.
    """
    navigator = Navigator(model, config)
    unmodified = navigator.run(sequence)
    steps = np.diff(unmodified.trajectory.position_W[:, :2], axis=0)
    path = float(np.linalg.norm(steps, axis=1).sum())
    if path < _MIN_PATH:
        raise InputError(f"{sequence.name}: track", f"{path:.2f} m", "at least a metre")
    instants = (np.arange(INSTANTS) + 0.5) / INSTANTS * sequence.duration
    faults = [(f"gap at {instant:.0f} s", gap(float(instant), GAP_SECONDS)) for instant in instants]
    faults.append((f"{DROPPED:.0%} dropped", drops(DROPPED)))
    found = []
    for name, modify_samples in faults:
        faulty = navigator.run(modify_samples(sequence, np.random.default_rng(0)))
        found.append(EndShift(sequence.name, group, name, *_end_shift(unmodified, faulty, path)))
    return found


def _end_shift(unmodified: Track, other: Track, path: float) -> tuple[float, float]:
    a, b = unmodified.trajectory, other.trajectory
    metres = float(np.linalg.norm(a.position_W[-1, :2] - b.position_W[-1, :2])) / path
    turn = (b.attitude_WB[-1] * a.attitude_WB[-1].inv()).as_matrix()
    return metres, abs(math.degrees(yaw_twist(turn)))


def end_shift_table(found: Sequence[EndShift]) -> str:
    """Return a row for each group: share of the ends within limits, and how far ends move."""
    head = ["group", "ends", f"within {MAX_SHIFT:.0%} and {MAX_TURN:g} deg"]
    rows = [[*head, "% of the path: median", "p95", "worst", "deg: median", "p95", "worst"]]
    for group, part in by_group(found):
        metres = np.array([shift.metres for shift in part])
        degrees = np.array([shift.degrees for shift in part])
        within = ((metres <= MAX_SHIFT) & (degrees <= MAX_TURN)).mean()
        figures = [
            f"{value:.2f}"
            for values in (100.0 * metres, degrees)
            for value in np.quantile(values, (0.5, 0.95, 1.0))
        ]
        rows.append([group, str(len(part)), f"{within:.0%}", *figures])
    return "\n".join(aligned(rows))
