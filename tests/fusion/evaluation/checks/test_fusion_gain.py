"""Table that compares the fusion with its network."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import CONFIG

from stario.fusion.evaluation.checks.fusion_gain import fusion_gain, fusion_gain_table
from stario.fusion.evaluation.scores import joined, scored, values
from stario.fusion.navigator import Navigator
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, PositionTrack

Make = Callable[..., Any]


def of(scores: pd.DataFrame, metric: str, track: str = "ekf") -> float:
    [found] = values(scores, metric, track=track)
    return float(found)


def row(name: str, group: str, ratio: float, network: float, **ekf: float) -> pd.DataFrame:
    return scored(name, {"network": {"error_m": network}, "ekf": {"ratio": ratio, **ekf}}, group)


def test_ratios_are_geometric_means_by_group() -> None:
    rows = [
        row("a", "x", 0.5, 1.0, nis=3.0, nees=1.0, yaw_error=0.01, yaw_good=1.0),
        row("b", "x", 2.0, 1.0, nis=3.0, nees=5.0, yaw_error=-0.9, yaw_good=0.0),
        row("c", "y", 0.5, 2.0, nis=1.0),
    ]
    _, x, y, pooled, *_ = fusion_gain_table(joined(rows)).splitlines()
    assert x.split()[:4] == ["x", "2", "1.00", "1.00"]
    assert x.split()[4:6] == ["1.87", "2.00"]  # 95th percentile on a logarithmic scale, and worst
    assert x.split()[-5:-1] == ["3.0", "3.0", "26.1", "50%"]
    assert y.split()[3] == "0.50"
    assert pooled.split()[:2] == ["all", "3"]


def test_the_error_of_the_fusion_at_waypoints_agrees_with_its_error_at_poses(
    walk: ImuSequence, make_oracle: Make
) -> None:
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    poses = fusion_gain(oracle, walk, CONFIG, "walks", ("ekf",))
    every = slice(None, None, 500)
    at = walk.truth.time[every], walk.truth.position_W[every, :2]
    at_waypoints = replace(walk, truth=None, positions=PositionTrack(*at, "waypoints"))
    waypoints = fusion_gain(oracle, at_waypoints, CONFIG, "walks", ("ekf",))
    assert of(poses, "error_m") < 0.5
    assert of(waypoints, "error_m") == pytest.approx(of(poses, "error_m"), abs=0.2)
    path = walk.truth.path_length()
    assert of(poses, "percent") == pytest.approx(100.0 * of(poses, "error_m") / path)
    legs = np.linalg.norm(np.diff(at[1], axis=0), axis=1).sum()
    assert of(waypoints, "percent") == pytest.approx(100.0 * of(waypoints, "error_m") / legs)


def test_the_yaw_error_is_that_since_the_start_next_to_the_sigma_of_yaw(
    walk: ImuSequence, make_oracle: Make
) -> None:
    """A world whose axes point elsewhere changes neither."""
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    turn, truth = about_z(2.0), walk.truth
    other = replace(
        truth, position_W=turn.apply(truth.position_W), attitude_WB=turn * truth.attitude_WB
    )
    found, rotated = (
        fusion_gain(oracle, replace(walk, truth=each), CONFIG, "walks", ("ekf",))
        for each in (truth, other)
    )
    assert of(rotated, "yaw_error") == pytest.approx(of(found, "yaw_error"), abs=1e-9)
    assert abs(of(found, "yaw_error")) < 0.1
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk)
    assert of(found, "yaw_sigma") == pytest.approx(np.sqrt(track.covariance[-1, 2, 2]))
    half = truth.slice(truth.time[0], 0.5 * truth.time[-1])
    shorter = fusion_gain(oracle, replace(walk, truth=half), CONFIG, "walks", ("ekf",))
    at_its_end = np.flatnonzero(track.time <= half.time[-1])[-1]
    assert of(shorter, "yaw_sigma") == pytest.approx(np.sqrt(track.covariance[at_its_end, 2, 2]))


def test_too_little_truth_is_refused(walk: ImuSequence, still_model: Any) -> None:
    with pytest.raises(InputError, match="truth"):
        fusion_gain(still_model, replace(walk, truth=None), CONFIG, "walks")
    # A group's mean would be NaN with a single waypoint within the track.
    at_waypoints = PositionTrack(np.array([5.0, 500.0]), np.zeros((2, 2)), "waypoints")
    with pytest.raises(InputError, match="fewer than 2 within the track"):
        fusion_gain(still_model, replace(walk, truth=None, positions=at_waypoints), CONFIG, "walks")
