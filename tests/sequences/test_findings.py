"""Findings and errors, as they are told and passed on."""

import pickle
from pathlib import Path

import pytest

from stario.sequences.errors import ConfigError, InputError, ReadError, StarioError, WeightsError
from stario.sequences.findings import TOO_EARLY, Finding, verdict


def codes(*findings: Finding) -> list[str]:
    return [finding.code for finding in verdict(findings)]


NOTE = Finding("gaps", "1 gap.", level="note")
AXES = Finding("gyro_axes", "gyroscope: differs", "turn it", values={"tilts": 7})


def test_nothing_to_do_is_said_only_if_nothing_was_found_and_there_was_motion_to_judge():
    assert codes() == ["nothing"]
    assert codes(NOTE) == ["nothing", "gaps"]
    assert codes(NOTE, AXES) == ["gyro_axes", "gaps"]
    assert codes(Finding(TOO_EARLY, "Too early.", level="note")) == [TOO_EARLY]


def test_one_fault_is_told_once():
    again = Finding("gyro_axes", "another inspection of the same")
    follows = Finding("network_contradicts", "30% of the displacements contradict the IMU.")
    assert verdict([AXES, again, follows]) == [AXES]
    assert codes(follows) == ["network_contradicts"]


def test_a_line_joins_observation_and_advice():
    assert AXES.line() == "! gyroscope: differs: turn it"
    assert NOTE.line() == "  1 gap."
    assert str(Finding("gaps", "1 gap.", "Log on.")) == "1 gap. Log on."


@pytest.mark.parametrize(
    "error",
    [
        StarioError("text"),
        InputError("field", "found", "expected", "fix"),
        ConfigError("field", "found", "expected"),
        ReadError(Path("a.csv"), "field", "found", "expected"),
        WeightsError("a.safetensors", "field", "found", "expected", "fix"),
    ],
)
@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_errors_survive_pickling_unchanged(error, protocol):
    again = pickle.loads(pickle.dumps(error, protocol))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
