from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stario.fusion import NavigatorConfig, Track
from stario.fusion.evaluation.checks import moments
from stario.fusion.evaluation.checks.moments import largest_correction, moment_costs, moment_table
from stario.fusion.evaluation.checks.simulation import (
    BANDS,
    RECORDED,
    SIMULATED,
    WAYS,
    carry_of,
    motion,
    motion_scores,
    motion_table,
    simulated_walk,
)
from stario.fusion.evaluation.scores import joined, scored, values
from stario.network.model import load_model
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import ImuErrors, simulate_imu
from stario.sequences.simulation.moments import MOMENTS
from stario.sequences.simulation.walks import generate_walk

BY_NAME = {moment.name: moment for moment in MOMENTS}


def cost(walk: int, ratio: float, step: float, turn: float, place: str = "start") -> pd.DataFrame:
    small = float(step <= 1.0 and turn <= 10.0)
    figures = {"error_without": 2.0, "ratio": ratio, "joined_ratio": 2.0, "small": small}
    figures |= {
        "end_sigmas": ratio,
        "step": step,
        "turn": turn,
        "step_without": 0.1,
        "turn_without": 1.0,
    }
    return scored(f"walk {walk}", {"filtered": figures}, f"drop, {place}")


def test_the_table_counts_small_ratios_and_small_corrections():
    found = [cost(0, 1.0, 0.5, 20.0), cost(1, 4.0, 0.5, 5.0), cost(0, 1.1, 0.2, 2.0, "end")]
    lines = moment_table(joined(found)).splitlines()
    assert lines[1].split()[:4] == ["drop,", "end", "filtered", "1"]
    start = lines[2].split()
    assert start[3:9] == ["2", "2.00", "2.00", "4.00", "2.00", "2.00"]
    assert start[9:] == ["50%", "4.0", "0.5", "20.0", "50%"]
    assert lines[3].split()[0] == "all"


def test_a_step_that_the_velocity_does_not_explain_is_a_correction(walk):
    time = np.arange(0.0, 5.0, 0.1)
    true = walk.truth.at(time)
    late = time > 2.0
    velocity = np.gradient(true.position_W, time, axis=0)
    position_W = true.position_W + late[:, None] * [0.0, 3.0, 0.0]
    moved = replace(true, velocity_W=velocity, position_W=position_W)
    turned = replace(moved, attitude_WB=about_z(0.5 * late) * true.attitude_WB)
    zero = np.zeros((len(time), 3))
    step, turn = largest_correction(walk, Track(moved, b_g=zero))
    assert step == pytest.approx(3.0, abs=0.1)
    assert turn < 2.0  # errors of the gyroscope
    _, turn = largest_correction(walk, Track(turned, b_g=zero))
    assert turn == pytest.approx(np.degrees(0.5), abs=2.0)
    in_gap = replace(turned, valid=time != time[late][0])
    step, turn = largest_correction(walk, Track(in_gap, b_g=zero))
    assert step < 0.1
    assert turn < 2.0


def test_errors_are_those_of_each_part_and_of_both_as_one():
    """A turn of the second part by 90 degrees is no error of the parts."""
    truth = np.arange(20.0) + 0j
    before = np.arange(20) < 10
    estimate = np.where(before, truth, 10.0 + 1j * (truth - 10.0))
    apart, joined, end = moments._errors(truth, estimate, before)
    assert apart == pytest.approx(0.0, abs=1e-9)
    assert joined > 1.0
    assert end == pytest.approx(9.0 * np.sqrt(2.0))
    assert np.isnan(moments._errors(truth[:2], estimate[:2], before[:2])[0])


@pytest.fixture
def costs(monkeypatch):
    """What the moment of a name costs in the middle of a recording."""

    def of(name, recording):
        monkeypatch.setattr(moments, "MOMENTS", (BY_NAME[name],))
        monkeypatch.setattr(moments, "PLACES", {"middle": 0.5})
        [found] = moment_costs(load_model(), recording, NavigatorConfig()).itertuples()
        return found

    return of


def test_a_phone_laid_down_and_taken_up_costs_the_rest_little(walk, costs):
    found = costs("table", walk)
    assert (found.group, found.track) == ("table, middle", "filtered")
    assert 0.0 < found.error_with < 2.0 * found.error_without
    assert 0.0 < found.step_without < moments.MAX_STEP


def test_a_fall_beyond_the_sensors_range_makes_no_correction_of_a_metre(costs):
    walk = simulate_imu(generate_walk(2, 20.0), 200.0, ImuErrors(), 2)
    assert costs("drop", walk).step < 1.0


def test_a_phone_thrown_and_caught_keeps_its_heading(walk, costs):
    found = costs("throw", walk)
    assert found.end_sigmas < 3.0
    assert found.error_with < 3.0 * found.error_without


def test_the_sigma_of_a_track_allows_for_a_ride(costs):
    walk = simulate_imu(generate_walk(2, 40.0), 100.0, ImuErrors(), 2)
    assert costs("bus", walk).end_sigmas < 3.0


MEASURED = {
    "pocket": (1.04, 0.69, 0.99, 0.60, 1.4),
    "back-pocket": (0.81, 1.00, 1.04, 0.48, 1.3),
    "texting": (0.38, 0.44, 0.24, 0.11, 0.6),
    "call": (0.46, 0.48, 0.26, 0.12, 0.8),
    "swinging": (1.77, 0.64, 0.41, 0.17, 1.9),
    "bag": (1.83, 0.86, 0.57, 0.43, 0.9),
    "handheld": (1.3, 0.33, 0.2, 0.11, 0.5),
    "in-front": (3.0, 1.4, 0.7, 0.4, 0.85),
}
"""Medians of the archives: force by band [m/s^2], and angular rate [rad/s]."""


@pytest.mark.parametrize("carry", WAYS)
def test_simulated_walks_move_about_as_recorded_ones(carry):
    """A recording also has turns and halts; of a swinging hand few seconds are a steady walk."""
    found = [motion(simulated_walk(carry, seed, 60.0)) for seed in range(6)]
    keys = [*(f"force_{low:g}" for low, _ in BANDS), "rate"]
    medians = [float(np.median([each[key] for each in found])) for key in keys]
    ratio = np.array(medians) / MEASURED[carry]
    assert (ratio > (0.35 if carry == "swinging" else 0.55)).all(), ratio
    assert (ratio < 1.5).all(), ratio


def test_motion_is_that_of_a_known_vibration():
    time = np.arange(0.0, 20.0, 0.01)
    accel = np.zeros((len(time), 3))
    accel[:, 2] = 9.8 + 2.0 * np.sin(2.0 * np.pi * 2.0 * time) + np.sin(2.0 * np.pi * 4.5 * time)
    gyro = np.tile([0.0, 0.3, 0.4], (len(time), 1))
    found = motion(ImuSequence("shaken", time, gyro, accel))
    assert found["force_0.5"] == pytest.approx(2.0 / np.sqrt(2.0), rel=0.02)
    assert found["force_3"] == pytest.approx(1.0 / np.sqrt(2.0), rel=0.02)
    assert found["force_10"] < 0.02
    assert found["rate"] == pytest.approx(0.5)
    assert found["step_rate"] == pytest.approx(2.0, abs=0.06)
    short = motion(ImuSequence("short", time[:400], gyro[:400], accel[:400]))
    assert short["step_rate"] == pytest.approx(2.0, abs=0.1)


def test_a_recording_without_a_known_carry_is_refused():
    walk = simulated_walk("pocket", 0, 10.0)
    assert carry_of(replace(walk, attributes={"carry": "pocket (front)"})) == "pocket"
    with pytest.raises(InputError, match="carry"):
        carry_of(walk)


def test_the_table_has_a_row_of_each_kind_and_says_what_is_missing(still_model):
    walk = simulated_walk("bag", 1, 20.0)
    simulated = motion_scores(still_model, walk, NavigatorConfig(), "bag", SIMULATED)
    assert values(simulated, "network_percent") > 20.0  # the network says that it rests
    assert "none given" in motion_table(simulated)
    assert simulated["track_percent"].notna().all()
    both = joined([simulated, simulated.assign(track=RECORDED)])
    text = motion_table(both)
    assert "bag, simulated" in text
    assert "bag, recorded" in text
    assert "none given" not in text
