"""The file for rerun's viewer holds track, attitude, covariance and sensors, with their units."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import Trajectory


@pytest.fixture
def view():
    pytest.importorskip("rerun", reason="pip install '.[view]'")
    from stario.fusion.report import view

    return view


def test_file_holds_every_quantity_over_time(tmp_path, view, walk, still_model):
    from stario.fusion import Navigator
    from stario.fusion.evaluation.compare import Comparison

    reader = pytest.importorskip("rerun.chunk", reason="requires rerun 0.41 or newer").RrdReader
    track = Navigator(still_model).run(walk)
    path = view.write_view(
        tmp_path / "track.rrd", Comparison(walk, {"track": track}, {"track": {}})
    )
    entities = {str(chunk.entity_path) for chunk in reader(str(path)).stream()}
    for name in ("world/track", "world/truth", "world/device", "NIS", "bias", "force", "yaw"):
        assert any(name in entity for entity in entities), (name, entities)


def test_the_viewer_is_started_on_the_file(tmp_path, view, monkeypatch):
    started = []
    monkeypatch.setattr(view.subprocess, "Popen", lambda command, **_: started.append(command))
    view.open_view(tmp_path / "track.rrd")
    assert started[0][-3:] == ["-m", "rerun", str(tmp_path / "track.rrd")]


def test_a_path_is_broken_in_a_gap(view):
    class Stream:
        def log(self, entity, strips, static):
            self.strips = strips.strips.as_arrow_array().to_pylist()

    time = np.arange(0.0, 20.0, 0.1)
    time = time[(time < 5.0) | (time > 9.0)]
    path = Trajectory(time, np.outer(time, [1.0, 0.0, 0.0]), Rotation.identity(len(time)))
    stream = Stream()
    view._log_path(stream, "world/track", path, (0, 0, 0))
    assert [len(strip) for strip in stream.strips] == [(time < 5.0).sum(), (time > 9.0).sum()]
