"""Simulated walks move like recorded ones, and the check measures what it says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.simulation import (
    BANDS,
    RECORDED,
    SIMULATED,
    SPEEDS,
    carry_of,
    motion,
    motion_scores,
    motion_table,
    simulated_walk,
)
from stario.fusion.evaluation.scores import joined, values
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

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


@pytest.mark.parametrize("carry", SPEEDS)
def test_simulated_walks_move_within_a_third_of_recorded_ones(carry: str) -> None:
    found = [motion(simulated_walk(carry, seed, 60.0)) for seed in range(24)]
    keys = [*(f"force_{low:g}" for low, _ in BANDS), "rate"]
    medians = [float(np.median([each[key] for each in found])) for key in keys]
    ratio = np.array(medians) / MEASURED[carry]
    assert (ratio > 2.0 / 3.0).all(), ratio
    assert (ratio < 4.0 / 3.0).all(), ratio


def test_motion_is_that_of_a_known_vibration() -> None:
    """A device that shakes along the vertical at 4.5 Hz, steps at 2 Hz and turns evenly."""
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


def test_a_recording_without_a_known_carry_is_refused() -> None:
    walk = simulated_walk("pocket", 0, 10.0)
    assert carry_of(replace(walk, attributes={"carry": "pocket (front)"})) == "pocket"
    with pytest.raises(InputError, match="carry"):
        carry_of(walk)


def test_the_table_has_a_row_of_each_kind_and_says_what_is_missing(still_model: Any) -> None:
    walk = simulated_walk("bag", 1, 20.0)
    simulated = motion_scores(still_model, walk, NavigatorConfig(), "bag", SIMULATED)
    assert values(simulated, "network") > 20.0  # % of the path: the network says that it rests
    assert "none given" in motion_table(simulated)
    both = joined([simulated, simulated.assign(track=RECORDED)])
    text = motion_table(both)
    assert "bag, simulated" in text
    assert "bag, recorded" in text
    assert "none given" not in text
