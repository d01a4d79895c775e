"""Table that compares the fusion with its network."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import CONFIG

from stario.fusion.evaluation.checks.fusion_gain import FusionGain, fusion_gain, fusion_gain_table
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, PositionTrack

Make = Callable[..., Any]


def test_ratios_are_geometric_means_by_group() -> None:
    rows = [FusionGain("a", "x", 1.0, {"ekf": 0.5}, 3.0, 1.0, 0.01, 0.1)]
    rows += [FusionGain("b", "x", 1.0, {"ekf": 2.0}, 3.0, 5.0, 0.9, 0.1)]
    rows += [FusionGain("c", "y", 2.0, {"ekf": 1.0}, 1.0, float("nan"), float("nan"), 0.1)]
    _, x, y, pooled, *_ = fusion_gain_table(rows).splitlines()
    assert x.split()[:4] == ["x", "2", "1.00", "1.00"]
    assert x.split()[-5:] == ["3.0", "3.0", "26.1", "50%", "50%"]
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
    assert poses.fused_m["ekf"] < 0.5
    assert waypoints.fused_m["ekf"] == pytest.approx(poses.fused_m["ekf"], abs=0.2)


def test_too_little_truth_is_refused(walk: ImuSequence, still_model: Any) -> None:
    with pytest.raises(InputError, match="truth"):
        fusion_gain(still_model, replace(walk, truth=None), CONFIG, "walks")
    # A group's mean would be NaN with a single waypoint within the track.
    at_waypoints = PositionTrack(np.array([5.0, 500.0]), np.zeros((2, 2)), "waypoints")
    with pytest.raises(InputError, match="fewer than 2 within the track"):
        fusion_gain(still_model, replace(walk, truth=None, positions=at_waypoints), CONFIG, "walks")
