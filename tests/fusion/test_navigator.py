"""The navigator on simulated walks, with a predictor that knows the truth."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.fusion import Navigator, NavState, PriorPose, Track
from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.tracks import inertial_track
from stario.sequences.errors import InputError
from stario.sequences.metrics import align, evaluate_track, pose_errors, position_nees
from stario.sequences.noise import ImuNoise
from stario.sequences.rotations import about_z, yaw_of
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulate import PERFECT_IMU, ImuErrors

# Settings that fit the oracle and the simulated phone; the defaults fit networks and real ones.
FILTER = FilterConfig(
    update_rate=10,
    covariance_scale=1.0,
    gyro_bias_sigma=3e-3,
    accel_bias_sigma=0.05,
    accel_motion_noise=0.0,
)
NOISE = ImuNoise(gyro_noise=2e-3, accel_noise=0.1, gyro_walk=3e-5, accel_walk=1e-3)
CONFIG = NavigatorConfig(NOISE, FILTER)
VELOCITY = NavigatorConfig(NOISE, replace(FILTER, measurement="velocity"))

Make = Callable[..., Any]


def stream(navigator: Navigator, sequence: ImuSequence) -> list[NavState]:
    rows = zip(sequence.time, sequence.gyro, sequence.accel, strict=True)
    states = [navigator.push(*row) for row in rows]
    return [state for state in states if state is not None]


def streamed_off(states: list[NavState], track: Track) -> float:
    """Largest distance [m] between a stream's states and the track, at the stream's times."""
    rows = np.searchsorted(track.time, [s.time for s in states])
    np.testing.assert_array_equal(track.time[rows], [s.time for s in states])
    position = np.array([s.p_W for s in states])
    return float(np.linalg.norm(track.trajectory.position_W[rows] - position, axis=1).max())


def ate(track: Track, sequence: ImuSequence) -> float:
    return evaluate_track(track.trajectory, sequence.truth).ate_m


def final_error(track: Track, sequence: ImuSequence) -> float:
    error = pose_errors(align(track.trajectory, sequence.truth, "first"), sequence.truth)
    return float(np.linalg.norm(error.position_W[-1]))


@pytest.fixture(scope="module")
def track(walk: ImuSequence, make_oracle: Make) -> Track:
    return Navigator(make_oracle(walk, walk.truth, CONFIG)).run(walk)


# --- what it is good for ---------------------------------------------------------------------


@pytest.mark.parametrize("config", [CONFIG, VELOCITY], ids=["displacement", "velocity"])
@pytest.mark.parametrize("carry", ["handheld", "pocket"])
def test_error_stays_far_below_dead_reckonings(
    make_walk: Make, make_oracle: Make, config: NavigatorConfig, carry: str
) -> None:
    walk = make_walk(3, 30.0, carry=carry)
    navigator = Navigator(make_oracle(walk, walk.truth, config), config)
    observed = navigator.observe(walk)
    track = navigator.track(observed)
    alone = ate(inertial_track(observed, config), walk)
    assert ate(track, walk) < 0.6
    assert ate(track, walk) < 0.03 * alone


def test_attitude_and_speed_are_estimated_too(walk: ImuSequence, track: Track) -> None:
    aligned = align(track.trajectory, walk.truth, "first")
    errors = pose_errors(aligned, walk.truth)
    late = errors.estimate.time > 5.0
    off = errors.estimate.velocity_W - errors.truth.velocity_W
    assert np.linalg.norm(off[late], axis=1).mean() < 0.3
    turn = errors.estimate.attitude_WB * errors.truth.attitude_WB.inv()
    assert np.degrees(turn.magnitude()[late].mean()) < 3.0


@pytest.mark.parametrize("rate", [50.0, 200.0, 500.0, 1000.0])
def test_any_rate_of_the_imu_gives_the_same_walk(
    make_walk: Make, make_oracle: Make, rate: float
) -> None:
    walk = make_walk(4, 12.0, rate)
    assert ate(Navigator(make_oracle(walk, walk.truth, CONFIG)).run(walk), walk) < 0.2


@pytest.mark.parametrize("update_rate", [1, 5, 20])
def test_every_update_rate_follows_the_walk(
    walk: ImuSequence, make_oracle: Make, update_rate: int
) -> None:
    config = NavigatorConfig(filter=FilterConfig(update_rate=update_rate))
    track = Navigator(make_oracle(walk, walk.truth, config), config).run(walk)
    assert ate(track, walk) < 0.3
    np.testing.assert_allclose(np.diff(track.time), 1.0 / config.filter.output_rate, atol=1e-9)


def test_a_mean_velocity_is_brought_to_now_by_the_imu(make_walk: Make, make_oracle: Make) -> None:
    """A trunk bounces: its velocity now is not its mean over the second before."""
    walk = make_walk(3, 20.0, 200.0, PERFECT_IMU)
    track = Navigator(make_oracle(walk, walk.truth, VELOCITY), VELOCITY).run(walk)
    settled = track.innovations.time > 5.0
    off = np.linalg.norm(track.innovations.residual_W[settled], axis=1)
    truth = walk.truth.at(track.innovations.time[settled])
    before = walk.truth.at(track.innovations.time[settled] - 1.0)
    mean = truth.position_W - before.position_W
    uncorrected = np.linalg.norm(truth.velocity_W - mean, axis=1)
    assert off.mean() < 0.3 * uncorrected.mean()


def test_a_known_pose_is_where_the_track_starts(walk: ImuSequence, make_oracle: Make) -> None:
    """Yaw, position and velocity of the prior, none of which gravity can tell."""
    truth = walk.truth
    shift = np.array([100.0, -50.0, 3.0])
    prior = PriorPose(truth.attitude_WB[0].as_matrix(), truth.velocity_W[0], shift)
    navigator = Navigator(make_oracle(walk, truth, CONFIG), CONFIG, prior)
    track = navigator.run(walk)
    known = truth.at(np.clip(track.time, truth.time[0], truth.time[-1]))
    error = track.trajectory.position_W - shift - (known.position_W - truth.position_W[0])
    assert np.linalg.norm(error, axis=1).max() < 0.5
    off = track.trajectory.velocity_W - known.velocity_W
    assert np.linalg.norm(off[:20], axis=1).max() < 0.3
    assert streamed_off(stream(navigator, walk), track) < 1e-9


def test_position_nees_is_honest_where_the_model_is(make_walk: Make, make_oracle: Make) -> None:
    """White errors of IMU and oracle as large as stated, windows that do not overlap."""
    noise = ImuNoise(gyro_noise=1e-3, accel_noise=0.02, gyro_walk=3e-5, accel_walk=1e-3)
    errors = ImuErrors(noise=noise, gyro_turn_on=3e-3, accel_turn_on=0.05)
    config = NavigatorConfig(noise=noise, filter=FilterConfig(update_rate=1))
    means, nis = [], []
    for seed in range(8):
        walk = make_walk(seed, 20.0, 100.0, errors)
        oracle = make_oracle(walk, walk.truth, config, noise=0.05, sigma=0.05, seed=seed)
        track = Navigator(oracle, config).run(walk)
        means.append(position_nees(track.trajectory, walk.truth).mean)
        nis.append(track.nis)
    assert 1.0 < np.mean(means) < 9.0  # expected 3, and strongly correlated over a track
    assert 1.0 < np.mean(nis) < 6.0


# --- one recipe for stream and batch ---------------------------------------------------------


@pytest.mark.parametrize("config", [CONFIG, VELOCITY], ids=["displacement", "velocity"])
def test_stream_equals_batch(walk: ImuSequence, make_oracle: Make, config: NavigatorConfig) -> None:
    oracle = make_oracle(walk, walk.truth, config)
    track = Navigator(oracle, config).run(walk)
    navigator = Navigator(oracle, config)
    states = stream(navigator, walk)
    assert len(states) > 18 * config.filter.output_rate
    assert streamed_off(states, track) < 1e-9
    assert navigator.health.samples == track.health.samples
    assert navigator.health.updates == track.health.updates
    assert navigator.health.mean_nis == pytest.approx(track.health.mean_nis)
    np.testing.assert_allclose(navigator.state.covariance, track.covariance[-1], rtol=1e-9)


def test_stream_equals_batch_through_gaps_and_bad_samples(
    walk: ImuSequence, make_oracle: Make, without: Make
) -> None:
    rng = np.random.default_rng(0)
    gone = (rng.random(len(walk)) < 0.1) | ((walk.time > 7.0) & (walk.time < 8.3))
    holed = without(walk, gone)
    holed.gyro[100:104] = np.nan
    oracle = make_oracle(holed, walk.truth, CONFIG)
    track, navigator = Navigator(oracle).run(holed), Navigator(oracle)
    assert streamed_off(stream(navigator, holed), track) < 1e-9
    assert navigator.health.gaps == track.health.gaps


def test_stream_equals_batch_with_the_default_network(walk: ImuSequence) -> None:
    from stario.network import load_model

    model = load_model("default")
    track = Navigator(model).run(walk)
    assert streamed_off(stream(Navigator(model), walk), track) < 1e-3


def test_run_does_not_disturb_a_stream_in_progress(
    walk: ImuSequence, make_oracle: Make, track: Track
) -> None:
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG))
    half = len(walk) // 2
    rows = list(zip(walk.time, walk.gyro, walk.accel, strict=True))
    states = [navigator.push(*row) for row in rows[:half]]
    again = navigator.run(walk)
    states += [navigator.push(*row) for row in rows[half:]]
    assert streamed_off([s for s in states if s is not None], track) < 1e-9
    np.testing.assert_array_equal(again.trajectory.position_W, track.trajectory.position_W)


def test_truth_is_never_looked_at(walk: ImuSequence, make_oracle: Make, track: Track) -> None:
    blind = Navigator(make_oracle(walk, walk.truth, CONFIG)).run(walk.without_truth())
    for name, values in track.arrays().items():
        np.testing.assert_array_equal(blind.arrays()[name], values, err_msg=name)


def test_times_since_1970_give_the_same_track(
    walk: ImuSequence, make_oracle: Make, track: Track
) -> None:
    late = replace(walk, time=walk.time + 1.7e9)
    truth = replace(walk.truth, time=walk.truth.time + 1.7e9)
    ours = Navigator(make_oracle(late, truth, CONFIG)).run(late.without_truth())
    assert np.abs(ours.trajectory.position_W - track.trajectory.position_W).max() < 5e-3


# --- symmetries ------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [CONFIG, VELOCITY], ids=["displacement", "velocity"])
@pytest.mark.parametrize("mount", [(0.0, 0.0, 2.0), (3.1, 0.0, 0.0), (1.5, 1.0, -0.5)])
def test_another_mount_turns_the_track_about_the_vertical_and_no_more(
    walk: ImuSequence, make_oracle: Make, config: NavigatorConfig, mount: tuple[float, ...]
) -> None:
    R_BM = Rotation.from_rotvec(mount)
    turned = replace(
        walk,
        gyro=R_BM.apply(walk.gyro, inverse=True),
        accel=R_BM.apply(walk.accel, inverse=True),
        truth=replace(walk.truth, attitude_WB=walk.truth.attitude_WB * R_BM),
    )
    ours, theirs = (
        Navigator(make_oracle(s, s.truth, config), config).run(s).trajectory for s in (turned, walk)
    )
    turn = ours.attitude_WB * (theirs.attitude_WB * R_BM).inv()
    assert np.ptp(np.unwrap(yaw_of(turn))) < 1e-6
    back = about_z(float(yaw_of(turn)[0])).apply(ours.position_W, inverse=True)
    assert np.abs(back - theirs.position_W).max() < 1e-5


def test_the_walks_own_yaw_is_not_seen(make_oracle: Make, walk: ImuSequence) -> None:
    """The same IMU in a world turned by 2 rad: the track is the same."""
    turn = about_z(2.0)
    truth = replace(
        walk.truth,
        position_W=turn.apply(walk.truth.position_W),
        velocity_W=turn.apply(walk.truth.velocity_W),
        attitude_WB=turn * walk.truth.attitude_WB,
    )
    ours = Navigator(make_oracle(walk, truth, CONFIG)).run(walk)
    theirs = Navigator(make_oracle(walk, walk.truth, CONFIG)).run(walk)
    np.testing.assert_allclose(ours.trajectory.position_W, theirs.trajectory.position_W, atol=1e-6)


# --- bad input -------------------------------------------------------------------------------


def test_health_counts_what_was_put_in(walk: ImuSequence, make_oracle: Make) -> None:
    time, gyro, accel = walk.time.copy(), walk.gyro.copy(), walk.accel.copy()
    gyro[200:230, 1], accel[700] = np.nan, np.inf
    time[900], time[1100], time[1101] = time[899], time[1000], time[1000]
    bad = replace(walk, time=time, gyro=gyro, accel=accel)
    oracle = make_oracle(bad, walk.truth, CONFIG)
    track = Navigator(oracle).run(bad)
    health = track.health
    assert health.samples == {
        "used": len(walk) - 34,
        "not_finite": 31,
        "duplicate": 1,
        "out_of_order": 2,
    }
    ((start, length),) = health.gaps
    assert start == pytest.approx(time[199])
    assert length == pytest.approx(time[230] - time[199])
    assert health.updates == len(track.innovations.time)
    assert health.refused == {}
    assert health.gated == int(track.innovations.gated.sum())
    assert health.mean_nis == pytest.approx(track.innovations.nis.mean())
    assert health.final_sigma["position_m"] == pytest.approx(
        np.sqrt(np.diag(track.covariance[-1])[6:9].max())
    )
    assert all("\n" not in line for line in health.lines())


def test_states_stay_finite_under_bursts_of_nan(walk: ImuSequence, make_oracle: Make) -> None:
    rng = np.random.default_rng(0)
    gyro, accel = walk.gyro.copy(), walk.accel.copy()
    for start in rng.integers(0, len(walk), 30):
        (gyro if rng.random() < 0.5 else accel)[start : start + rng.integers(1, 60)] = np.nan
    bad = replace(walk, gyro=gyro, accel=accel)
    navigator = Navigator(make_oracle(bad, walk.truth, CONFIG))
    for state in stream(navigator, bad):
        for value in (state.R_WB, state.v_W, state.p_W, state.b_g, state.b_a, state.covariance):
            assert np.isfinite(value).all()
        assert np.linalg.eigvalsh(state.covariance).min() > -1e-9
    assert len(navigator.health.gaps) > 5


class Broken:
    """A network that answers with what no filter can use, one window in three."""

    def __init__(self, inner: Any, mean: float, variance: float) -> None:
        self.inner, self.mean, self.variance, self.count = inner, mean, variance, 0

    def predict(self, windows):
        mean, covariance = self.inner.predict(windows)
        for k in range(len(mean)):
            self.count += 1
            if self.count % 3 == 0:
                mean[k, 0] += self.mean
                covariance[k, 0, 0] = self.variance
        return mean, covariance


@pytest.mark.parametrize(
    ("mean", "variance", "reason"),
    [
        (np.nan, 1e-4, "value that is not finite"),
        (0.0, np.inf, "value that is not finite"),
        (0.0, -1.0, "covariance not positive definite"),
    ],
)
def test_measurements_without_meaning_are_refused_and_counted(
    walk: ImuSequence, make_oracle: Make, mean: float, variance: float, reason: str
) -> None:
    model = Broken(make_oracle(walk, walk.truth, CONFIG), mean, variance)
    track = Navigator(model).run(walk)
    assert track.health.refused == {reason: track.health.updates // 3}
    assert ate(track, walk) < 0.3


def test_outliers_are_gated_and_do_little_harm(walk: ImuSequence, make_oracle: Make) -> None:
    model = Broken(make_oracle(walk, walk.truth, CONFIG), 5.0, 0.02**2)
    track = Navigator(model, CONFIG).run(walk)
    assert 0.5 * track.health.updates / 3 < track.health.gated
    open_gate = NavigatorConfig(NOISE, replace(FILTER, gate=1.0 - 1e-16))
    model = Broken(make_oracle(walk, walk.truth, open_gate), 5.0, 0.02**2)
    assert ate(track, walk) < 0.5 * ate(Navigator(model, open_gate).run(walk), walk)


@pytest.mark.parametrize("config", [CONFIG, VELOCITY], ids=["displacement", "velocity"])
@pytest.mark.parametrize("length", [0.5, 3.0])
def test_after_a_gap_speed_recovers_and_sigma_covers_the_error(
    make_walk: Make, make_oracle: Make, without: Make, length: float, config: NavigatorConfig
) -> None:
    covered, slow = [], []
    for seed in range(4):
        walk = make_walk(seed, 20.0)
        holed = without(walk, (walk.time > 8.0) & (walk.time < 8.0 + length))
        track = Navigator(make_oracle(holed, walk.truth, config), config).run(holed)
        assert (~track.trajectory.valid).sum() == 1
        assert track.health.gaps[0][1] == pytest.approx(length, abs=0.03)
        truth = walk.truth.at(np.clip(track.time, 0.0, walk.time[-1]))
        aligned = align(track.trajectory, walk.truth, "first")
        error = aligned.position_W - truth.position_W
        late = track.time > 8.0 + length + 4.0
        sigma = np.sqrt(np.trace(track.covariance[late, 6:9, 6:9], axis1=1, axis2=2))
        covered.append(np.linalg.norm(error[late], axis=1) / sigma)
        # How far the walker turned meanwhile nobody saw: the speed comes back, not the direction.
        speed, true_speed = (
            np.linalg.norm(v[late, :2], axis=1) for v in (aligned.velocity_W, truth.velocity_W)
        )
        slow.append(np.abs(speed - true_speed).mean())
        before, after = (
            np.sqrt(np.trace(track.covariance[k, 6:9, 6:9]))
            for k in (np.searchsorted(track.time, 8.0) - 1, -1)
        )
        assert after > before
    assert np.max(np.mean(covered, axis=1)) < 2.0
    assert np.max(slow) < 0.25


@pytest.mark.parametrize(
    ("scale_gyro", "scale_accel", "option"),
    [(180 / np.pi, 1.0, "--gyro-unit deg/s"), (1.0, 1 / 9.80665, "--accel-unit g")],
)
def test_wrong_units_are_refused_with_the_option_that_mends_them(
    walk: ImuSequence, still_model: Any, scale_gyro: float, scale_accel: float, option: str
) -> None:
    wrong = replace(walk, gyro=scale_gyro * walk.gyro, accel=scale_accel * walk.accel)
    with pytest.raises(InputError, match=option) as caught:
        Navigator(still_model).run(wrong.without_truth())
    assert "\n" not in str(caught.value)


def test_missing_gravity_is_refused(walk: ImuSequence, still_model: Any) -> None:
    up_B = walk.truth.attitude_WB.apply([0.0, 0.0, 9.80665], inverse=True)
    with pytest.raises(InputError, match="accelerometer"):
        Navigator(still_model).run(replace(walk, accel=walk.accel - up_B))


@pytest.mark.parametrize("scale", [1 / 9.80665, 0.0])
def test_a_stream_in_wrong_units_is_refused_after_its_first_second(
    walk: ImuSequence, make_oracle: Make, scale: float
) -> None:
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG))
    with pytest.raises(InputError, match="accel: found an average"):
        stream(navigator, replace(walk, accel=scale * walk.accel))
    assert navigator.state is None
    assert streamed_off(stream(navigator, walk), Navigator(navigator.model).run(walk)) < 1e-9


@pytest.mark.parametrize("seconds", [0.0, 0.02, 0.9, 1.4])
def test_a_recording_that_is_too_short_is_a_clear_error(
    walk: ImuSequence, still_model: Any, seconds: float
) -> None:
    with pytest.raises(InputError, match="at least") as caught:
        Navigator(still_model).run(walk.slice(0.0, seconds))
    assert walk.name in str(caught.value)


def test_a_recording_of_pieces_shorter_than_a_window_is_a_clear_error(
    walk: ImuSequence, still_model: Any, without: Make
) -> None:
    holed = without(walk, walk.time % 0.9 > 0.7)
    with pytest.raises(InputError, match="unbroken stretch"):
        Navigator(still_model).run(holed)


@pytest.mark.parametrize("vector", [(1.0, 2.0), 3.0, "abc", (1, 2, None), None])
def test_a_sample_that_is_no_vector_is_refused_by_name(still_model: Any, vector: Any) -> None:
    navigator = Navigator(still_model)
    with pytest.raises(InputError, match="gyro"):
        navigator.push(0.0, vector, (0.0, 0.0, 9.8))
    with pytest.raises(InputError, match="accel"):
        navigator.push(0.0, (0.0, 0.0, 0.0), vector)


def test_before_its_first_second_a_stream_has_no_state_but_a_report(
    walk: ImuSequence, still_model: Any
) -> None:
    navigator = Navigator(still_model)
    assert stream(navigator, walk.slice(0.0, 0.5)) == []
    assert navigator.state is None
    assert navigator.health.samples["used"] == 51
    assert navigator.health.lines()


# --- memory ----------------------------------------------------------------------------------


def endless(sequence: ImuSequence, start: float, seconds: float):
    """The recording over and over."""
    step = 1.0 / sequence.rate
    rows = list(zip(sequence.gyro.tolist(), sequence.accel.tolist(), strict=True))
    for k in range(round(seconds / step)):
        yield start + k * step, *rows[k % len(rows)]


def grown(walk: ImuSequence, model: Any, warm: float, seconds: float) -> int:
    navigator = Navigator(model)
    tracemalloc.start()
    try:
        for row in endless(walk, 0.0, warm):
            navigator.push(*row)
        before = tracemalloc.get_traced_memory()[0]
        for row in endless(walk, warm, seconds):
            navigator.push(*row)
        return tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()


def test_the_memory_of_a_stream_does_not_grow(make_walk: Make, still_model: Any) -> None:
    # A kilobyte per second would be less than what one second of samples takes.
    assert grown(make_walk(1, 30.0, 50.0), still_model, 20.0, 60.0) < 60_000


@pytest.mark.slow
def test_the_memory_of_an_hour_does_not_grow(make_walk: Make, still_model: Any) -> None:
    assert grown(make_walk(1, 30.0, 50.0), still_model, 120.0, 3600.0) < 60_000
