"""Benefit of the fusion: the filter's and the graph's error relative to the network's, by group.

The network's displacements are chained along the attitude levelled from the IMU. Errors are
horizontal, root mean square after a fit of yaw and position: over all poses, or at the waypoints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from stario.fusion.backends import BackendName
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.groups import GroupedResult, by_group
from stario.fusion.evaluation.compare import Metrics, measure
from stario.fusion.evaluation.known_positions import MIN_POSITIONS
from stario.fusion.evaluation.tracks import network_track
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.sequences.accuracy.metrics import pose_errors
from stario.sequences.drawing.text_table import aligned
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

SIGMA_BOUND = 3.0
"""Maximum yaw error of a consistent track, in standard deviations."""

GOOD_YAW = math.radians(10.0)
"""Maximum acceptable yaw error at the end [rad]."""


@dataclass(frozen=True)
class FusionGain(GroupedResult):
    """Errors of one recording with and without fusion.

    Attributes:
        network_m: error of the network alone [m].
        fused_m: error by back end [m].
        nis: mean NIS of the first back end; 3 is expected.
        position_nees: median NEES of the first back end's position; 2.4 is expected for three axes,
            NaN without true attitude.
        yaw_error: its yaw error at the end of the truth relative to its start [rad]; NaN without
            true attitude.
        yaw_sigma: reported standard deviation of the yaw there [rad]; NaN likewise.
    """

    network_m: float
    fused_m: dict[str, float]
    nis: float
    position_nees: float
    yaw_error: float
    yaw_sigma: float


def fusion_gain(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    group: str,
    backends: Sequence[BackendName] = get_args(BackendName),
) -> FusionGain:
    """Run a recording through the network alone and the back ends.

    Raises:
        InputError: it has no ground truth or too few known positions, or cannot be run.
    """
    truth = sequence.truth
    if truth is None and sequence.positions is None:
        raise InputError(f"{sequence.name}: truth", "none", "poses, positions or waypoints")
    preprocessed = Navigator(model, config).observe(sequence)
    network_m = _error(measure(network_track(preprocessed), sequence))
    if math.isnan(network_m):
        raise InputError(
            f"{sequence.name}: positions",
            f"fewer than {MIN_POSITIONS} within the track",
            f"{MIN_POSITIONS} or more",
        )
    tracks = {name: Navigator(model, config, backend=name).track(preprocessed) for name in backends}
    figures = {name: measure(track, sequence) for name, track in tracks.items()}
    first = backends[0]
    yaw_error = yaw_sigma = math.nan
    if truth is not None:
        track = tracks[first]
        assert track.covariance is not None  # both back ends give it
        errors = pose_errors(track.trajectory, truth)
        yaw = np.unwrap(errors.yaw)
        # The truth may end before the track, whose sigma grows further.
        last = np.searchsorted(track.time, errors.estimate.time[-1])
        yaw_error, yaw_sigma = float(yaw[-1] - yaw[0]), math.sqrt(track.covariance[last, 2, 2])
    return FusionGain(
        sequence.name,
        group,
        network_m,
        {name: _error(found) for name, found in figures.items()},
        _number(figures[first]["nis_mean"]),
        _number(figures[first]["nees_median"]),
        yaw_error,
        yaw_sigma,
    )


def fusion_gain_table(found: Sequence[FusionGain]) -> str:
    """Return a row for each group: ratios to the network, NIS, and yaw error at the end."""
    names = list(found[0].fused_m) if found else []
    head = ["group", "n", "network"]
    for name in names:
        head += [f"{name} mean", "p95", "worst"]
    rows = [[*head, "NIS", "NEES", "yaw deg", "< 10 deg", "< 3 sigma"]]
    for group, part in by_group(found):
        rows.append(_row(group, part, names))
    note = "network: median error [m]; ratios to it: geometric mean, 95th percentile, worst"
    consistency_note = (
        "NIS: mean, 3 expected; NEES of position: median, 2.4 expected; yaw: error at the end "
        "relative to the start"
    )
    return "\n".join([*aligned(rows), note, consistency_note])


def _row(group: str, part: Sequence[FusionGain], names: Sequence[str]) -> list[str]:
    row = [group, str(len(part)), f"{np.median([result.network_m for result in part]):.2f}"]
    for name in names:
        ratio = np.log([result.fused_m[name] / result.network_m for result in part])
        figures = np.exp([ratio.mean(), np.quantile(ratio, 0.95), ratio.max()])
        row += [f"{value:.2f}" for value in figures]
    row.append(f"{np.nanmean([result.nis for result in part]):.1f}")
    yaw = np.array([(result.yaw_error, result.yaw_sigma) for result in part])
    yaw = np.abs(yaw[np.isfinite(yaw[:, 0])])
    if len(yaw) == 0:
        return [*row, "-", "-", "-", "-"]
    good, covered = yaw[:, 0] < GOOD_YAW, yaw[:, 0] < SIGMA_BOUND * yaw[:, 1]
    row += [f"{np.nanmedian([result.position_nees for result in part]):.1f}"]
    row += [f"{np.degrees(np.median(yaw[:, 0])):.1f}"]
    return [*row, f"{good.mean():.0%}", f"{covered.mean():.0%}"]


def _error(figures: Metrics) -> float:
    """Return the horizontal error after a fit of yaw and position [m]; NaN if unknown."""
    fitted = figures["ate_fit_m"]
    return _number(figures["known_positions_m"] if fitted is None else fitted)


def _number(figure: float | None) -> float:
    return math.nan if figure is None else figure
