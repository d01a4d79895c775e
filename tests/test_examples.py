import importlib.util
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from recorded import DATA
from training_runs import narrow

from stario.fusion import Navigator, demonstration
from stario.network import load_model
from stario.sequences import InputError, read_recording

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"examples_{name}", FOLDER / f"{name}.py")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested_here():
    tested = re.findall(r'load\("(\w+)"\)', Path(__file__).read_text())
    assert {p.stem for p in FOLDER.glob("*.py")} == set(tested)


def test_run_recording_gives_a_finite_track_without_truth():
    example = load("run_recording")
    example.demonstration = lambda: demonstration().slice(0.0, 30.0)
    track = example.main()
    assert np.isfinite(track.trajectory.position_W).all()
    assert track.time[-1] - track.time[0] > 28.0


def test_compare_tracks_ranks_the_filter_above_the_imu_alone():
    comparison = load("compare_tracks").main(seconds=30.0)
    ate = {name: metrics["ate_m"] for name, metrics in comparison.metrics.items()}
    assert ate["track"] < 1.25 * ate["network"] < 5.0 < 50.0 < ate["dead_reckoning"]


def test_a_stride_is_measured_in_a_walk():
    stride = load("measure_strides").main(seconds=40.0)
    assert 1.6 < stride.step_rate < 2.2
    assert 0.8 < stride.speed < 1.5


def test_streaming_yields_states_ten_times_a_second():
    states = load("streaming").main(seconds=10.0)
    times = np.array([state.time for state in states])
    assert len(states) > 40
    np.testing.assert_allclose(np.diff(times), np.diff(times)[0], atol=1e-6)


@pytest.mark.slow
def test_train_own_produces_a_model_that_predicts(tmp_path, monkeypatch):
    narrow(monkeypatch)
    model = load("train_own").main(tmp_path, epochs=1)
    mean, covariance = model.predict(np.zeros((2, 6, 200)))
    assert mean.shape == (2, 3)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


@pytest.mark.slow
def test_live_latency_receives_positions_within_a_second(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    measured = load("live_latency").main(phones=2, seconds=3.0)
    assert len(measured.latencies) >= 8  # two seconds of events after the first window
    assert 0.0 < min(measured.latencies) < 1.0
    assert measured.memory_mb > 50.0


@pytest.mark.slow
def test_fine_tune_learns_from_waypoints_and_keeps_the_calibration(tmp_path):
    model = load("fine_tune").main(tmp_path)
    assert model.card.calibration == load_model("default").card.calibration
    mean, _ = model.predict(np.zeros((1, 6, 200)))
    assert np.isfinite(mean).all()


@pytest.mark.slow
@pytest.mark.parametrize("processes", [False, True], ids=["threads", "processes"])
def test_cluster_distributes_recordings_among_workers_and_skips_a_broken_one(processes, tmp_path):
    """Processes, as in the example itself, take seconds to start."""
    example = load("cluster")
    example.LocalCluster = partial(example.LocalCluster, processes=processes)
    scores, skipped, workers = example.main(tmp_path, seconds=8.0)
    of_track = scores[scores["track"] == "track"]
    assert of_track["recording"].to_list() == ["walk-0", "walk-1", "walk-3"]
    assert (of_track["ate_m"] > 0.0).all()
    assert [entry.item for entry in skipped] == [str(tmp_path / "walk-2.csv")]
    assert "line 2" in skipped[0].reason
    assert len(workers) == 2


def test_replay_live_ends_where_a_run_on_the_saved_recording_ends():
    sample_count, end, path = load("replay_live").main(demonstration(), speed=20.0, seconds=6.0)
    recording = read_recording(path)
    assert sample_count == len(recording) == 1200
    track = Navigator(load_model("default"), backend="ekf").run(recording)
    np.testing.assert_allclose(track.trajectory.position_W[-1], end, atol=1e-4)


def check_odometry(outputs, largest_step=0.3):
    """REP 105: odom is continuous, its stamps increase and its covariances are valid."""
    position = np.array([o.odom_base.p for o in outputs])
    stamps = np.array([o.stamp_ns for o in outputs])
    assert (np.diff(stamps) > 0).all()
    assert np.isfinite(position).all()
    assert np.linalg.norm(np.diff(position, axis=0), axis=1).max() < largest_step
    for o in outputs[::20]:
        np.testing.assert_allclose(np.linalg.norm(o.odom_base.R.as_quat()), 1.0)
        for covariance in (o.pose_covariance, o.twist_covariance):
            assert (np.linalg.eigvalsh(0.5 * (covariance + covariance.T)) > -1e-9).all()


def fix_at(stamp_ns, xyz, sigma):
    position = SimpleNamespace(x=xyz[0], y=xyz[1], z=xyz[2])
    pose = SimpleNamespace(
        pose=SimpleNamespace(position=position), covariance=(sigma**2 * np.eye(6)).ravel().tolist()
    )
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), pose=pose)


def test_ros2_node_keeps_odom_continuous_and_corrects_map_to_odom_by_fixes():
    example = load("ros2_node")
    check_odometry(example.main(seconds=6.0))
    bridge = example.OdometryBridge(Navigator(load_model("default")))
    outputs = []
    for message in example.demonstration_messages(8.0):
        output = bridge.imu(message)
        if output is None:
            continue
        outputs.append(output)
        if len(outputs) in (20, 60):
            measured = np.array([100.0, 50.0, 0.0]) + 2.0 * output.odom_base.p[[1, 0, 2]]
            bridge.fix(fix_at(output.stamp_ns, measured, 0.05))
    # Although the map was moved by a hundred metres and then turned. The second fix contradicts the
    # walk, so the velocity that propagates odom changes as well.
    check_odometry(outputs, largest_step=0.5)
    assert np.linalg.norm(outputs[-1].map_odom.p) > 50.0
    state = bridge._navigator.state
    in_map = outputs[-1].map_odom @ outputs[-1].odom_base
    np.testing.assert_allclose(in_map.p, state.p_W, atol=1e-6)
    np.testing.assert_allclose(in_map.R.as_matrix(), state.R_WB, atol=1e-6)
    up = outputs[-1].map_odom.R.apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-9)


def test_ros2_node_passes_the_magnetic_field_on_in_microtesla():
    example = load("ros2_node")
    navigator, expected = (Navigator(load_model("default")) for _ in range(2))
    bridge, walk = example.OdometryBridge(navigator), demonstration()
    fields_uT = walk.truth.at(walk.time).attitude_WB.inv().apply([0.0, 20.0, -45.0])
    for k, message in enumerate(example.demonstration_messages(8.0)):
        if k % 4 == 0:
            x, y, z = 1e-6 * fields_uT[k]
            field = SimpleNamespace(x=x, y=y, z=z)
            bridge.field(SimpleNamespace(header=message.header, magnetic_field=field))
            if k > 0:  # the first field comes before the first sample, which sets the time
                expected.push_magnetometer(walk.time[k], fields_uT[k])
        bridge.imu(message)
        expected.push(walk.time[k], walk.gyro[k], walk.accel[k])
    assert navigator.health.bearings == expected.health.bearings
    assert navigator.health.bearings["applied"] > 5
    np.testing.assert_allclose(navigator.state.p_W, expected.state.p_W, atol=1e-6)


def test_ros2_node_follows_a_map_moved_by_a_fix_at_the_current_time():
    """The fix waits for the sample of its time and is applied between two odometry outputs."""
    example = load("ros2_node")
    bridge = example.OdometryBridge(Navigator(load_model("default")))
    outputs = []
    for message in example.demonstration_messages(8.0):
        output = bridge.imu(message)
        outputs += [] if output is None else [output]
        if output is not None and len(outputs) in (20, 60):
            measured = np.array([1e5, 5e6, 0.0]) + 2.0 * output.odom_base.p[[1, 0, 2]]
            bridge.fix(fix_at(output.stamp_ns + 30_000_000, measured, 0.05))
    assert np.linalg.norm(outputs[-1].map_odom.p) > 4e6
    check_odometry(outputs, largest_step=0.5)


def test_ros2_node_starts_odom_again_after_its_clock_was_set_back():
    """As when a bag is played again, after a fix has moved the map."""
    example = load("ros2_node")
    bridge = example.OdometryBridge(Navigator(load_model("default")))
    for message in example.demonstration_messages(6.0):
        bridge.imu(message)
    stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    bridge.fix(fix_at(stamp_ns, (500.0, -200.0, 3.0), 0.3))
    errors, again = [], []
    for message in example.demonstration_messages(14.0):
        message.header.stamp.sec -= 100
        try:
            odometry = bridge.imu(message)
        except InputError as error:
            errors.append(str(error))
        else:
            again += [] if odometry is None else [odometry]
    assert len(errors) == 1
    assert "set back" in errors[0]
    assert np.linalg.norm(again[0].odom_base.p) < 1.0
    check_odometry(again)


BAGS = sorted(DATA.glob("raw/rosbag/*.bag"))


@pytest.mark.skipif(not BAGS, reason="the data folder holds no recorded bags")
@pytest.mark.parametrize(
    "bag",
    [
        pytest.param(bag, id=bag.stem, marks=pytest.mark.slow if "upside_down" in bag.stem else ())
        for bag in BAGS
    ],
)
def test_ros2_node_runs_on_recorded_bags(bag):
    pytest.importorskip("rosbags", reason="pip install '.[bags]'")
    outputs = load("ros2_node").main(bag)
    assert len(outputs) > 20
    # Shaking saturates the razor's accelerometer: no track can be computed from it.
    check_odometry(outputs, np.inf if "razor" in bag.stem else 0.3)


@pytest.mark.parametrize(
    ("command", "found"),
    [
        ("run_recording.py absent.csv", "absent.csv: path: found no such file"),
        ("replay_live.py absent.csv", "absent.csv: path: found no such file"),
        ("replay_live.py --speed 0", "--speed: found 0, expected more"),
        ("ros2_node.py absent.bag", "absent.bag: path: found no such file"),
        ("measure_strides.py absent", "No such file"),
        ("live_latency.py --seconds -5", "--seconds: found -5, expected at least 3"),
        ("sets_left_out.py --data absent", "--data absent --jobs 1: expected a folder"),
        ("sets_left_out.py --data . --jobs -1", "--jobs -1: expected a folder, 1 or more"),
    ],
)
def test_what_an_example_cannot_use_is_told_in_one_line(command, found, tmp_path):
    name, *options = command.split()
    ran = subprocess.run(
        [sys.executable, FOLDER / name, *options], cwd=tmp_path, capture_output=True, text=True
    )
    assert ran.returncode == 2
    assert re.search(found, ran.stderr)
    assert ran.stderr.count("\n") == 1


def test_sets_left_out_says_what_it_needs(capsys, monkeypatch):
    monkeypatch.setenv("STARIO_DATA", "elsewhere")  # hours of training start on request only
    monkeypatch.setattr("sys.argv", ["sets_left_out.py"])
    load("sets_left_out").main()
    assert "--data FOLDER" in capsys.readouterr().out
