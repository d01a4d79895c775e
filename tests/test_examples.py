"""Every example runs and returns what it says."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np

from stario.network import load_model

FOLDER = Path(__file__).resolve().parents[1] / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"examples_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested_here():
    tested = {
        "run_recording",
        "compare_tracks",
        "streaming",
        "train_own",
        "cluster",
        "replay_live",
        "fine_tune",
    }
    assert {p.stem for p in FOLDER.glob("*.py")} == tested


def test_run_recording_gives_a_finite_track_without_truth():
    track = load("run_recording").main()
    assert np.isfinite(track.trajectory.position_W).all()
    assert track.time[-1] - track.time[0] > 100.0


def test_compare_tracks_ranks_the_filter_above_the_imu_alone():
    comparison = load("compare_tracks").main(seconds=30.0)
    ate = {name: metrics["ate_m"] for name, metrics in comparison.metrics.items()}
    assert ate["ekf"] < 1.1 * ate["network"] < 5.0 < 100.0 < ate["inertial"]


def test_streaming_yields_states_ten_times_a_second():
    states = load("streaming").main(seconds=10.0)
    times = np.array([state.time for state in states])
    assert len(states) > 40
    np.testing.assert_allclose(np.diff(times), np.diff(times)[0], atol=1e-6)


def test_train_own_leaves_weights_that_predict(tmp_path):
    model = load("train_own").main(tmp_path, epochs=1)
    mean, covariance = model.predict(np.zeros((2, 6, 200)))
    assert mean.shape == (2, 3)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_fine_tune_learns_from_waypoints_and_keeps_the_calibration(tmp_path):
    model = load("fine_tune").main(tmp_path)
    assert model.card.calibration == load_model("default").card.calibration
    mean, _ = model.predict(np.zeros((1, 6, 200)))
    assert np.isfinite(mean).all()


def test_cluster_shares_recordings_between_its_workers_and_goes_on_past_a_broken_one(tmp_path):
    scores, skipped, workers = load("cluster").main(tmp_path, seconds=8.0)
    assert [recording.name for recording in scores] == ["walk-0", "walk-1", "walk-3"]
    for recording in scores:
        assert recording.metrics["ekf"]["ate_m"] > 0.0
    assert [one.item for one in skipped] == [str(tmp_path / "walk-2.csv")]
    assert "line 2" in skipped[0].reason
    assert len(workers) == 2


def test_replay_live_ends_where_a_run_on_the_recording_it_left_does():
    from stario.fusion import Navigator
    from stario.network import load_model
    from stario.sequences import read_recording

    taken, end, path = load("replay_live").main(speed=20.0, seconds=6.0)
    recording = read_recording(path)
    assert taken == len(recording) == 1200
    track = Navigator(load_model("default")).run(recording)
    np.testing.assert_allclose(track.trajectory.position_W[-1], end, atol=1e-4)
