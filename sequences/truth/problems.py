"""Problems of a recording's ground truth: against the IMU, and by itself.

`examine_truth` compares everything, for an inspection. `truth_problems` and `check_truth` serve
commands that use the truth, and cost little where it is right: acceleration from positions can only
agree with the accelerometer, rotated by the true attitude, if attitude, clocks and positions are
all right, so the slower fit to the gyroscope is needed only where they disagree.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stario.sequences.arrays import check_type, scatter
from stario.sequences.clean_samples import usable
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, Trajectory, low_rate_message
from stario.sequences.truth.findings import TruthProblem, fit_problems
from stario.sequences.truth.fit import TruthFit, fit_truth
from stario.sequences.truth.mounts import MIN_FIT_S
from stario.sequences.truth.position_findings import position_problems
from stario.sequences.truth.positions import PositionFit, fit_positions
from stario.sequences.truth.tracking import tracking_faults, tracking_problems, without_lost

_log = logging.getLogger(__name__)

_AGREEING = 0.85
"""Correlation of the accelerations that needs no further check: most recorded truths have more."""

_NEAR_AXES_RAD = np.deg2rad(20.0)
"""Misalignment above which gravity, rotated by the true attitude, hides the acceleration."""


_RESTING_RAD_S, _RESTING_RAD = 0.03, np.deg2rad(3.0)
"""Scatter of the gyroscope, and largest turn of the true attitude, of a device at rest: a phone's
noise, and a capture's."""


@dataclass(frozen=True, eq=False)
class TruthFindings:
    """Result of `examine_truth`.

    Attributes:
        truth: the poses compared, without those of lost tracking; None if nothing was compared.
        fit: fit of truth and gyroscope; None if they cannot be compared.
        positions: comparison of positions and accelerometer; None if they cannot be compared, or
            if the attitude is wrong.
        problems: problems found.
    """

    truth: Trajectory | None = None
    fit: TruthFit | None = None
    positions: PositionFit | None = None
    problems: tuple[TruthProblem, ...] = ()


def examine_truth(sequence: ImuSequence, known: str = "") -> TruthFindings:
    """Compare a recording's true poses with its gyroscope and accelerometer.

    Args:
        sequence: the recording.
        known: problems of the recording reported already, which are not repeated.
    """
    if sequence.truth is None:
        return TruthFindings()
    if problems := _unusable_times(sequence, sequence.truth):
        return TruthFindings(problems=tuple(problems))
    faults = tracking_faults(sequence)
    problems = tracking_problems(faults)
    truth = without_lost(sequence.truth, faults)
    if _rests(sequence, truth):  # there is no rotation to compare
        return TruthFindings(truth, problems=tuple(problems))
    tracked = replace(sequence, truth=truth)
    try:
        fit = fit_truth(tracked)
    except InputError as error:
        # What is known already, such as wrong units, would explain it.
        if _compared_s(tracked, truth) > 2.0 * MIN_FIT_S and not known:
            problems.append(
                TruthProblem(f"an attitude that cannot be compared with the gyroscope ({error})")
            )
        return TruthFindings(problems=tuple(problems))
    problems += fit_problems(fit, known)
    positions = None
    if fit.consistent and not fit.jumps and fit.misalignment < _NEAR_AXES_RAD:
        positions = fit_positions(tracked, fit.time_offset)
        if positions and "accelerometer: found" not in known:  # its unit or sign would explain all
            problems += position_problems(positions)
    return TruthFindings(truth, fit, positions, tuple(problems))


def truth_problems(sequence: ImuSequence) -> list[TruthProblem]:
    """Return the problems of a recording's true poses; empty without any.

    Where positions and accelerometer agree well, the gyroscope is not compared: an offset of the
    clocks of a few hundredths of a second then goes unnoticed, unlike in `examine_truth`.

    Raises:
        InputError: the argument has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    if sequence.truth is None:
        return []
    if problems := _unusable_times(sequence, sequence.truth):
        return problems
    faults = tracking_faults(sequence)
    if not faults.lost.any():
        positions = fit_positions(sequence, 0.0)
        if positions is not None and positions.correlation > _AGREEING:
            return [*tracking_problems(faults), *position_problems(positions)]
    return list(examine_truth(sequence).problems)


def warn_of_truth(sequence: ImuSequence) -> None:
    """Log a warning for each problem of the true poses, which errors of tracks are relative to."""
    warn_of_problems([problem.line(sequence.name) for problem in truth_problems(sequence)])


def warn_of_problems(lines: Sequence[str]) -> None:
    """Log a warning for each problem of true poses, given as `TruthProblem.line`."""
    for line in lines:
        _log.warning("errors are unreliable: %s", line)


def check_truth(sequence: ImuSequence) -> None:
    """Check that a recording's true poses can be trained on.

    Raises:
        InputError: they contradict the IMU, or a tracking fault makes them absurd.
    """
    for problem in truth_problems(sequence):
        if problem.unusable:
            raise InputError(
                f"{sequence.name}: truth", problem.found, "poses that agree with the IMU",
                problem.fix,
            )  # fmt: skip


def _unusable_times(sequence: ImuSequence, truth: Trajectory) -> list[TruthProblem]:
    """Return a problem if the true poses are too few, or at other times than the samples."""
    count = int(truth.valid.sum())
    if count < 2:
        found = f"only {count} usable pose{'s' * (count != 1)}"
        return [
            TruthProblem(found, "do its times increase, and are its quaternions of unit length?")
        ]
    if slow := low_rate_message(truth):
        return [TruthProblem(slow, unusable=False)]
    if _compared_s(sequence, truth) > 0.0:
        return []
    known, time = truth.time[truth.valid], sequence.time
    return [
        TruthProblem(
            f"poses from {known[0]:.6g} to {known[-1]:.6g} s, none of them at a sample's time "
            f"({np.nanmin(time):.6g} to {np.nanmax(time):.6g} s)",
            "use one clock for both, or shift the truth's times in the file",
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
