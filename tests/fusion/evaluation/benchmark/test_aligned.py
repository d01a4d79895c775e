"""Recordings aligned for judging: truth that cannot judge, and the cache."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from judged import with_waypoints

from stario.fusion.evaluation.benchmark.aligned import (
    Aligned,
    aligned_recording,
    aligned_recordings,
)
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence


def test_a_recording_without_truth_is_refused(walk: ImuSequence) -> None:
    with pytest.raises(InputError, match="truth: found none"):
        aligned_recording(walk.without_truth(), Path("walk"))


@pytest.mark.parametrize("count", [0, 1])
def test_ground_truth_with_one_valid_pose_or_none_is_refused(walk: ImuSequence, count: int) -> None:
    valid = np.arange(len(walk.truth.time)) < count
    with pytest.raises(InputError, match=f"truth: found {count} valid"):
        aligned_recording(replace(walk, truth=replace(walk.truth, valid=valid)), Path("walk"))


def test_aligned_recordings_are_cached(walk: ImuSequence, tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_text("stands for the recording")
    read: list[Path] = []

    def reading(path: Path) -> ImuSequence:
        read.append(path)
        return with_waypoints(walk)

    first, again = (
        next(aligned_recordings([path], reading, {}, tmp_path / "cache", 1)) for _ in range(2)
    )
    assert len(read) == 1
    assert isinstance(first, Aligned)
    assert isinstance(again, Aligned)
    assert again.kind == "waypoints"
    np.testing.assert_array_equal(again.pieces[0].waypoint_W, first.pieces[0].waypoint_W)
    np.testing.assert_array_equal(again.pieces[0].stream.imu_N, first.pieces[0].stream.imu_N)
    next(aligned_recordings([path], reading, {"axes": "y,-x,z"}, tmp_path / "cache", 1))
    assert len(read) == 2
    path.write_text("another recording")
    next(aligned_recordings([path], reading, {}, tmp_path / "cache", 1))
    assert len(read) == 3


def test_a_wrong_truth_is_warned_of_also_from_the_cache(
    stepping: ImuSequence, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    truth = stepping.truth
    wrong = replace(stepping, truth=replace(truth, position_W=truth.position_W * [-1.0, 1.0, 1.0]))
    path = tmp_path / "walk.csv"
    path.touch()
    for _ in range(2):
        caplog.clear()
        next(aligned_recordings([path], lambda _: wrong, {}, tmp_path / "cache", 1))
        assert "steps: truth: positions mirrored" in caplog.text
