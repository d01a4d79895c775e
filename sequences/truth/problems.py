"""Problems of a recording's ground truth: against the IMU, and by itself.

`examine_truth` compares everything, for an inspection. `truth_findings` and `check_truth` serve
commands that use the truth, and cost little where it is right: acceleration from positions can only
agree with the accelerometer, rotated by the true attitude, if attitude, clocks and positions are
all right, so the slower fit to the gyroscope is needed only where they disagree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stario.sequences.arrays import check_type, scatter
from stario.sequences.clean_samples import usable
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding, warn
from stario.sequences.sequence import ImuSequence, Trajectory, low_rate_message
from stario.sequences.truth.findings import fit_findings, position_fit_findings, truth_finding
from stario.sequences.truth.fit import TruthFit, fit_truth
from stario.sequences.truth.mounts import MIN_FIT_S
from stario.sequences.truth.positions import PositionFit, fit_positions
from stario.sequences.truth.tracking import tracking_faults, tracking_findings, without_lost

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
        findings: what stands out.
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
    faults = tracking_faults(sequence)
    found = tracking_findings(faults)
    truth = without_lost(sequence.truth, faults)
    if _rests(sequence, truth):  # there is no rotation to compare
        return TruthFindings(truth, findings=tuple(found))
    tracked = replace(sequence, truth=truth)
    try:
        fit = fit_truth(tracked)
    except InputError as error:
        if _compared_s(tracked, truth) > 2.0 * MIN_FIT_S and not refusal:
            text = f"an attitude that cannot be compared with the gyroscope ({error})"
            found.append(truth_finding("uncompared", text))
        return TruthFindings(findings=tuple(found))
    found += fit_findings(fit, refusal)
    positions = None
    near = fit.consistent and not fit.jumps and fit.misalignment < _NEAR_AXES_RAD
    if near or fit.one_axis:  # whose clock and axes are unknown: as they are
        positions = fit_positions(tracked, 0.0 if fit.one_axis else fit.time_offset)
        same = positions and (not fit.one_axis or positions.correlation > _AGREEING)
        if positions and same and not refusal:  # the accelerometer's unit would explain all
            found += position_fit_findings(positions)
    return TruthFindings(truth, fit, positions, tuple(found))


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
    faults = tracking_faults(sequence)
    if not faults.lost.any():
        positions = fit_positions(sequence, 0.0)
        if positions is not None and positions.correlation > _AGREEING:
            return [*tracking_findings(faults), *position_fit_findings(positions)]
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
        return [truth_finding("poses", text, fix, count=count)]
    if slow := low_rate_message(truth):
        return [truth_finding("rate", slow, spoils=False)]
    if _compared_s(sequence, truth) > 0.0:
        return []
    known, time = truth.time[truth.valid], sequence.time
    text = (
        f"poses from {known[0]:.6g} to {known[-1]:.6g} s, none of them at a sample's time "
        f"({np.nanmin(time):.6g} to {np.nanmax(time):.6g} s)"
    )
    return [
        truth_finding(
            "clock", text, "use one clock for both, or shift the truth's times in the file"
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
