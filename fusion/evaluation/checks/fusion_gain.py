"""Benefit of the fusion: the filter's and the graph's error relative to the network's, by group.

The network's displacements are chained along the attitude levelled from the IMU. Errors are
horizontal, root mean square after a fit of yaw and position: over all poses, or at the waypoints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import get_args

import numpy as np
import pandas as pd

from stario.fusion.backends import BackendName
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.compare import Metrics, measure
from stario.fusion.evaluation.known_positions import MIN_POSITIONS
from stario.fusion.evaluation.scores import (
    Column,
    geometric_mean,
    median_degrees,
    parts,
    scored,
    table,
)
from stario.fusion.evaluation.tracks import network_track
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.state import Track
from stario.sequences.accuracy.metrics import pose_errors
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

SIGMA_BOUND = 3.0
"""Maximum yaw error of a consistent track, in standard deviations."""

GOOD_YAW = math.radians(10.0)
"""Maximum acceptable yaw error at the end [rad]."""

_NETWORK = {"track": "network"}

_NOTES = (
    "network: median error [m]; ratios to it: geometric mean, 95th percentile, worst",
    "% of path: error over the length of the true path, median",
    "NIS: mean, 3 expected; NEES of position: median, 2.4 expected; yaw: error at the end "
    "relative to the start",
)


def fusion_gain(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    group: str,
    backends: Sequence[BackendName] = get_args(BackendName),
) -> pd.DataFrame:
    """Score the network alone and the back ends: `error_m`, its `ratio` to the network's, NIS.

    The error is also given in percent of the true path (of the legs between waypoints).

    With true poses also the NEES of position, and at the end of the truth the yaw error relative to
    its start [rad], the yaw's reported standard deviation [rad], and whether the error is good and
    within the bound.

    Raises:
        InputError: it has no ground truth or too few known positions, or cannot be run.
    """
    truth = sequence.truth
    if truth is None and sequence.positions is None:
        raise InputError(f"{sequence.name}: truth", "none", "poses, positions or waypoints")
    preprocessed = Navigator(model, config).observe(sequence)
    alone = fitted_error(measure(network_track(preprocessed), sequence))
    if math.isnan(alone):
        raise InputError(
            f"{sequence.name}: positions",
            f"fewer than {MIN_POSITIONS} within the track",
            f"{MIN_POSITIONS} or more",
        )
    path = _path_length(sequence)
    figures: dict[str, Metrics] = {"network": {"error_m": alone}}
    for name in backends:
        track = Navigator(model, config, backend=name).track(preprocessed)
        found = measure(track, sequence)
        error = fitted_error(found)
        figures[name] = {"error_m": error, "percent": 100.0 * error / path if path else None}
        figures[name] |= {"ratio": error / alone, "nis": found["nis_mean"]}
        if truth is not None:
            figures[name] |= {"nees": found["nees_median"], **_yaw_at_the_end(track, truth)}
    return scored(sequence.name, figures, group)


def fusion_gain_table(scores: pd.DataFrame) -> str:
    """Return a row for each group: ratios to the network, NIS, and yaw error at the end."""
    backends = [name for name in scores["track"].unique() if name != "network"]
    columns = [
        Column("n", "error_m", ".0f", len, _NETWORK),
        Column("network", "error_m", where=_NETWORK),
    ]
    for name in backends:
        where = {"track": name}
        columns += [
            Column(f"{name} mean", "ratio", ".2f", geometric_mean, where),
            Column("p95", "ratio", ".2f", _percentile_95, where),
            Column("worst", "ratio", ".2f", np.max, where),
            Column("% of path", "percent", ".1f", np.median, where),
        ]
    first = {"track": backends[0]}
    columns += [
        Column("NIS", "nis", ".1f", np.mean, first),
        Column("NEES", "nees", ".1f", np.median, first),
        Column("yaw deg", "yaw_error", ".1f", median_degrees, first),
        Column("< 10 deg", "yaw_good", ".0%", np.mean, first),
        Column("< 3 sigma", "yaw_covered", ".0%", np.mean, first),
    ]
    return table(parts(scores), columns, notes=_NOTES)


def _yaw_at_the_end(track: Track, truth: Trajectory) -> dict[str, float]:
    assert track.covariance is not None  # both back ends give it
    errors = pose_errors(track.trajectory, truth)
    yaw = np.unwrap(errors.yaw)
    # The truth may end before the track, whose sigma grows further.
    last = np.searchsorted(track.time, errors.estimate.time[-1])
    error, sigma = float(yaw[-1] - yaw[0]), math.sqrt(track.covariance[last, 2, 2])
    good, covered = abs(error) < GOOD_YAW, abs(error) < SIGMA_BOUND * sigma
    return {
        "yaw_error": error,
        "yaw_sigma": sigma,
        "yaw_good": float(good),
        "yaw_covered": float(covered),
    }


def fitted_error(figures: Metrics) -> float:
    """Return the horizontal error after a fit of yaw and position [m]; NaN if unknown."""
    fitted = figures["ate_fit_m"]
    found = figures["known_positions_m"] if fitted is None else fitted
    return math.nan if found is None else found


def _path_length(sequence: ImuSequence) -> float | None:
    """Return the length of the true path [m]; None for positions whose noise adds up."""
    if sequence.truth is not None:
        return sequence.truth.path_length()
    known = sequence.positions
    if known is None or known.kind != "waypoints":
        return None
    steps = np.diff(known.position_W[known.valid], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def _percentile_95(ratios: FloatArray) -> float:
    return float(np.exp(np.quantile(np.log(ratios), 0.95)))
