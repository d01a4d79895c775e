from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from support import CONFIG, GRAPH, ate, broken, samples, stream, stream_deviation

from stario.fusion import Navigator
from stario.sequences import ImuSequence, InputError, align


def with_bad_samples(walk: ImuSequence) -> tuple[ImuSequence, list[int]]:
    """Return the walk with bad samples, and their rows: 33 are not finite, 3 come too late."""
    time, gyro, accel = walk.time.copy(), walk.gyro.copy(), walk.accel.copy()
    gyro[200:230, 1], gyro[400], accel[700], time[500] = np.nan, 1e300, np.inf, np.nan
    time[900], time[1100], time[1101] = time[899], time[1000], time[1000]
    rows = [*range(200, 230), 400, 500, 700, 900, 1100, 1101]
    return replace(walk, time=time, gyro=gyro, accel=accel), rows


def test_bad_samples_do_not_affect_the_rest(walk, still_model, without):
    bad, rows = with_bad_samples(walk)
    good = without(walk, np.isin(np.arange(len(walk)), rows))
    ours, theirs = (Navigator(still_model).run(each).arrays() for each in (bad, good))
    for name, values in theirs.items():
        np.testing.assert_allclose(ours[name], values, rtol=0.0, atol=1e-9, err_msg=name)


def test_health_counts_bad_samples_gaps_and_updates(walk, make_oracle):
    bad, rows = with_bad_samples(walk)
    oracle = make_oracle(bad, walk.truth, CONFIG)
    track = Navigator(oracle, backend="ekf").run(bad)
    health = track.health
    bad_samples = {"not_finite": 33, "frozen": 0, "duplicate": 1, "out_of_order": 2, "future": 0}
    assert health.samples == {"used": len(walk) - len(rows), **bad_samples}
    ((start, length),) = health.gaps
    assert start == pytest.approx(walk.time[199])
    assert length == pytest.approx(walk.time[230] - walk.time[199])
    assert health.updates == len(track.innovations.time)
    assert health.refused == {}
    assert health.gated == int(track.innovations.gated.sum())
    assert health.mean_nis == pytest.approx(track.innovations.nis.mean())
    P = track.covariance[-1]
    directions = np.linspace(0.0, np.pi, 1000)
    u = np.stack([np.cos(directions), np.sin(directions)])  # any axes W may have
    largest = np.sqrt(np.einsum("in,ij,jn->n", u, P[6:8, 6:8], u).max())
    assert health.final_sigma["position_m"] == pytest.approx(largest, rel=1e-4)
    assert health.final_sigma["height_m"] == pytest.approx(np.sqrt(P[8, 8]))
    assert all("\n" not in line for line in health.lines())


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (lambda time: 1e3 * time, "give times in s"),
        (lambda time: 1.7e18 + 1e9 * time, "give times in s"),
        (lambda time: 100.0 * time, "give times in s"),
        (lambda time: (time + 1.7e9).astype(np.float32), "64 bits"),  # in which they repeat
        (lambda time: 0.4 * (time // 0.4) + 1e-3 * (time % 0.4), "space their samples evenly"),
    ],
)
def test_a_stream_whose_times_are_not_in_seconds_is_refused(walk, still_model, change, remedy):
    navigator = Navigator(still_model, CONFIG)
    with pytest.raises(InputError, match=f"^time.*{remedy}"):
        stream(navigator, replace(walk, time=change(walk.time)))
    assert navigator.state is None


@pytest.mark.parametrize(
    ("mean", "variance", "reason"),
    [
        (np.nan, 1e-4, "value that is not finite"),
        (0.0, np.inf, "value that is not finite"),
        (0.0, -1.0, "covariance not positive definite"),
    ],
)
def test_invalid_predictions_are_refused_and_counted(walk, make_oracle, mean, variance, reason):
    model = broken(make_oracle(walk, walk.truth, CONFIG), mean, variance)
    track = Navigator(model, backend="ekf").run(walk)
    assert track.health.refused == {reason: track.health.updates // 3}
    assert ate(track, walk) < 0.3


@pytest.mark.parametrize(
    ("backend", "config", "metres", "sigma"),
    [("ekf", CONFIG, 5.0, 0.02), ("graph", GRAPH, 2.0, 0.05)],
)
def test_a_gate_makes_outliers_less_harmful(walk, make_oracle, backend, config, metres, sigma):
    open_gate = replace(config, filter=replace(config.filter, gate=1.0 - 1e-16))
    tracks = []
    for each in (config, open_gate):
        model = broken(make_oracle(walk, walk.truth, each, sigma=sigma), metres, sigma**2)
        tracks.append(Navigator(model, each, backend=backend).run(walk))
    gated, taken = tracks
    assert 0.5 * gated.health.updates / 3 < gated.health.gated
    assert ate(gated, walk) < (0.5 if backend == "ekf" else 0.6) * ate(taken, walk)


def test_after_a_gap_speed_recovers_and_sigma_covers_the_error(make_walk, make_oracle, without):
    length, covered, speed_errors = 3.0, [], []
    for seed in range(2):
        walk = make_walk(seed, 20.0, 50.0)
        holed = without(walk, (walk.time > 8.0) & (walk.time < 8.0 + length))
        track = Navigator(make_oracle(holed, walk.truth, CONFIG), CONFIG, backend="ekf").run(holed)
        assert track.time[~track.trajectory.valid] == pytest.approx([8.0 + length], abs=0.03)
        assert track.health.gaps[0][1] == pytest.approx(length, abs=0.03)
        truth = walk.truth.at(np.clip(track.time, 0.0, walk.time[-1]))
        aligned = align(track.trajectory, walk.truth, "first")
        error = aligned.position_W - truth.position_W
        late = track.time > 8.0 + length + 4.0
        sigma = np.sqrt(np.trace(track.covariance[late, 6:9, 6:9], axis1=1, axis2=2))
        covered.append(np.linalg.norm(error[late], axis=1) / sigma)
        # The turn within the gap is unobservable: the speed recovers, the direction does not.
        velocities = (v[late, :2] for v in (aligned.velocity_W, truth.velocity_W))
        speed, true_speed = (np.linalg.norm(v, axis=1) for v in velocities)
        speed_errors.append(np.abs(speed - true_speed).mean())
        rows = np.searchsorted(track.time, 8.0) - 1, -1
        before, after = (np.sqrt(np.trace(track.covariance[k, 6:9, 6:9])) for k in rows)
        assert after > before
    assert np.max(np.mean(covered, axis=1)) < 2.0
    assert np.max(speed_errors) < 0.25


@pytest.mark.parametrize(
    ("gone", "words"),
    [
        (lambda time: time > 0.0, "at least"),
        (lambda time: time > 0.9, "at least"),
        (lambda time: time > 1.4, "at least"),
        (lambda time: time % 0.9 > 0.7, "unbroken stretch"),
    ],
)
def test_a_recording_without_a_whole_window_is_refused(walk, still_model, without, gone, words):
    with pytest.raises(InputError, match=f"{walk.name}.*{words}"):
        Navigator(still_model, backend="ekf").run(without(walk, gone(walk.time)))


@pytest.mark.parametrize("vector", [3.0, "abc", (1, 2, None), pd.DataFrame([[0.0, 0.0, 9.8]])])
def test_a_sample_that_is_not_a_vector_is_refused_by_name(still_model, vector):
    navigator = Navigator(still_model)
    with pytest.raises(InputError, match=r"^gyro: found "):
        navigator.push(0.0, vector, (0.0, 0.0, 9.8))
    with pytest.raises(InputError, match=r"^accel: found "):
        navigator.push(0.0, (0.0, 0.0, 0.0), vector)
    navigator.push(0.0, (0.0, 0.0, 0.0), pd.Series([0.0, 0.0, 9.8]))


@pytest.mark.parametrize("time", ["0.0", None, (1.0, 2.0), 10**400])
def test_a_time_that_is_not_a_number_is_refused_by_name(still_model, time):
    with pytest.raises(InputError, match=r"^time.*a number"):
        Navigator(still_model).push(time, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))


def test_in_its_first_second_a_stream_has_a_health_report_but_no_state(walk, still_model):
    navigator = Navigator(still_model)
    assert stream(navigator, walk.slice(0.0, 0.5)) == []
    assert navigator.state is None
    assert navigator.health.samples["used"] == 51
    assert navigator.health.lines()


@pytest.mark.parametrize(
    ("rows", "wild"),
    [
        ([1000, 1050, 1100, 1300, 1301, 1302], 1e9),  # far ahead, several in a row as well
        ([1000, 1050, 1100], 2.0),
        ([0, 7], 1e9),
        ([0, 7], 5.0),
    ],
)
def test_wild_timestamps_do_not_block_a_stream(walk, make_oracle, without, rows, wild):
    walk = walk.slice(0.0, 15.0)
    jumped = np.isin(np.arange(len(walk)), rows)
    expected = without(walk, jumped)
    oracle = make_oracle(expected, walk.truth, CONFIG)
    navigator = Navigator(oracle)
    states = stream(navigator, replace(walk, time=walk.time + wild * jumped))
    assert stream_deviation(states, Navigator(oracle, backend="ekf").run(expected)) < 1e-9
    assert navigator.health.samples["future"] == len(rows)
    assert navigator.health.samples["out_of_order"] == 0
    assert navigator.health.gaps == []


def turned_over(walk: ImuSequence, late: np.ndarray) -> ImuSequence:
    """Return a walk whose device is turned over before its `late` samples."""
    turn = Rotation.from_rotvec([1.5, 1.0, -0.5])
    gyro, accel = walk.gyro.copy(), walk.accel.copy()
    gyro[late], accel[late] = turn.apply(gyro[late]), turn.apply(accel[late])
    before, after = (walk.truth.attitude_WB[rows] for rows in (~late, late))
    attitude = [*before, *(after * turn.inv())]
    truth = replace(walk.truth, attitude_WB=Rotation.concatenate(attitude))
    return replace(walk, gyro=gyro, accel=accel, truth=truth)


def test_after_a_long_gap_the_navigator_restarts_where_it_was(walk, make_oracle):
    """The device is turned over in the gap: the first second after it determines the tilt again."""
    walk, seconds = walk.slice(0.0, 17.0), 1e6
    late = walk.time > 10.0
    turned, time = turned_over(walk, late), walk.time + seconds * late
    truth = replace(turned.truth, time=time)
    broken = replace(turned, time=time, truth=truth)
    oracle = make_oracle(broken, truth, CONFIG)
    navigator = Navigator(oracle, CONFIG)
    track = Navigator(oracle, CONFIG, backend="ekf").run(broken)
    assert stream_deviation(stream(navigator, broken), track) < 1e-9
    assert track.health.gaps == [(pytest.approx(10.0), pytest.approx(seconds + 0.01, rel=1e-6))]
    after = track.time > 10.0 + seconds + 4.0
    ours, theirs = track.trajectory, truth.at(track.time)
    speed, true_speed = (np.linalg.norm(t.velocity_W[after, :2], axis=1) for t in (ours, theirs))
    assert np.abs(speed - true_speed).mean() < 0.25
    up, true_up = (t.attitude_WB[after].inv().apply([0.0, 0.0, 1.0]) for t in (ours, theirs))
    assert np.degrees(np.linalg.norm(up - true_up, axis=1)).mean() < 4.0
    sigma = np.sqrt(np.diag(track.covariance[-1]))
    assert sigma[2] > 1.0
    assert sigma[6] > 9e3
    assert np.isfinite(track.covariance).all()


@pytest.mark.parametrize(("backend", "seconds"), [("ekf", 5.0), ("graph", 0.3)])
def test_a_device_turned_over_in_a_gap_does_not_run_away(walk, make_oracle, backend, seconds):
    """As in a swinging hand: with its old tilt, gravity would be taken for motion."""
    gap = (walk.time > 10.0) & (walk.time < 10.0 + seconds)
    turned, late = turned_over(walk, walk.time > 10.0), walk.time[~gap]
    holed = replace(turned, time=late, gyro=turned.gyro[~gap], accel=turned.accel[~gap])
    oracle = make_oracle(holed, turned.truth, CONFIG)
    track = Navigator(oracle, CONFIG, backend=backend).run(holed)
    after = (track.time > 10.0 + seconds + 0.1) & (track.time < walk.time[-1])
    truth = turned.truth.at(track.time[after])
    speed = np.linalg.norm(track.trajectory.velocity_W[after], axis=1)
    assert speed.max() < 2.0 + np.linalg.norm(truth.velocity_W, axis=1).max()
    attitudes = track.trajectory.attitude_WB[after], truth.attitude_WB
    up, true_up = (attitude.inv().apply([0.0, 0.0, 1.0]) for attitude in attitudes)
    assert np.degrees(np.linalg.norm(up - true_up, axis=1)).mean() < 4.0
    assert np.nanmean(track.innovations.nis[track.innovations.time > 10.0]) < 6.0


def test_spikes_are_replaced_and_counted(walk, make_oracle):
    walk = walk.slice(0.0, 13.0)
    gyro, accel = walk.gyro.copy(), walk.accel.copy()
    gyro[405, 0] += 300.0
    gyro[800, 2] -= 50.0  # at an interval's end
    accel[1203] += 500.0
    spiky = replace(walk, gyro=gyro, accel=accel)
    oracle = make_oracle(spiky, walk.truth, CONFIG)
    graph = Navigator(oracle, CONFIG).run(spiky)
    # The batch graph also uses later data.
    for backend, track, most in (("ekf", graph.filtered, 1e-9), ("graph", graph, 0.3)):
        navigator = Navigator(oracle, CONFIG, backend=backend)
        assert stream_deviation(stream(navigator, spiky), track) < most
        assert navigator.health.flagged == track.health.flagged
        assert track.health.flagged == {"spike": 3, "saturated": 0}
        assert track.health.samples["used"] == len(walk)
        assert ate(track, walk) < 0.3
        assert any("spike 3" in line for line in track.health.lines())


def test_a_clipped_sensor_is_flagged_and_trusted_less(walk, make_oracle):
    walk = walk.slice(0.0, 10.0)
    limit = float(np.quantile(np.abs(walk.accel).max(axis=1), 0.9))
    clipped = replace(walk, accel=np.clip(walk.accel, -limit, limit))
    stuck = (np.abs(clipped.accel[1:]) == limit) & (clipped.accel[1:] == clipped.accel[:-1])
    tracks = []
    for each in (clipped, walk):
        oracle = make_oracle(each, walk.truth, CONFIG)
        tracks.append(Navigator(oracle, CONFIG).run(each))
    graph, whole_graph = tracks
    for track, whole in ((graph, whole_graph), (graph.filtered, whole_graph.filtered)):
        assert 0.3 * stuck.sum() < track.health.flagged["saturated"] <= stuck.sum()
        assert whole.health.flagged == {"spike": 0, "saturated": 0}
        assert np.trace(track.covariance[-1, 3:6, 3:6]) > np.trace(whole.covariance[-1, 3:6, 3:6])
        assert ate(track, walk) < ate(whole, walk) + 0.2


def test_a_network_that_claims_to_be_exact_is_not_trusted(walk, make_oracle):
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.01, sigma=1e-9)
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk)
    assert np.isfinite(track.covariance).all()
    assert np.sqrt(track.covariance[-1, 6, 6]) > 5e-3
    assert ate(track, walk) < 0.3


def test_a_dead_axis_is_logged_once_per_run(walk, still_model, caplog):
    Navigator(still_model, backend="ekf").run(replace(walk, gyro=walk.gyro * [1.0, 1.0, 0.0]))
    assert caplog.text.count("its z axis never changes") == 1


class Failing:
    def __init__(self, inner: Any, at: set[int]) -> None:
        self.inner, self.at, self.calls = inner, at, 0

    def predict(self, windows: Any) -> Any:
        self.calls += 1
        if self.calls in self.at:
            raise RuntimeError("out of memory")
        return self.inner.predict(windows)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_stream_continues_after_its_network_has_failed(walk, make_oracle, backend):
    walk = walk.slice(0.0, 13.0)
    oracle = make_oracle(walk, walk.truth, GRAPH)
    expected = {state.time: state.p_W for state in stream(Navigator(oracle, GRAPH), walk)}
    navigator = Navigator(Failing(oracle, {5, 6, 20}), GRAPH, backend=backend)
    states, failures = [], 0
    for sample in samples(walk):
        try:
            states.append(navigator.push(*sample))
        except RuntimeError:
            failures += 1
    assert failures == 3
    errors = [np.linalg.norm(s.p_W - expected[s.time]) for s in states if s is not None]
    assert len(errors) == len(expected) - 3
    assert max(errors) < 0.1


def test_no_motion_is_lost_if_the_network_fails_within_a_hole(walk, make_oracle, without):
    """The sample after a bridged hole completes two intervals, the first of which fails here."""
    config = replace(GRAPH, filter=replace(GRAPH.filter, update_rate=10))
    walk = walk.slice(0.0, 12.0)
    holed = without(walk, (walk.time > 10.055) & (walk.time < 10.205))
    rows = list(samples(holed))
    oracle = make_oracle(holed, walk.truth, config)
    whole = Navigator(Failing(oracle, set()), config)
    calls = []
    for row in rows:
        calls.append(whole.model.calls)
        whole.push(*row)
    (k,) = np.flatnonzero(np.diff(calls) == 2)
    navigator = Navigator(Failing(oracle, {calls[k] + 1}), config)
    for row in rows[:k]:
        navigator.push(*row)
    with pytest.raises(RuntimeError, match="memory"):
        navigator.push(*rows[k])
    for row in rows[k + 1 :]:
        navigator.push(*row)
    assert navigator.model.calls == whole.model.calls
    assert navigator.state.time == whole.state.time
    assert np.linalg.norm(navigator.state.p_W - whole.state.p_W) < 0.01


def zeros(count: int) -> np.ndarray:
    return np.zeros((count, 3))


def variances(count: int) -> np.ndarray:
    return np.tile(0.01 * np.eye(3), (count, 1, 1))


def custom(predict: Any) -> Any:
    """A network of a function of the number of windows."""
    return SimpleNamespace(predict=lambda windows: predict(len(windows)))


@pytest.mark.parametrize(
    ("predict", "named"),
    [
        (lambda n: None, "NoneType"),
        (lambda n: zeros(n), "ndarray"),
        (lambda n: (zeros(n), 0.01 * np.ones((n, 3))), "covariances"),
        (lambda n: (zeros(n)[:, :2], variances(n)), "displacements"),
        (lambda n: (zeros(1), variances(1)), "shapes"),  # would be every window's
        (lambda n: (zeros(n), variances(n) + np.triu(np.ones((3, 3)), 1)), "asymmetric"),
    ],
)
def test_predictions_of_other_shapes_are_refused(walk, predict, named):
    with pytest.raises(InputError, match=f"model.*{named}"):
        Navigator(custom(predict), backend="ekf").run(walk.slice(0.0, 4.0))


def test_predictions_may_be_lists(walk):
    model = custom(lambda n: (zeros(n).tolist(), variances(n).tolist()))
    assert Navigator(model, backend="ekf").run(walk.slice(0.0, 4.0)).health.updates > 0
