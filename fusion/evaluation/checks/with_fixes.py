"""Consistency of a track with fixes: its error compared with its reported uncertainty.

Fixes are the true positions at equal intervals with white errors. Only the second half of each
track counts: by then several fixes have determined the direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.backends import BackendName
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.fusion_gain import SIGMA_BOUND
from stario.fusion.evaluation.checks.groups import GroupedResult, by_group
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.fixes import Fix, position_fix
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.sequences.accuracy.metrics import pose_errors
from stario.sequences.accuracy.nees import nees
from stario.sequences.arrays import even_grid
from stario.sequences.drawing.text_table import aligned
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, Trajectory

_MIN_FIXES = 4
"""Minimum number of fixes for a track to be evaluated."""


@dataclass(frozen=True)
class FixConsistency(GroupedResult):
    """Errors of one recording with fixes.

    Attributes:
        applied: share of the fixes that were applied.
        position_rms: horizontal position error, root mean square [m].
        position_nees: median NEES of position; 2.4 is expected for three axes.
        yaw_rms: yaw error, root mean square [rad].
        yaw_nees: mean NEES of yaw; 1 is expected.
        yaw_covered: share of the poses whose yaw error is within three standard deviations.
    """

    applied: float
    position_rms: float
    position_nees: float
    yaw_rms: float
    yaw_nees: float
    yaw_covered: float


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
) -> FixConsistency:
    """Run a recording with fixes and evaluate its track.

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
    return FixConsistency(
        sequence.name,
        group,
        track.health.fixes.get("applied", 0) / len(fixes),
        float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
        float(np.median(nees(error, P[:, 6:9, 6:9]))),
        float(np.sqrt((yaw**2).mean())),
        float((yaw**2 / P[:, 2, 2]).mean()),
        float((np.abs(yaw) < SIGMA_BOUND * np.sqrt(P[:, 2, 2])).mean()),
    )


def fixes_table(found: Sequence[FixConsistency]) -> str:
    """Return a row for each group: medians over recordings, and share of yaw errors in 3 sigma."""
    head = ["group", "n", "fixes applied", "position m", "NEES", "yaw deg", "yaw NEES", "< 3 sigma"]
    rows = [head]
    for group, part in by_group(found):
        rows.append(
            [
                *(group, str(len(part)), f"{np.mean([result.applied for result in part]):.0%}"),
                f"{np.median([result.position_rms for result in part]):.2f}",
                f"{np.median([result.position_nees for result in part]):.1f}",
                f"{np.degrees(np.median([result.yaw_rms for result in part])):.1f}",
                f"{np.median([result.yaw_nees for result in part]):.1f}",
                f"{np.mean([result.yaw_covered for result in part]):.1%}",
            ]
        )
    note = "second half of each track; expected: NEES of position 2.4 (median), of yaw 1 (mean)"
    return "\n".join([*aligned(rows), note])
