from dataclasses import replace

import numpy as np
import pytest
from support import CONFIG, lying, samples, stream
from told import health_lines, told

from stario.fusion import Navigator, NavigatorConfig, PriorPose
from stario.fusion.imu.faults import (
    ClockSetBackDetector,
    ClockSetBackError,
    FrozenSensorDetector,
    OutlierDetector,
)
from stario.fusion.recording import cut_recording
from stario.network import load_model
from stario.sequences import ImuSequence, InputError, inspect_recording


def count_saturated(gyro_x: np.ndarray, size: int = 11) -> int:
    detector, rows = OutlierDetector(), np.zeros((len(gyro_x), 7))
    rows[:, 0], rows[:, 1] = 0.01 * np.arange(len(gyro_x)), gyro_x
    pieces = (rows[k : k + size].copy() for k in range(0, len(rows) - 1, size - 1))
    found = [detector.detect(piece).saturated for piece in pieces]
    return sum(found)


def test_an_impact_beyond_the_range_is_an_event_and_one_a_second_is_not():
    detector, missed = OutlierDetector(), []
    for second in range(10):
        rows = np.zeros((11, 7))
        rows[:, 0], rows[:, 6] = second + 0.005 * np.arange(11), 9.81
        rows[4:8, 6] = 80.0
        missed.append(detector.detect(rows).missed)
    assert missed[0] == pytest.approx(2.0 * 80.0 * 0.02)
    assert missed[-1] < 0.15 * missed[0]


def test_coarse_values_that_repeat_while_rising_are_not_saturated():
    rising = 0.1 * np.round(np.arange(0.0, 200.0) / 2.0)  # each value twice
    assert count_saturated(rising) == 0


def test_peaks_rounded_to_coarse_digits_are_not_saturated(make_walk, still_model):
    """Of 8 bits of 2 g, and of a degree per second."""
    walk, digits = make_walk(3, 20.0), {"gyro": 0.02, "accel": 0.15}
    coarse = {name: digit * np.round(getattr(walk, name) / digit) for name, digit in digits.items()}
    health = Navigator(still_model, backend="ekf").run(replace(walk, **coarse)).health
    assert health.flagged["saturated"] == 0


def test_a_clipped_sine_is_saturated_at_its_limit():
    clipped = np.clip(8.0 * np.sin(np.arange(0.0, 40.0, 0.05)), -5.0, 5.0)
    stuck = int(((clipped[1:] == clipped[:-1]) & (np.abs(clipped[1:]) == 5.0)).sum())
    assert stuck - 2 <= count_saturated(clipped) <= stuck


def test_a_spike_is_replaced_by_its_neighbours_mean_and_the_last_sample_by_the_one_before():
    rows = np.zeros((7, 7))
    rows[:, 0], rows[:, 1] = 0.01 * np.arange(7), np.arange(7.0)
    rows[[3, 6], 1] = 500.0, -500.0
    assert OutlierDetector().detect(rows).spikes == 2
    np.testing.assert_array_equal(rows[:, 1], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0])


@pytest.mark.parametrize("at", [0, 60, 73, 200])
def test_a_spike_at_the_start_or_after_a_gap_tilts_nothing(make_walk, at):
    walk = make_walk(3, 4.0).without_truth()
    kept = np.delete(np.arange(len(walk)), np.arange(120, 200))
    gyro = walk.gyro.copy()
    gyro[[at, at + 2]] = [[9e3, -7e3, 8e3], [-6e3, 5e3, 9e3]]

    def attitudes(rates):
        used = replace(walk, time=walk.time[kept], gyro=rates[kept], accel=walk.accel[kept])
        intervals, _ = cut_recording(used, NavigatorConfig())
        return np.array([interval.R_NB[2] for interval in intervals])

    np.testing.assert_allclose(attitudes(gyro), attitudes(walk.gyro), atol=0.05)


def test_zeros_of_an_accelerometer_are_no_free_fall(make_walk, still_model):
    walk = make_walk(3, 4.0).without_truth()
    accel = walk.accel.copy()
    accel[250:260] = 0.0
    assert Navigator(still_model).run(replace(walk, accel=accel)).health.samples["frozen"] == 10


def set_back(walk: ImuSequence, by: float, at: float = 8.0) -> ImuSequence:
    late = walk.time >= at
    return replace(walk.without_truth(), time=np.where(late, walk.time - by, walk.time))


def test_a_stream_raises_an_error_and_restarts(make_walk, still_model):
    walk = set_back(make_walk(3, 16.0), 100.0)
    first = PriorPose(np.eye(3), np.zeros(3), np.array([50.0, 0.0, 0.0]))
    navigator, states, errors = Navigator(still_model, prior=first), [], []
    navigator.update_position(500.0, np.zeros(3), np.eye(3))
    for row in samples(walk):
        try:
            states.append(navigator.push(*row))
        except ClockSetBackError as error:
            errors.append(error)
    assert len(errors) == 1
    assert errors[0].by == pytest.approx(100.0, abs=0.1)
    times = [state.time for state in states if state is not None]
    assert times[-1] == pytest.approx(walk.time[-1], abs=0.11)
    # The prior pose and the waiting fix belonged to the other clock.
    assert np.linalg.norm(navigator.state.p_W) < 10.0
    assert navigator.health.fixes == {}


@pytest.mark.parametrize("by", [7.0, 100.0])
def test_a_recordings_track_ends_there_and_its_health_states_why(make_walk, still_model, by):
    walk = set_back(make_walk(3, 16.0), by)
    track = Navigator(still_model, backend="ekf").run(walk)
    assert track.time[-1] == pytest.approx(8.0, abs=0.11)
    (line,) = [line for line in health_lines(track.health) if "clock" in line]
    assert line.startswith("! ")
    assert "Split" in line
    (problem,) = [p for p in told(walk) if "clock" in p]
    assert f"{by - 0.01:.4g} s at 8.0 s" in problem


def test_late_samples_and_bursts_are_not_another_clock():
    detector = ClockSetBackDetector()
    for k in range(300):  # two sensors in turn, one half a second behind
        detector.on_time(0.01 * k)
        detector.note_late(0.01 * k - 0.5, 0.01 * k)
    for k in range(490):
        detector.note_late(0.01 * k, 10.0)
    detector.on_time(10.0)
    for k in range(300):  # decreasing times
        detector.note_late(9.0 - 0.01 * k, 10.0)


def test_a_block_that_is_logged_twice_does_not_change_the_track(make_walk, still_model):
    walk = make_walk(3, 16.0).without_truth()
    twice = walk.select(np.r_[0:800, 600 : len(walk)])
    track, plain = (Navigator(still_model, backend="ekf").run(each) for each in (twice, walk))
    np.testing.assert_array_equal(track.trajectory.position_W, plain.trajectory.position_W)


def test_impossible_values_are_reported_and_excluded_from_the_means(make_walk):
    walk = make_walk(3, 16.0)
    gyro = walk.gyro.copy()
    gyro[::300] = 1e6
    found = inspect_recording(replace(walk, gyro=gyro))
    assert any(each.code == "values_impossible" for each in found.findings)
    assert found.figures["gyro_norm_mean_rad_s"] < 10.0


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_clock_set_back_by_a_few_seconds_is_a_gap(make_walk, backend):
    """Else the attitude and speed of three seconds ago would be believed."""
    walk = make_walk(3, 16.0)
    back = set_back(walk, 3.0)
    navigator = Navigator(load_model(), backend=backend)
    after = [state for state in stream(navigator, back) if state.time > 8.0][:30]
    true = walk.truth.at(np.array([state.time + 3.0 for state in after]))
    for state, up_B in zip(after, true.attitude_WB.inv().apply([0.0, 0.0, 1.0]), strict=True):
        tilt = np.linalg.norm(np.cross(state.R_WB.T[:, 2], up_B))
        assert tilt < 4.0 * np.sqrt(np.trace(state.covariance[:2, :2]))
    speeds = [np.linalg.norm(state.v_W) for state in after]
    assert max(speeds) < 2.5
    assert navigator.health.gaps[-1] == pytest.approx((5.0, 3.0), abs=0.05)


def test_a_clock_set_back_by_a_few_seconds_is_reported(make_walk, still_model):
    walk = make_walk(3, 16.0)
    back = set_back(walk, 3.0)
    track = Navigator(still_model, backend="ekf").run(back)
    for lines in (health_lines(track.health), told(back)):
        assert any("late for 3.0 s in a row" in line for line in lines)
    usual = Navigator(still_model, backend="ekf").run(walk).health
    assert not any("late" in line for line in health_lines(usual))


@pytest.mark.parametrize("held", ["last", "zeros"])
def test_a_sensor_that_stops_makes_a_gap(walk, make_oracle, held):
    gyro, accel, time = walk.gyro.copy(), walk.accel.copy(), walk.time
    dead = (time > time[0] + 8.0) & (time < time[0] + 11.0)
    last = np.argmax(dead) - 1
    gyro[dead], accel[dead] = (gyro[last], accel[last]) if held == "last" else (0.0, 0.0)
    stopped = replace(walk, gyro=gyro, accel=accel)
    track = Navigator(make_oracle(stopped, walk.truth, CONFIG), backend="ekf").run(stopped)
    assert track.health.samples["frozen"] > 0.9 * dead.sum()
    assert track.health.gap_count == 1
    ((start, length),) = track.health.gaps
    assert start == pytest.approx(time[dead][0], abs=0.15)
    assert length == pytest.approx(3.0, abs=0.2)


def test_a_sensor_at_rest_may_repeat_its_values(still_model):
    """Simulated without noise, or so coarse that its noise does not show."""
    health = Navigator(still_model, backend="ekf").run(lying(10.0)).health
    assert health.samples["frozen"] == 0


@pytest.mark.parametrize("accel", [0.0, 1.0])
def test_an_unchanging_stream_is_refused_for_its_force(still_model, accel):
    silent = lying(3.0)
    silent.accel[:, 2] = accel
    with pytest.raises(InputError, match="accel"):
        stream(Navigator(still_model), silent)


def held(walk: ImuSequence, sensor: str, start: float, stop: float) -> ImuSequence:
    """The walk with one sensor repeating its value of `start` [s] until `stop` [s]."""
    values, dead = getattr(walk, sensor).copy(), (walk.time >= start) & (walk.time < stop)
    values[dead] = values[np.argmax(dead)]
    return replace(walk, **{sensor: values})


NAMES = {"gyro": "gyroscope", "accel": "accelerometer"}


@pytest.mark.parametrize("sensor", NAMES)
def test_one_sensor_that_stops_makes_a_gap_and_is_named(walk, make_oracle, sensor):
    stopped = held(walk, sensor, 8.0, 12.0)
    track = Navigator(make_oracle(stopped, walk.truth, CONFIG), backend="ekf").run(stopped)
    ((start, length),) = track.health.gaps
    assert 8.4 < start < 9.1
    assert start + length == pytest.approx(12.0, abs=0.05)
    assert track.health.samples["frozen"] == pytest.approx(100.0 * length, abs=5)
    (line,) = [line for line in health_lines(track.health) if "stopped" in line]
    assert line.startswith(f"! The {NAMES[sensor]} stopped")
    assert not any("same rate" in line for line in health_lines(track.health))


@pytest.mark.parametrize("axis", range(3))
def test_one_axis_of_the_gyroscope_that_stops_is_named(walk, still_model, axis):
    gyro, dead = walk.gyro.copy(), (walk.time >= 8.0) & (walk.time < 12.0)
    gyro[dead, axis] = gyro[np.argmax(dead), axis]
    health = Navigator(still_model, backend="ekf").run(replace(walk, gyro=gyro)).health
    assert health.stopped == {"gyroscope": pytest.approx(300, abs=60)}
    ((start, length),) = health.gaps
    assert start + length == pytest.approx(12.0, abs=0.05)


def test_an_axis_may_be_constant_in_a_plane_or_between_coarse_digits(walk):
    """Also one that is constant from the beginning, and one that reaches its limit."""
    coarse = 0.02 * np.round(walk.gyro / 0.02), 0.15 * np.round(walk.accel / 0.15)
    assert frozen_samples(walk.time, *coarse) == 0
    planar = walk.gyro * [1.0, 1.0, 0.0]
    assert frozen_samples(walk.time, planar, walk.accel) == 0
    fast = walk.gyro + [0.0, 0.0, 8.0] * (walk.time[:, None] > 8.0)
    assert frozen_samples(walk.time, np.minimum(fast, 4.0), walk.accel) == 0


@pytest.mark.parametrize("sensor", NAMES)
def test_a_slow_sensor_may_be_repeated_at_the_rate_of_the_other(walk, still_model, sensor):
    slow = getattr(walk, sensor)[np.arange(len(walk)) // 10 * 10]
    track = Navigator(still_model, backend="ekf").run(replace(walk, **{sensor: slow}))
    assert track.health.samples["frozen"] == 0


def frozen_samples(time: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> int:
    detector = FrozenSensorDetector(9.81)
    rows = np.column_stack([time, gyro, accel]).tolist()
    return sum(detector.stopped(tuple(row)) is not None for row in rows)


def test_constant_values_that_the_other_sensor_confirms_are_no_fault():
    """A coarse gyroscope at rest, a turntable, and turning about the vertical without noise."""
    time = np.arange(0.0, 20.0, 0.01)
    rng = np.random.default_rng(0)
    up = np.tile([0.0, 0.0, 9.81], (len(time), 1))
    noisy = up + 0.1 * rng.standard_normal(up.shape)
    spin = np.tile([0.0, 0.0, 0.35], (len(time), 1))
    swing = np.sin(time)[:, None] * [0.0, 0.0, 1.0]
    for gyro, accel in ((0.0 * up, noisy), (spin, noisy), (swing, up)):
        first = np.arange(len(time))[:, None] < 50  # before, both vary
        vary = 0.1 * rng.standard_normal(up.shape)
        before = np.where(first, vary, gyro), np.where(first, up + vary, accel)
        assert frozen_samples(time, *before) == 0


def test_a_gap_while_a_value_repeats_shows_no_motion(walk):
    """A phone that sleeps for three seconds repeats the gyroscope's value when it wakes."""
    gyro, keep = walk.gyro.copy(), (walk.time < 8.0) | (walk.time >= 11.0)
    awake = np.flatnonzero(walk.time >= 11.0)
    gyro[awake[:5]] = gyro[np.flatnonzero(walk.time < 8.0)[-1]]
    assert frozen_samples(walk.time[keep], gyro[keep], walk.accel[keep]) == 0


def test_a_wild_time_does_not_hide_a_sensor_that_has_stopped(walk):
    stopped = held(walk, "gyro", 8.0, 12.0)
    time = stopped.time.copy()
    time[820] = 1e9
    assert frozen_samples(time, stopped.gyro, stopped.accel) > 200


@pytest.mark.parametrize("stop", [8.3, 10.0])
def test_a_restored_stream_knows_what_has_stopped(walk, still_model, stop):
    stopped = held(walk, "gyro", 8.0, 12.0)
    whole, first, second = (Navigator(still_model) for _ in range(3))
    stream(whole, stopped)
    stream(first, stopped.slice(0.0, stop - 1e-9))
    second.restore(first.snapshot())
    stream(second, stopped.slice(stop, 20.1))
    assert second.health == whole.health
    assert second.health.samples["frozen"] > 200
