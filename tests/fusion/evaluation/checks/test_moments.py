"""The check of bad moments measures the rest of a track and its steps, and its table adds up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks import moments
from stario.fusion.evaluation.checks.moments import (
    largest_correction,
    moment_costs,
    moment_table,
)
from stario.fusion.evaluation.scores import joined, scored, wide
from stario.fusion.state import Track
from stario.network.model import load_model
from stario.sequences import ImuSequence, InputError
from stario.sequences.attitude.rotations import about_z
from stario.sequences.sequence import Trajectory
from stario.sequences.simulation.moments import MOMENTS

BY_NAME = {moment.name: moment for moment in MOMENTS}


def cost(walk: int, ratio: float, step: float, turn: float, place: str = "start") -> pd.DataFrame:
    small = float(step <= 1.0 and turn <= 10.0)
    figures = {"error_without": 2.0, "ratio": ratio, "joined_ratio": 2.0, "small": small}
    figures |= {"step": step, "turn": turn, "step_without": 0.1, "turn_without": 1.0}
    return scored(f"walk {walk}", {"ekf": figures}, f"drop, {place}")


def test_the_table_counts_small_ratios_and_small_corrections() -> None:
    found = [cost(0, 1.0, 0.5, 20.0), cost(1, 4.0, 0.5, 5.0), cost(0, 1.1, 0.2, 2.0, "end")]
    lines = moment_table(joined(found)).splitlines()
    assert lines[1].split()[:4] == ["drop,", "end", "ekf", "1"]
    start = lines[2].split()
    assert start[3:] == ["2", "2.00", "2.00", "4.00", "2.00", "2.00", "50%", "0.5", "20.0", "50%"]
    assert lines[3].split()[0] == "all"


def test_a_step_that_the_velocity_does_not_explain_is_a_correction(walk: ImuSequence) -> None:
    time = np.arange(0.0, 5.0, 0.1)
    true = walk.truth.at(time)
    late = time > 2.0
    velocity = np.gradient(true.position_W, time, axis=0)
    moved = replace(
        true, velocity_W=velocity, position_W=true.position_W + late[:, None] * [0.0, 3.0, 0.0]
    )
    turned = replace(moved, attitude_WB=about_z(0.5 * late) * true.attitude_WB)
    zero = np.zeros((len(time), 3))
    step, turn = largest_correction(walk, Track(moved, b_g=zero))
    assert step == pytest.approx(3.0, abs=0.1)
    assert turn < 2.0  # errors of the gyroscope
    assert largest_correction(walk, Track(turned, b_g=zero))[1] == pytest.approx(
        np.degrees(0.5), abs=2.0
    )
    in_gap = replace(turned, valid=time != time[late][0])
    step, turn = largest_correction(walk, Track(in_gap, b_g=zero))
    assert step < 0.1
    assert turn < 2.0


def test_errors_are_those_of_each_part_and_of_both_as_one() -> None:
    """A turn of the second part by 90 degrees is no error of the parts."""
    truth = np.arange(20.0) + 0j
    before = np.arange(20) < 10
    estimate = np.where(before, truth, 10.0 + 1j * (truth - 10.0))
    apart, joined = moments._errors(truth, estimate, before)
    assert apart == pytest.approx(0.0, abs=1e-9)
    assert joined > 1.0
    assert np.isnan(moments._errors(truth[:2], estimate[:2], before[:2])[0])


def test_a_phone_laid_down_and_taken_up_costs_the_rest_little(
    walk: ImuSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(moments, "MOMENTS", (BY_NAME["table"],))
    monkeypatch.setattr(moments, "PLACES", {"middle": 0.5})
    [found] = wide(moment_costs(load_model("default"), walk, NavigatorConfig())).itertuples()
    assert (found.group, found.track) == ("table, middle", "ekf")
    assert 0.0 < found.error_with < 2.0 * found.error_without
    assert 0.0 < found.step_without < moments.MAX_STEP


def test_a_recording_without_known_positions_is_refused(walk: ImuSequence) -> None:
    with pytest.raises(InputError, match="truth"):
        moment_costs(object(), walk.without_truth(), NavigatorConfig())  # type: ignore[arg-type]


def test_a_recording_begins_at_its_first_known_position_and_is_cut(walk: ImuSequence) -> None:
    assert walk.truth is not None
    late = replace(walk, truth=walk.truth.slice(5.0, 20.0))
    assert moments._with_truth(late).time[0] == pytest.approx(5.0)
    assert isinstance(late.truth, Trajectory)
