"""Consistency of a track with fixes: its error compared with its reported uncertainty.

Fixes are the true positions at equal intervals with white errors. Only the second half of each
track counts: by then several fixes have determined the direction.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from stario.fusion.backends import BackendName
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.fusion_gain import SIGMA_BOUND
from stario.fusion.evaluation.scores import Column, median_degrees, parts, scored, table
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.fixes import Fix, position_fix
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.sequences.accuracy.metrics import pose_errors
from stario.sequences.accuracy.nees import nees
from stario.sequences.arrays import even_grid
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, Trajectory

_MIN_FIXES = 4
"""Minimum number of fixes for a track to be evaluated."""


_NOTE = "second half of each track; expected: NEES of position 2.4 (median), of yaw 1 (mean)"


def true_fixes(truth: Trajectory, every: float, sigma: float, seed: int) -> list[Fix]:
    """Return a true position every `every` seconds, with errors of `sigma` [m] per axis."""
    at = truth.at(even_grid(truth.time[0], truth.time[-1], every))
    positions = at.position_W + np.random.default_rng(seed).normal(0.0, sigma, (len(at), 3))
    covariance = sigma**2 * np.eye(3)
    return [
        position_fix(float(time), position, covariance)
        for time, position in zip(at.time[at.valid], positions[at.valid], strict=True)
    ]


def track_with_fixes(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    group: str,
    every: float = 5.0,
    sigma: float = 0.3,
    backend: BackendName = "ekf",
) -> pd.DataFrame:
    """Score the second half of a recording's track with fixes.

    Figures: share of the fixes that were `applied`; horizontal `position_rms` [m] and median
    `position_nees`; `yaw_rms` [rad], mean `yaw_nees`, and the share of poses whose yaw error is
    within three standard deviations (`yaw_covered`).

    Raises:
        InputError: it has no true poses, is too short for enough fixes, or cannot be run.
    """
    truth = true_poses(sequence)
    known = true_fixes(truth, every, sigma, seed=0)
    fixes = [fix for fix in known if fix.time >= sequence.time[0]]  # truth may begin earlier
    if len(fixes) < _MIN_FIXES:
        raise InputError(f"{sequence.name}: fixes", str(len(fixes)), f"{_MIN_FIXES} or more")
    track = Navigator(model, config, backend=backend).run(sequence, fixes=fixes)
    assert track.covariance is not None  # both back ends give it
    assert track.health is not None
    errors = pose_errors(track.trajectory, truth)
    middle = 0.5 * (truth.time[0] + truth.time[-1])
    second_half = errors.estimate.time > middle
    rows = np.searchsorted(track.time, errors.estimate.time[second_half])
    P, error, yaw = track.covariance[rows], errors.position_W[second_half], errors.yaw[second_half]
    figures = {
        "applied": track.health.fixes.get("applied", 0) / len(fixes),
        "position_rms": math.sqrt((error[:, :2] ** 2).sum(axis=1).mean()),
        "position_nees": float(np.median(nees(error, P[:, 6:9, 6:9]))),
        "yaw_rms": math.sqrt((yaw**2).mean()),
        "yaw_nees": float((yaw**2 / P[:, 2, 2]).mean()),
        "yaw_covered": float((np.abs(yaw) < SIGMA_BOUND * np.sqrt(P[:, 2, 2])).mean()),
    }
    return scored(sequence.name, {backend: figures}, group)


_COLUMNS = (
    Column("n", "applied", ".0f", len),
    Column("fixes applied", "applied", ".0%", np.mean),
    Column("position m", "position_rms"),
    Column("NEES", "position_nees", ".1f"),
    Column("yaw deg", "yaw_rms", ".1f", median_degrees),
    Column("yaw NEES", "yaw_nees", ".1f"),
    Column("< 3 sigma", "yaw_covered", ".1%", np.mean),
)


def fixes_table(scores: pd.DataFrame) -> str:
    """Return a row for each group: medians over recordings, and share of yaw errors in 3 sigma."""
    return table(parts(scores), _COLUMNS, notes=[_NOTE])
