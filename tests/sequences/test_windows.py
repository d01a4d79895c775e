from dataclasses import replace

import numpy as np
import pytest
from cut_windows import windows_of
from scipy.spatial.transform import Rotation

from stario.fusion.recording import cut_recording
from stario.fusion.values.config import NavigatorConfig
from stario.sequences import PERFECT_IMU, WalkStyle, about_z, generate_walk, simulate_imu, yaw_of
from stario.sequences.clean_samples import clean_samples
from stario.sequences.levelled_stream import levelled_streams
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.windows import (
    facing,
    headings_at,
    imu_in_world,
    mean_heading,
    resample,
    rotated_windows,
    world_streams,
)


@pytest.fixture(scope="module")
def track():
    return generate_walk(5, 20.0, rate=200.0, style=WalkStyle(carry="handheld"))


@pytest.fixture(scope="module")
def walk(track):
    return simulate_imu(track, rate=200.0, errors=PERFECT_IMU)


def smooth(time: FloatArray) -> FloatArray:
    return np.stack([np.sin(2 * np.pi * f * time + f) for f in (0.5, 1.0, 2.0)], axis=1)


EVEN = [(rate, 0.0) for rate in (50.0, 100.0, 199.36, 200.0, 500.0, 1000.0)]


@pytest.mark.parametrize(("rate", "jitter"), [*EVEN, (100.0, 0.3), (1000.0, 0.3)])
def test_resampling_reproduces_a_smooth_signal(rate, jitter):
    """Also of uneven times of which one in ten is lost."""
    rng, time = np.random.default_rng(0), np.arange(0.0, 4.0, 1.0 / rate)
    if jitter:
        time = time + rng.uniform(-jitter, jitter, len(time)) / rate
        time = time[rng.random(len(time)) > 0.1]
    grid = np.arange(time[0], time[-1], 1.0 / 200.0)
    # The chord of a sine at f over a step is off by (pi f step)^2 / 2, the average by less.
    bound = (np.pi * 2.0 * max(np.diff(time).max(), 1.0 / 200.0)) ** 2 / 2.0
    bound = bound + 0.005 if jitter else 1.1 * bound  # uneven steps add an error of their own
    assert np.abs(resample(time, smooth(time), grid) - smooth(grid))[1:-1].max() < bound


def test_faster_sensors_are_averaged_and_do_not_alias():
    time = np.arange(0.0, 4.0, 1e-3)
    grid = np.arange(0.0, 3.9, 1.0 / 200.0)
    buzz = np.sin(2 * np.pi * 200.0 * time + 0.5)[:, None]  # decimated, it would be constant
    assert np.abs(resample(time, buzz, grid)[1:-1]).max() < 0.05
    noise = np.random.default_rng(0).standard_normal((len(time), 1))
    assert resample(time, noise, grid).std() < 0.6


@pytest.mark.parametrize("rate", [50.0, 100.0, 199.36, 500.0, 1000.0])
def test_streams_of_any_rate_contain_the_same_walk(track, walk, rate):
    (true,) = world_streams(walk, attitude="true")
    (stream,) = world_streams(simulate_imu(track, rate=rate, errors=PERFECT_IMU), attitude="true")
    n = min(len(true), len(stream))
    off = np.abs(stream.imu_W[:n] - true.imu_W[:n])[2:-2]
    assert off[:, :3].mean() < (0.05 if rate < 200.0 else 0.01)
    assert off[:, 3:].mean() < (0.1 if rate < 200.0 else 0.02)
    assert np.abs(stream.position_W[:n] - true.position_W[:n]).max() < 2e-3


def test_the_target_is_the_displacement_over_the_window(walk):
    (stream,) = world_streams(walk, attitude="true")
    windows, targets = windows_of(stream, stride=50)
    assert windows.shape == (len(targets), 6, 200)
    truth = walk.truth
    for k in range(len(targets)):
        start, stop = truth.time[50 * k], truth.time[50 * k] + 1.0
        ends = truth.at(np.array([start, stop])).position_W
        assert np.abs(targets[k] - (ends[1] - ends[0])).max() < 1e-5
        part = slice(50 * k, 50 * k + 200)
        force = truth.attitude_WB[part].apply(walk.accel[part])
        assert np.abs(windows[k, 3:].T - force).max() < 1e-4
        rate = truth.attitude_WB[part].apply(walk.gyro[part])
        assert np.abs(windows[k, :3].T - rate).max() < 1e-5


def test_no_window_spans_a_gap_in_the_truth(walk):
    """Stretches too short for a window are dropped."""
    truth = walk.truth
    valid = np.ones(len(truth), dtype=np.bool_)
    valid[1300:1400] = valid[1600:1700] = False
    streams = world_streams(replace(walk, truth=replace(truth, valid=valid)))
    assert len(streams) == 2
    assert len(streams[0]) == pytest.approx(1300, abs=1)
    assert len(streams[1]) == pytest.approx(len(truth) - 1700, abs=2)
    ends = truth.position_W[1700], truth.position_W[1900]
    assert np.allclose(windows_of(streams[1], 200)[1][0], ends[1] - ends[0], atol=0.01)


@pytest.mark.parametrize(("gap", "seconds"), [(0.05, [20.0]), (0.3, [8.0, 11.7])])
def test_no_window_spans_a_long_gap_in_the_imu(walk, gap, seconds):
    gappy = walk.select((walk.time < 8.0) | (walk.time > 8.0 + gap))
    lengths = [len(stream) / 200.0 for stream in world_streams(gappy)]
    assert lengths == pytest.approx(seconds, abs=0.011)


def test_a_misaligned_truth_does_not_affect_levelled_windows():
    """It tilts the mean specific force towards the facing of the device, a clue absent in use."""
    style = WalkStyle(carry="handheld")
    walk = simulate_imu(generate_walk(7, 60.0, rate=200.0, style=style), 200.0, PERFECT_IMU)
    truth = walk.truth
    askew = truth.attitude_WB * Rotation.from_rotvec([0.05, 0.0, 0.0])
    tilted = replace(walk, truth=replace(truth, attitude_WB=askew))
    settled = slice(20 * 200, None)

    def off(attitude):
        (right,) = world_streams(walk, attitude=attitude)
        (wrong,) = world_streams(tilted, attitude=attitude)
        np.testing.assert_array_equal(right.position_W, wrong.position_W)
        return float(np.abs(right.imu_W - wrong.imu_W)[settled, 3:5].mean())

    assert off("true") > 0.2  # 9.8 sin 0.05 along one of two axes
    assert off("levelled") < 0.02


def test_the_truths_errors_of_heading_are_averaged_over_a_second(walk):
    """Also where they take the heading past half a turn."""
    truth = walk.truth
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(truth))
    base = np.pi - float(yaw_of(truth.attitude_WB)[0])
    turned, noisy = (
        replace(walk, truth=replace(truth, attitude_WB=about_z(base + off) * truth.attitude_WB))
        for off in (0.0 * noise, noise)
    )
    (right,), (stream,) = world_streams(turned), world_streams(noisy)
    headings = (np.arctan2(*s.facing_W.T[::-1]) for s in (right, stream))
    off = np.subtract(*headings)[100:-100]  # half a second at either end has fewer
    assert np.abs(np.angle(np.exp(1j * off))).max() < 0.03  # 0.1 / sqrt(200) is 0.007


def test_levelled_windows_of_a_device_held_upright_have_its_true_heading():
    """A tilt of the truth's world must not turn it, however far the device is from level."""
    still = np.zeros((2001, 3))
    R_WB = about_z(np.linspace(0.0, 6.0, 2001)) * Rotation.from_rotvec([1.4, 0.0, 0.0])
    time = np.arange(2001) / 200.0
    walk = simulate_imu(Trajectory(time, still, R_WB), 200.0, PERFECT_IMU)
    tilted = Rotation.from_rotvec([0.0, 0.05, 0.0]) * R_WB
    (stream,) = world_streams(replace(walk, truth=Trajectory(time, still, tilted)))
    off = np.arctan2(*stream.facing_W.T[::-1]) - yaw_of(R_WB)[: len(stream)]
    assert np.abs(np.angle(np.exp(1j * off))).max() < 2e-3


def test_positions_far_from_the_origin_keep_their_precision(walk):
    """Coordinates of a national grid have steps of half a metre in single precision."""
    truth = walk.truth
    far = replace(truth, position_W=truth.position_W + np.array([4.5e5, 5.4e6, 0.0]))
    (near,), (stream,) = world_streams(walk), world_streams(replace(walk, truth=far))
    np.testing.assert_allclose(stream.position_W, near.position_W, atol=1e-5)


def test_levelled_windows_equal_the_navigators_except_for_heading():
    walk = simulate_imu(generate_walk(7, 30.0, rate=200.0), 200.0, seed=7)
    (stream,) = world_streams(walk)
    epochs, _ = cut_recording(walk, NavigatorConfig())
    true_WB = walk.truth.attitude_WB
    compared = 0
    for epoch in epochs:
        if epoch.window is None:
            continue
        first = round((epoch.stop - 1.0) * 200)
        theirs = stream.imu_W[first : first + 200].T
        levelled_NB = Rotation.from_matrix(epoch.window.R_NB)
        turn = about_z(yaw_of(true_WB[first] * levelled_NB.inv()))
        ours = np.concatenate(
            [turn.apply(epoch.window.imu_N[k : k + 3].T) for k in (0, 3)], axis=1
        ).T
        assert np.abs(ours - theirs).mean() < 0.1
        compared += 1
    assert compared > 25


def test_bad_samples_are_dropped(walk):
    time, gyro, accel = walk.time.copy(), walk.gyro.copy(), walk.accel.copy()
    time[10], time[20], time[30] = time[9], time[5], np.nan
    gyro[40], accel[50, 2] = np.nan, np.inf
    kept, _, _ = clean_samples(ImuSequence("bad", time, gyro, accel))
    expected = np.delete(walk.time, [10, 20, 30, 40, 50])
    assert np.array_equal(kept, expected)
    (stream,) = world_streams(ImuSequence("bad", time, gyro, accel, walk.truth), attitude="true")
    (true,) = world_streams(walk, attitude="true")
    assert np.isfinite(stream.imu_W).all()
    assert np.abs(stream.position_W - true.position_W).max() < 1e-4


@pytest.mark.parametrize("attitude", ["true", "levelled"])
def test_a_zero_time_before_times_since_1970_does_not_exhaust_memory(walk, attitude):
    """A grid over the whole time between would not fit in memory."""
    start = 1.7e9 - 0.01
    truth = walk.truth
    late = replace(walk, time=start + walk.time, truth=replace(truth, time=start + truth.time))
    late.time[0] = 0.0
    world = imu_in_world(late, late.truth, attitude)
    assert len(world.time) == len(world.imu) == len(world.usable) < len(walk) + 500
    assert (np.diff(world.time) > 0.0).all()
    (stream,), (whole,) = world_streams(late, attitude=attitude), world_streams(walk)
    assert len(stream) == pytest.approx(len(whole), abs=5)


def test_after_a_long_gap_the_grid_continues_evenly(walk):
    """Whole seconds are skipped, so that index arithmetic gives the same times as without a gap."""
    gappy = walk.select((walk.time < 4.0) | (walk.time > 12.345))
    world = imu_in_world(gappy, walk.truth, "true")
    grid, usable = world.time, world.usable
    index = (grid - grid[0]) * 200.0
    assert np.abs(index - np.round(index)).max() < 1e-6
    skipped = np.round(index) - np.arange(len(grid))
    assert set(skipped) == {0.0, 7 * 200.0}
    assert not usable[(grid > 4.01) & (grid < 12.345)].any()
    assert usable[grid > 12.36].all()


def test_heading_is_the_yaw_at_any_tilt_except_upside_down():
    """A phone held upright or on its side has a heading too."""
    for tilt in ([0.0, 0.0, 0.0], [1.57, 0.0, 0.0], [0.0, 1.57, 0.0], [-2.5, 0.5, 0.0]):
        R_tilt = Rotation.from_rotvec(tilt)
        for yaw in (-3.0, 0.2, 1.7):
            R = (Rotation.from_rotvec([0.0, 0.0, yaw]) * R_tilt).as_matrix()
            heading = float(mean_heading(np.tile(facing(R), (10, 1))))
            assert heading == pytest.approx(yaw, abs=1e-9)
            assert yaw_of(Rotation.from_matrix(R)) == pytest.approx(yaw, abs=1e-9)
    turning = facing(about_z(np.arange(400) / 200.0).as_matrix())
    assert headings_at(turning, np.array([100])) == pytest.approx(0.5 + 0.45)  # ten instants
    upside_down = facing(Rotation.from_rotvec([np.pi, 0.0, 0.0]).as_matrix())
    np.testing.assert_allclose(upside_down, 0.0, atol=1e-10)


def test_levelled_windows_reach_the_end_and_attitudes_at_ticks_are_interpolated(walk):
    (stream,) = levelled_streams(walk)
    windows = stream.windows()
    assert (len(stream), len(windows), len(stream.headings)) == (4000, 39, 39)
    np.testing.assert_allclose(windows[-1], stream.imu_N[3800:].T, atol=1e-5)
    at_ticks = np.stack([facing(R) for R in stream.R_NB])
    np.testing.assert_allclose(at_ticks, stream.facing_N[::100], atol=1e-6)
    # At 73 Hz, most ticks lie between two samples.
    poses = Trajectory(walk.time, np.zeros((len(walk), 3)), about_z(2.0 * walk.time))
    (stream,) = levelled_streams(simulate_imu(poses, 73.0, PERFECT_IMU))
    yaw = yaw_of(Rotation.from_matrix(stream.R_NB))
    turned = yaw - 2.0 * (stream.ticks - stream.start)
    np.testing.assert_allclose(np.exp(1j * turned), 1.0, atol=1e-6)


def test_rotating_a_window_rotates_its_vectors():
    rng = np.random.default_rng(0)
    windows = rng.normal(size=(3, 6, 200)).astype(np.float32)
    yaw = np.array([0.3, -1.0, 2.0])
    turned = rotated_windows(windows, yaw)
    for window, result, angle in zip(windows, turned, yaw, strict=True):
        R = Rotation.from_rotvec([0.0, 0.0, angle])
        np.testing.assert_allclose(result[:3].T, R.apply(window[:3].T), atol=1e-6)
        np.testing.assert_allclose(result[3:].T, R.apply(window[3:].T), atol=1e-6)
