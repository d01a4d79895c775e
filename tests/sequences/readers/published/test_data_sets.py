"""Every published format: recordings written by `conftest.py` are read back unchanged."""

import numpy as np
import pytest
from alike import assert_same

from stario.sequences.readers import FORMATS, find_recordings, read_recording


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
