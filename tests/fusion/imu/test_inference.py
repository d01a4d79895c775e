from dataclasses import replace

import numpy as np
import pytest
from simulated import Still
from support import Altered, Counting, stream

from stario.fusion import FilterConfig, Navigator, NavigatorConfig
from stario.fusion.imu.direction import Direction, direction, weighted_force
from stario.fusion.imu.inference import StatefulInference
from stario.fusion.recording import cut_recording
from stario.sequences import PERFECT_IMU, PHONE_IMU, InputError, generate_walk, simulate_imu
from stario.sequences.levelled_stream import TICK_SAMPLES, TICKS_PER_SECOND, levelled_streams
from stario.sequences.windows import WINDOW_SAMPLES


def with_gap(walk, without):
    return without(walk, (walk.time - walk.time[0] > 8.0) & (walk.time - walk.time[0] < 9.0))


@pytest.mark.parametrize("rate", [1, 5])
def test_memory_is_kept_between_gaps_separately_for_each_series(walk, without, rate):
    config = NavigatorConfig(filter=FilterConfig(update_rate=rate))
    preprocessed = Navigator(Counting(), config).observe(with_gap(walk, without))
    stretches, all_counts = [[]], []
    pairs = zip(preprocessed.intervals, preprocessed.measurements, strict=True)
    for interval, measurement in pairs:
        if interval.gap:
            stretches.append([])
        if measurement is not None:
            stretches[-1].append(measurement.d_N[2])
    assert len(stretches) == 2
    for stretch in stretches:
        assert stretch == pytest.approx([k // rate for k in range(len(stretch))])
        all_counts += stretch
    assert len(all_counts) > 15 * rate


def test_a_stream_equals_the_batch_also_after_a_restore(walk, without):
    sequence = with_gap(walk, without)
    track = Navigator(Counting(), backend="ekf").run(sequence).trajectory
    navigator = Navigator(Counting())
    states = stream(navigator, sequence.select(slice(700)))
    navigator, data = Navigator(Counting()), navigator.snapshot()
    navigator.restore(data)
    states += stream(navigator, sequence.select(slice(700, None)))
    at = np.searchsorted(track.time, [s.time for s in states])
    np.testing.assert_allclose([s.p_W for s in states], track.position_W[at], atol=1e-6)


def test_a_model_without_memory_refuses_that_of_another(walk, still_model):
    assert not StatefulInference(still_model, 10).is_recurrent
    navigator = Navigator(Counting())
    stream(navigator, walk.select(slice(300)))
    with pytest.raises(InputError, match="memory"):
        Navigator(still_model).restore(navigator.snapshot())


def test_slopes_and_missing_samples_make_displacements_less_certain(walk, without):
    """A floor of unknown slope (0.03) the height, missing samples all axes: sigma is doubled."""
    holed = without(walk, (walk.time > 6.0) & (walk.time < 6.1))
    ahead = Still((1.5, 0.0, 0.0), 3 * [1e-4])
    measurements = Navigator(ahead, NavigatorConfig()).observe(holed).measurements
    intervals, _ = cut_recording(holed, NavigatorConfig())
    known = [
        (interval.window.flagged, measured.covariance_N)
        for interval, measured in zip(intervals, measurements, strict=True)
        if measured is not None
    ]
    assert {flagged for flagged, _ in known} == {True, False}
    for flagged, covariance in known:
        own = 4e-4 if flagged else 1e-4
        expected = np.diag([own, own, own + (0.03 * 1.5) ** 2])
        np.testing.assert_allclose(covariance, expected, atol=1e-10)


def test_a_recording_tells_a_network_that_walks_backwards(make_walk, make_oracle):
    sequence, config = make_walk(seconds=60.0), NavigatorConfig()
    oracle = make_oracle(sequence, sequence.truth, config)

    def turn_back(number, mean, covariance):
        mean *= -1.0

    counts = Navigator(Altered(oracle, turn_back), config).observe(sequence).counts
    assert abs(counts.network_turn) > np.radians(135.0)
    assert counts.network_turn_sigma < np.radians(20.0)


def compared(stream, displacement) -> Direction:
    return direction(weighted_force(stream.windows()), displacement, TICKS_PER_SECOND)


@pytest.fixture(scope="module")
def stream_and_truth():
    """Levelled stream of a simulated walk, and its true displacements in the stream's frame N."""
    sequence = simulate_imu(generate_walk(2, 120.0), 200.0, PHONE_IMU, 2)
    (stream,) = levelled_streams(sequence)
    truth = sequence.truth
    starts = stream.start + TICK_SAMPLES / 200.0 * np.arange(stream.window_count)
    begin, end = (truth.at(t) for t in (starts, starts + WINDOW_SAMPLES / 200.0))
    R_WN = begin.attitude_WB[0].as_matrix() @ stream.R_NB[0].T
    return stream, (end.position_W - begin.position_W) @ R_WN


def test_true_displacements_agree_in_direction_with_the_accelerometer(stream_and_truth):
    found = compared(*stream_and_truth)
    assert abs(found.turn) < 3.0 * found.sigma < np.radians(45.0)


def test_with_an_exact_attitude_both_directions_agree_exactly():
    """The accelerometer's changes of velocity are those of the displacements."""
    sequence = simulate_imu(generate_walk(3, 30.0), 200.0, PERFECT_IMU)
    (stream,) = levelled_streams(sequence)
    force_W = sequence.truth.attitude_WB.apply(sequence.accel)[: len(stream)]
    exact = replace(stream, imu_N=np.concatenate([stream.imu_N[:, :3], force_W], axis=1))
    starts = stream.ticks[: stream.window_count]
    first, last = (sequence.truth.at(t).position_W for t in (starts, starts + 1.0))
    found = compared(exact, last - first)
    assert abs(found.turn) < 3e-3
    assert found.sigma < 2e-3
    assert abs(found.product) / found.network == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("degrees", [-120.0, 45.0, 180.0])
def test_the_rotation_of_rotated_displacements_is_found(stream_and_truth, degrees):
    stream, displacement = stream_and_truth
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotated = displacement @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    rotated_back = np.exp(1j * (compared(stream, rotated).turn + np.radians(degrees)))
    assert np.angle(rotated_back) == pytest.approx(compared(*stream_and_truth).turn, abs=1e-9)


def test_the_direction_of_noise_has_a_large_sigma(stream_and_truth):
    stream, displacement = stream_and_truth
    noise = np.random.default_rng(0).normal(size=displacement.shape)
    assert compared(stream, noise).sigma > 3.0 * compared(*stream_and_truth).sigma


def test_noise_seldom_has_a_direction_however_short_the_walk():
    """Changes that share nothing are coherent by chance: 1 / n in the mean of n pairs."""
    rng = np.random.default_rng(0)
    false = 0
    for _ in range(400):
        d, a = rng.normal(size=(2, 6)) + 1j * rng.normal(size=(2, 6))
        product, squares = complex(np.vdot(d, a)), (np.vdot(x, x).real for x in (d, a))
        found = Direction(product, *squares, count=6.0)
        false += abs(found.turn) > 3.0 * found.sigma
    assert false < 0.1 * 400


def test_directions_of_stretches_add_up_and_an_empty_one_is_undefined(stream_and_truth):
    stream, displacement = stream_and_truth
    once = compared(stream, displacement)
    twice = once + once
    assert twice.turn == pytest.approx(once.turn)
    # By more than the root of 2: chance has a smaller share of twice as many changes.
    assert once.sigma / 2.0 < twice.sigma < once.sigma / 2**0.5
    assert np.isnan(Direction().turn)
    assert Direction().sigma == np.pi
