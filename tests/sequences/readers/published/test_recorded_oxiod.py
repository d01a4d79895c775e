"""Recordings of OxIOD: mount and lag are found, glitches masked and the world is level."""

from pathlib import Path

import numpy as np
import pytest
from alike import turned_and_measured
from recorded import DATA

from stario.sequences.readers import find_recordings, read_recording

OXIOD = DATA / "oxiod"
needs_data = pytest.mark.skipif(not OXIOD.is_dir(), reason=f"no recordings at {OXIOD}")

SELECTED = (
    "handheld/data1/syn/imu2.csv",  # flips at 149 s
    "multi users/user2/syn/imu6.csv",  # flips at 252 s
    "trolley/data2/syn/imu1.csv",  # turns about the vertical only
)
ALL = find_recordings(OXIOD) if OXIOD.is_dir() else []


def assert_consistent(path: Path) -> None:
    sequence = read_recording(path)
    truth = sequence.truth
    stride = 10
    true, measured = turned_and_measured(sequence, truth, stride)
    inside = (truth.time > sequence.time[0]) & (truth.time < sequence.time[-1]) & truth.valid
    good = inside[:-stride] & inside[stride:]
    true, measured = true[good], measured[good]
    assert np.corrcoef(true.ravel(), measured.ravel())[0, 1] > 0.95
    # No flip or glitch remains: over 0.1 s the two rotations agree to a few degrees.
    difference = np.degrees(np.linalg.norm(true - measured, axis=1))
    assert np.percentile(difference, 99.9) < 15.0
    assert truth.valid.mean() > 0.97
    steps = np.linalg.norm(np.diff(truth.position_W, axis=0), axis=1)
    assert steps[truth.valid[:-1] & truth.valid[1:]].max() < 0.05  # 5 m/s
    inside = sequence.time < truth.time[-1]
    pose = truth.at(sequence.time[inside])
    force = pose.attitude_WB.apply(sequence.accel[inside])[pose.valid].mean(axis=0)
    assert np.degrees(np.arctan2(np.hypot(*force[:2]), force[2])) < 0.1
    assert np.linalg.norm(force) == pytest.approx(9.8, abs=0.15)
    field = sequence.magnetometer
    inside = (field.time >= truth.time[0]) & (field.time <= truth.time[-1])
    pose = truth.at(field.time[inside])
    field_W = pose.attitude_WB.apply(field.field[inside])[pose.valid]
    assert 10.0 < np.linalg.norm(field_W.mean(axis=0)) < 60.0
    assert np.linalg.norm(field_W.std(axis=0)) < 0.6 * np.linalg.norm(field_W.mean(axis=0))


@needs_data
@pytest.mark.parametrize("name", SELECTED)
def test_selected_recordings_are_self_consistent(name):
    assert_consistent(OXIOD / name)


@needs_data
@pytest.mark.slow
@pytest.mark.parametrize("path", ALL, ids=str)
def test_every_recording_is_self_consistent(path):
    assert_consistent(path)
