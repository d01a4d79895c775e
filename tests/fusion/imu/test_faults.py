"""Faulty samples: values at a sensor's limit, a clock that is set back."""

from dataclasses import replace

import numpy as np
import pytest
from support import samples, stream
from told import health_lines, told

from stario.fusion import Navigator, NavigatorConfig, PriorPose
from stario.fusion.imu.faults import ClockSetBackDetector, ClockSetBackError, OutlierDetector
from stario.fusion.recording import cut_recording
from stario.network import load_model
from stario.sequences import ImuSequence, inspect_recording


def count_saturated(gyro_x: np.ndarray, size: int = 11) -> int:
    """Number of samples flagged in a stream that is checked interval by interval."""
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


def in_order(walk: ImuSequence, rows: np.ndarray) -> ImuSequence:
    return replace(walk, time=walk.time[rows], gyro=walk.gyro[rows], accel=walk.accel[rows])


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
    twice = in_order(walk, np.r_[0:800, 600 : len(walk)])
    track, plain = (Navigator(still_model, backend="ekf").run(each) for each in (twice, walk))
    np.testing.assert_array_equal(track.trajectory.position_W, plain.trajectory.position_W)


def test_shuffled_rows_are_reported_with_the_advice_to_sort_them(make_walk):
    walk = make_walk(3, 16.0)
    order = np.random.default_rng(0).permutation(len(walk))
    problems = " ".join(told(in_order(walk.without_truth(), order)))
    assert "sort the rows" in problems
    assert "ms" not in problems


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
