"""Tracks with fixes, evaluated against ground truth."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import CONFIG

from stario.fusion.evaluation.checks.with_fixes import fixes_table, track_with_fixes, true_fixes
from stario.fusion.evaluation.scores import values, wide
from stario.fusion.health import Health
from stario.fusion.navigator import Navigator
from stario.fusion.state import Track
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

Make = Callable[..., Any]


def test_true_fixes_keep_a_track_near_the_truth(walk: ImuSequence, make_oracle: Make) -> None:
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    scores = track_with_fixes(oracle, walk, CONFIG, "walks", every=2.0, sigma=0.05)
    [found] = wide(scores).itertuples()
    assert found.applied > 0.8
    assert found.position_rms < 0.3
    assert found.yaw_covered == 1.0
    row = fixes_table(scores).splitlines()[1].split()
    assert row[:2] == ["walks", "1"]
    assert row[-1] == "100.0%"


def test_errors_and_sigmas_are_those_of_the_second_half(
    walk: ImuSequence, still_model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A track that is lost at first, then off by (0.3, 0.4, 0) m and 0.02 rad."""
    truth = walk.truth
    off = np.where(truth.time > truth.time[-1] / 2.0, 1.0, 100.0)
    trajectory = replace(
        truth,
        position_W=truth.position_W + np.outer(off, [0.3, 0.4, 0.0]),
        attitude_WB=about_z(0.02) * truth.attitude_WB,
    )
    variances = [1.0, 1.0, 0.01**2, *[9.0] * 3, *[0.5**2] * 3, *[4.0] * 6]
    track = Track(
        trajectory,
        covariance=np.tile(np.diag(variances), (len(truth), 1, 1)),
        health=Health(fixes={"applied": 3}),
    )
    monkeypatch.setattr(Navigator, "run", lambda *arguments, **options: track)
    scores = track_with_fixes(still_model, walk, CONFIG, "walks", every=5.0)
    [found] = wide(scores).itertuples()
    assert found.applied == pytest.approx(0.75)
    assert found.position_rms == pytest.approx(0.5)
    assert found.position_nees == pytest.approx(0.5**2 / 0.25)
    assert found.yaw_rms == pytest.approx(0.02)
    assert found.yaw_nees == pytest.approx((0.02 / 0.01) ** 2)
    assert found.yaw_covered == 1.0
    assert fixes_table(scores).splitlines()[1].split()[2:] == [
        "75%", "0.50", "1.0", "1.1", "4.0", "100.0%",
    ]  # fmt: skip


def test_errors_of_fixes_match_their_stated_sigma(walk: ImuSequence) -> None:
    fixes = true_fixes(walk.truth, 0.05, 0.2, seed=1)
    at = walk.truth.at(np.array([fix.time for fix in fixes])).position_W
    error = np.array([fix.value for fix in fixes]) - at
    assert np.sqrt((error**2).mean()) == pytest.approx(0.2, rel=0.1)


def test_missing_poses_and_too_few_fixes_are_refused(walk: ImuSequence, still_model: Any) -> None:
    with pytest.raises(InputError, match="truth"):
        track_with_fixes(still_model, replace(walk, truth=None), CONFIG, "walks")
    with pytest.raises(InputError, match="fixes"):
        track_with_fixes(still_model, walk, CONFIG, "walks", every=15.0)


def test_truth_before_the_first_sample_gives_no_fixes(
    walk: ImuSequence, make_oracle: Make, caplog: pytest.LogCaptureFixture
) -> None:
    assert walk.truth is not None
    time = walk.truth.time.copy()
    time[0] = walk.time[0] - 1.0
    earlier = replace(walk, truth=replace(walk.truth, time=time))
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    scores = track_with_fixes(oracle, earlier, CONFIG, "walks", every=2.0, sigma=0.05)
    assert "before the start" not in caplog.text
    assert values(scores, "applied") > 0.9
