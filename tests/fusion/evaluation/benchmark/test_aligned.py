"""Recordings aligned for judging: truth that cannot judge."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.fusion.evaluation.benchmark.aligned import aligned_recording
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


def test_a_wrong_truth_is_warned_of(
    stepping: ImuSequence, caplog: pytest.LogCaptureFixture
) -> None:
    truth = stepping.truth
    wrong = replace(stepping, truth=replace(truth, position_W=truth.position_W * [-1.0, 1.0, 1.0]))
    aligned_recording(wrong, Path("steps"))
    assert "steps: truth: positions mirrored" in caplog.text
