"""Every published format: recordings written by `conftest.py` are read back unchanged."""

import numpy as np
import pytest
from alike import assert_same, turned_and_measured

from stario.sequences.readers import FORMATS, find_recordings, read_recording
from stario.sequences.sequence import STANDARD_GRAVITY


@pytest.fixture(scope="module")
def read(written):
    return read_recording(written[1].path)


def test_a_recording_is_read_back_as_written(written, read):
    but = {"source", "converted", "device_attitude"}
    assert_same(read, written[1].expected, 1e-6, but)
    np.testing.assert_allclose(read.time, written[1].expected.time, atol=1e-8)


def test_each_format_is_recognised_by_its_content_and_found_below_a_folder(written, read):
    name, recording = written
    assert next(n for n, known in FORMATS.items() if known.recognises(recording.path)) == name
    assert find_recordings(recording.path) == [recording.path]
    assert np.array_equal(read_recording(recording.path, format=name).gyro, read.gyro)
    whole = recording.path.parent if recording.path.suffix == ".csv" else recording.path
    folder = next(p for p in recording.path.parents if p.name.startswith("set"))
    assert find_recordings(folder) == [whole]


def test_mean_force_is_gravity_and_rate_is_the_attitudes_derivative(read):
    """A check by physics, not by the writer: a wrong order, sign or frame would fail."""
    if read.truth is None:
        pytest.skip("a logger's folder has no truth")
    pose = read.truth
    inside = (read.time >= pose.time[0]) & (read.time <= pose.time[-1])
    force = pose.at(read.time[inside]).attitude_WB.apply(read.accel[inside]).mean(axis=0)
    speeds = np.diff(pose.position_W, axis=0) / np.diff(pose.time)[:, None]
    change = (speeds[-1] - speeds[0]) / (pose.time[-1] - pose.time[0])
    assert np.abs(force - change - [0.0, 0.0, STANDARD_GRAVITY]).max() < 0.05
    stride = max(1, round(0.03 / np.median(np.diff(pose.time))))
    turned, measured = turned_and_measured(read, pose, stride)
    assert np.corrcoef(turned.ravel(), measured.ravel())[0, 1] > 0.999
    assert np.sqrt(np.square(turned - measured).mean()) < 0.03 * measured.std()
