"""Missing samples move a track's end little, and the table reports how far."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.sample_loss import (
    end_shift_table,
    end_shifts,
)
from stario.fusion.evaluation.scores import values, wide
from stario.fusion.navigator import Navigator
from stario.fusion.state import Track
from stario.network.model import load_model
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence, Trajectory


def test_gaps_of_a_tenth_of_a_second_and_5_percent_loss_hardly_move_the_end(
    walk: ImuSequence,
) -> None:
    found = wide(end_shifts(load_model("default"), walk, NavigatorConfig(), "walks"))
    assert len(found) == 7
    assert set(found["recording"]) == {walk.name}
    *gaps, dropped = found.itertuples()
    assert [one.track for one in gaps[::5]] == ["gap at 2 s", "gap at 18 s"]  # of twenty
    # On the short path of a simulated walk of 20 s, a turn at a gap has a large effect.
    assert max(one.metres for one in gaps) < 0.1
    assert max(one.degrees for one in gaps) < 15.0
    assert 0.0 < dropped.metres < 0.01
    assert dropped.degrees < 0.5


def test_a_stationary_recording_is_refused(walk: ImuSequence, still_model: Any) -> None:
    force = np.tile([0.0, 0.0, 9.81], (len(walk), 1))
    still = replace(walk, gyro=0.0 * walk.gyro, accel=force, truth=None)
    with pytest.raises(InputError, match="metre"):
        end_shifts(still_model, still, NavigatorConfig(), "table")


def test_a_shift_is_a_share_of_the_path_and_a_turn_in_degrees(
    still_model: Any, walk: ImuSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three ends: the unmodified one, one 0.5 m and 20 degrees off, the others not at all."""
    time, position = np.arange(3.0), np.outer(np.arange(3.0), [5.0, 0.0, 0.0])
    turned = about_z(np.radians([0.0, 10.0, -20.0]))
    straight, other = (
        Track(Trajectory(time, position + shift, attitude))
        for shift, attitude in (([0.0, 0.0, 0.0], about_z(np.zeros(3))), ([0.3, 0.4, 9.0], turned))
    )
    runs = iter([straight, other, *[straight] * 6])
    monkeypatch.setattr(Navigator, "run", lambda *arguments: next(runs))
    scores = end_shifts(still_model, walk, NavigatorConfig(), "set")
    assert values(scores, "metres")[:2] == pytest.approx([0.05, 0.0])
    assert values(scores, "degrees")[:2] == pytest.approx([20.0, 0.0])
    row = end_shift_table(scores).splitlines()[1].split()
    assert row[:3] == ["set", "7", "86%"]
    assert row[5] == "5.00%"
    assert row[-1] == "20.00"
