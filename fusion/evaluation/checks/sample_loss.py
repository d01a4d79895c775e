"""Shift of a track's end if samples are missing: results must not depend on a few samples.

A recording is run unmodified, with a short gap at each of several instants, and with samples
dropped at random; all tracks begin in the same pose, so their ends are compared without alignment.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.corruption import drops, gap
from stario.fusion.evaluation.scores import Column, parts, quantile, scored, table
from stario.fusion.imu.stateful import Predictor
from stario.fusion.lie import yaw_twist
from stario.fusion.navigator import Navigator
from stario.fusion.state import Track
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


_COLUMNS = (
    Column("ends", "metres", ".0f", len),
    Column(f"within {MAX_SHIFT:.0%} and {MAX_TURN:g} deg", "within", ".0%", np.mean),
    Column("of the path: median", "metres", ".2%"),
    Column("p95", "metres", ".2%", quantile(0.95)),
    Column("worst", "metres", ".2%", np.max),
    Column("deg: median", "degrees"),
    Column("p95", "degrees", over=quantile(0.95)),
    Column("worst", "degrees", over=np.max),
)


def end_shifts(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    group: str,
) -> pd.DataFrame:
    """Score a track for each of the faults: the shift of its end.

    `metres` is the horizontal distance between the ends over the length of the track, `degrees`
    the absolute difference of their yaws.

    Raises:
        InputError: the recording cannot be run, or its track is shorter than a metre.
    """
    navigator = Navigator(model, config, backend="ekf")
    unmodified = navigator.run(sequence)
    steps = np.diff(unmodified.trajectory.position_W[:, :2], axis=0)
    path = float(np.linalg.norm(steps, axis=1).sum())
    if path < _MIN_PATH:
        raise InputError(f"{sequence.name}: track", f"{path:.2f} m", "at least a metre")
    instants = (np.arange(INSTANTS) + 0.5) / INSTANTS * sequence.duration
    faults = [(f"gap at {instant:.0f} s", gap(float(instant), GAP_SECONDS)) for instant in instants]
    faults.append((f"{DROPPED:.0%} dropped", drops(DROPPED)))
    figures = {}
    for name, modify_samples in faults:
        faulty = navigator.run(modify_samples(sequence, np.random.default_rng(0)))
        metres, degrees = _end_shift(unmodified, faulty, path)
        within = float(metres <= MAX_SHIFT and degrees <= MAX_TURN)
        figures[name] = {"metres": metres, "degrees": degrees, "within": within}
    return scored(sequence.name, figures, group)


def _end_shift(unmodified: Track, other: Track, path: float) -> tuple[float, float]:
    a, b = unmodified.trajectory, other.trajectory
    metres = float(np.linalg.norm(a.position_W[-1, :2] - b.position_W[-1, :2])) / path
    turn = (b.attitude_WB[-1] * a.attitude_WB[-1].inv()).as_matrix()
    return metres, abs(math.degrees(yaw_twist(turn)))


def end_shift_table(scores: pd.DataFrame) -> str:
    """Return a row for each group: share of the ends within limits, and how far ends move."""
    return table(parts(scores), _COLUMNS)
