import itertools
from dataclasses import replace

import numpy as np
import pytest
from recorded import DATA
from support import lying

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, PriorPose, Track
from stario.fusion.filter.zero_velocity import Stillness
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.recording import cut_recording
from stario.network import load_model
from stario.sequences import PHONE_IMU, ImuSequence, read_recording
from stario.sequences.attitude.so3 import exp_so3

CONFIG = NavigatorConfig()
NO_STILLNESS = replace(CONFIG, filter=replace(CONFIG.filter, stillness_noise=0.0))
BIAS = np.array([2e-3, -1e-3, 1.5e-3])


def on_table(seconds: float, rate=100.0, turn=0.0, bias=BIAS) -> ImuSequence:
    """A phone that lies on a table, or turns about the vertical at the rate `turn` [rad/s]."""
    noise, density = PHONE_IMU.noise, np.sqrt(rate)
    gyro = np.add(bias, [0.0, 0.0, turn])
    return lying(seconds, rate, gyro, density * noise.gyro_noise, density * noise.accel_noise)


def at_rest(intervals: list[ImuInterval]) -> list[bool]:
    states = itertools.accumulate(
        intervals, lambda state, each: state.after(each, CONFIG.filter), initial=Stillness()
    )
    return [state.rested > 0 for state in states][1:]


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_a_device_on_a_table_is_at_rest_after_a_second(rate):
    intervals, _ = cut_recording(on_table(5.0, rate), CONFIG)
    assert np.mean(at_rest(intervals)) == pytest.approx(41 / 50, abs=0.05)


@pytest.mark.parametrize("carry", ["handheld", "pocket", "trolley"])
def test_a_moving_device_is_not_at_rest(make_walk, carry):
    walk = make_walk(5, 20.0, 100.0, PHONE_IMU, carry=carry)
    intervals, _ = cut_recording(walk, CONFIG)
    still = np.array([e.stop for e in intervals])[at_rest(intervals)]
    if len(still):
        moved = walk.truth.at(still).position_W - walk.truth.at(still - 1.0).position_W
        assert np.linalg.norm(moved, axis=1).max() < 0.1  # a simulated trolley creeps smoothly


def test_rest_needs_a_whole_second_and_a_gap_ends_it():
    intervals, front_end = cut_recording(on_table(6.0), CONFIG)
    intervals[30] = replace(intervals[30], levelled=front_end.start)
    found = at_rest(intervals)
    assert not any(found[:9])
    assert all(found[9:30])
    assert not any(found[30:40])
    assert all(found[40:])


def yaw_drift(track: Track) -> float:
    turn = track.trajectory.attitude_WB[0].inv() * track.trajectory.attitude_WB[-1]
    return float(turn.magnitude())


def test_rest_measures_the_bias_and_holds_yaw_and_position(still_model):
    table = on_table(30.0, 50.0)
    with_zero_velocity = Navigator(still_model, CONFIG, backend="ekf").run(table)
    without = Navigator(still_model, NO_STILLNESS, backend="ekf").run(table)
    assert with_zero_velocity.health.zero_velocity == {"applied": 291}
    assert without.health.zero_velocity == {}
    np.testing.assert_allclose(with_zero_velocity.b_g[-1], BIAS, atol=1e-4)
    assert yaw_drift(with_zero_velocity) < 0.2 * yaw_drift(without)
    assert np.linalg.norm(with_zero_velocity.trajectory.velocity_W[-1]) < 0.01
    assert np.linalg.norm(with_zero_velocity.trajectory.position_W[-1]) < 0.05
    sigma = np.sqrt(np.diag(with_zero_velocity.covariance[-1]))
    assert (np.abs(with_zero_velocity.b_g[-1] - BIAS) < 3.0 * sigma[9:12]).all()
    assert sigma[11] < 0.3 * np.sqrt(without.covariance[-1, 11, 11])


def test_a_device_at_rest_does_not_drift_with_the_predictions():
    """Trained on walks, the network predicts a centimetre per second on a table."""
    graph = Navigator(load_model(), CONFIG).run(on_table(30.0, 50.0))
    for track in (graph, graph.filtered):
        assert np.linalg.norm(track.trajectory.position_W[-1]) < 0.05
        error, P = track.trajectory.position_W[-1], track.covariance[-1, 6:9, 6:9]
        assert error @ np.linalg.solve(P, error) < 12.0


@pytest.mark.parametrize("seconds", [5.0, 20.0])
def test_a_standing_person_who_sways_teaches_no_bias(still_model, seconds):
    """On a table the gyroscope reads its bias; a person turns it to and fro by 1.5 deg/s."""
    table = on_table(40.0, 50.0, bias=np.zeros(3))
    sway = np.radians(1.5) * np.sin(2.0 * np.pi / seconds * table.time)
    swaying = replace(table, gyro=table.gyro + np.outer(sway, [0.0, 0.0, 1.0]))
    track = Navigator(still_model, CONFIG, backend="ekf").run(swaying)
    assert track.health.zero_velocity["applied"] > 5
    assert np.abs(track.b_g[:, 2]).max() < 2e-3


def test_rest_gives_no_information_about_yaw(still_model):
    prior = PriorPose(exp_so3(np.array([0.0, 0.0, 1.0])), np.zeros(3), np.zeros(3), yaw_sigma=0.3)
    track = Navigator(still_model, CONFIG, prior, backend="ekf").run(on_table(10.0))
    assert np.sqrt(track.covariance[-1, 2, 2]) > 0.3


def test_a_steady_glide_is_not_stopped(still_model):
    """With no vibration and an uninformative network, the filter's own speed decides."""
    fast = PriorPose(np.eye(3), np.array([1.5, 0.0, 0.0]), np.zeros(3), 1e-3, 0.02, 0.05)
    quiet = replace(CONFIG.filter, accel_bias_sigma=0.02)
    config = replace(CONFIG, noise=PHONE_IMU.noise, filter=quiet)
    track = Navigator(still_model, config, fast, backend="ekf").run(on_table(3.0, bias=np.zeros(3)))
    assert track.health.zero_velocity == {"gated": 21}
    assert track.trajectory.velocity_W[-1, 0] > 1.2


def test_a_slow_turn_is_not_mistaken_for_bias(still_model):
    """Unless it lasts for longer than anybody turns so evenly."""
    turning = on_table(3.0, turn=0.05, bias=np.zeros(3))
    track = Navigator(still_model, CONFIG, backend="ekf").run(turning)
    assert np.abs(track.b_g[-1]).max() < 0.01


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}")
@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("oxiod/trolley/data2/syn/imu4.csv", True),
        ("oxiod/handheld/data1/syn/imu7.csv", False),
        ("tumvi/dataset-room1_512_16", False),
    ],
)
def test_rest_is_detected_only_where_the_ground_truth_rests(name, found):
    if not (DATA / name).exists():
        pytest.skip(f"no {name} at {DATA}")
    recording = read_recording(DATA / name)
    start = recording.time[0]
    recording = recording.slice(start, start + 40.0)
    intervals, _ = cut_recording(recording, NavigatorConfig(filter=FilterConfig()))
    still = np.array([e.stop for e in intervals])[at_rest(intervals)]
    assert (len(still) > 10) == found
    if not found:
        return
    before, now = recording.truth.at(still - 1.0), recording.truth.at(still)
    known = before.valid & now.valid
    assert known.any()
    assert np.linalg.norm((now.position_W - before.position_W)[known], axis=1).max() < 0.02
