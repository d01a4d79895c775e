"""The verdict on recordings whose known positions contradict the track, and on other cases."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from recorded import CASES
from support import CONFIG

from stario.fusion import Navigator, Track
from stario.fusion.evaluation.known_positions import position_findings
from stario.fusion.evaluation.verdict import recording_verdict
from stario.network import load_model
from stario.sequences import read_recording
from stario.sequences.findings import Finding
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack


@cache
def case(name: str) -> dict[str, Finding]:
    path = CASES / name
    if not path.exists():
        pytest.skip(f"{path} is missing")
    sequence = read_recording(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        track = Navigator(load_model("default")).run(sequence)
        return {found.code: found for found in recording_verdict(sequence, track, train="train")}


def test_positions_that_say_the_way_is_longer_are_told_with_the_factor() -> None:
    """A real walk with an instrument in the hand; nothing but its positions can tell."""
    found = case("handheld_walk_too_short/walk.csv")
    assert found["track_scale"].values["scale"] == pytest.approx(2.4, abs=0.3)
    assert "nothing" not in found
    assert "train" not in found  # positions without attitude cannot teach the weights


def test_positions_that_fit_the_mirror_image_name_the_accelerometers_sign() -> None:
    found = case("sign_flipped_with_positions/walk.csv")["mirror_image"]
    assert found.values["error_m"] == pytest.approx(8.3, abs=0.5)
    assert found.values["mirrored_m"] < 1.2
    assert "--accel-sign apple" in found.advice


def test_a_run_says_what_an_inspection_says_of_the_axes() -> None:
    assert case("run_silent_on_axes/gyro_not_rotated.csv")["gyro_axes"].level == "warning"


def test_a_robot_that_turns_about_one_axis_gets_no_remedy_that_harms() -> None:
    found = case("planar_robot/robot.csv")
    assert not {code for code in found if code.startswith("truth_")}
    assert "track_scale" in found
    assert found["train"].advice == "Run `train`."


def test_a_rate_that_may_be_in_degrees_is_asked() -> None:
    assert (
        "--gyro-unit deg/s" in case("gyro_degrees_planar_robot/robot.csv")["gyro_unit_open"].advice
    )


@pytest.fixture(scope="module")
def walk_and_track(make_walk: Callable[..., Any], make_oracle: Any) -> tuple[ImuSequence, Track]:
    walk = make_walk(3, 60.0)
    return walk, Navigator(make_oracle(walk, walk.truth, CONFIG), CONFIG).run(walk)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda xy: xy, ""),
        (lambda xy: xy @ [[0.6, 0.8], [-0.8, 0.6]] + [100.0, -30.0], ""),  # another map
        (lambda xy: 1.15 * xy, ""),
        (lambda xy: 2.4 * xy, "track_scale"),
        (lambda xy: 0.5 * xy, "track_scale"),
        (lambda xy: xy * [1.0, -1.0], "mirror_image"),
    ],
)
def test_positions_contradict_by_length_and_handedness_alone(
    walk_and_track: tuple[ImuSequence, Track],
    change: Callable[[FloatArray], FloatArray],
    code: str,
) -> None:
    walk, track = walk_and_track
    assert walk.truth is not None
    time = np.arange(0.0, 60.0, 0.5)
    path = change(walk.truth.at(time).position_W[:, :2])
    known = PositionTrack(time, path, "positions")
    found = position_findings(track, replace(walk, truth=None, positions=known))
    assert [finding.code for finding in found if finding.code != "track_error"] == [code] * bool(
        code
    )
    few = replace(walk, truth=None, positions=known.slice(0.0, 1.2))
    assert position_findings(track, few) == []


def test_a_right_truth_contradicts_nothing(walk_and_track: tuple[ImuSequence, Track]) -> None:
    walk, track = walk_and_track
    assert position_findings(track, walk) == []
    assert position_findings(track, walk.without_truth()) == []
