from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from cut_windows import windows_of
from scipy.spatial.transform import Rotation

from stario.fusion.imu.front_end import FrontEnd
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.recording import cut_recording
from stario.fusion.values.config import FilterConfig, NavigatorConfig
from stario.sequences import PERFECT_IMU, ImuSequence, Trajectory, world_streams
from stario.sequences.attitude.levelling import LevelledAttitude
from stario.sequences.windows import WINDOW_SECONDS

CONFIG = NavigatorConfig(filter=FilterConfig(update_rate=10))


def integral(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.trapezoid(values, time, axis=0)


def assert_seamless(intervals: list[ImuInterval], first: float) -> None:
    """Assert that each interval begins where the previous one ended, with the same sample."""
    assert intervals[0].start == first
    for before, after in pairwise(intervals):
        assert after.start == before.stop
        np.testing.assert_allclose(after.gyro[0], before.gyro[-1], atol=1e-10)
        np.testing.assert_allclose(after.accel[0], before.accel[-1], atol=1e-10)
    for interval in intervals:
        assert (np.diff(interval.time) > 0).all()


def uneven(sequence: ImuSequence, drops: float, jitter: float, seed: int = 0) -> ImuSequence:
    """The walk sampled unevenly: jittered times (values interpolated there) and lost samples."""
    rng = np.random.default_rng(seed)
    time = sequence.time + jitter / sequence.rate * rng.uniform(-0.45, 0.45, len(sequence))
    time[0] = sequence.time[0]
    time = np.clip(time, sequence.time[0], sequence.time[-1])

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(time, sequence.time, v) for v in values.T], axis=1)

    keep = rng.random(len(time)) > drops
    keep[0] = True
    keep[1:] &= np.diff(time) > 0
    gyro, accel = at(sequence.gyro), at(sequence.accel)
    return replace(sequence, time=time[keep], gyro=gyro[keep], accel=accel[keep])


def counted(front_end: FrontEnd) -> dict[str, int]:
    return {name: n for name, n in front_end.counts.samples.items() if n}


@pytest.mark.parametrize(
    ("rate", "jitter", "drops"),
    [(50.0, 0.5, 0.05), (199.36, 0.0, 0.0), (1000.0, 1.0, 0.2)],
)
def test_intervals_cover_every_moment_once(make_walk, rate, jitter, drops):
    walk = uneven(make_walk(2, 8.0, rate), drops, jitter)
    intervals, front_end = cut_recording(walk, CONFIG)
    assert counted(front_end) == {"used": len(walk)}
    assert_seamless(intervals, walk.time[0])
    period = 1.0 / CONFIG.filter.output_rate
    np.testing.assert_allclose([e.stop - e.start for e in intervals], period, atol=1e-9)
    end = intervals[-1].stop
    assert walk.time[-1] - end < period
    # Trapezoidal integral of the recording's samples up to the last interval's end.
    inside = walk.time < end
    for name in ("gyro", "accel"):
        values = getattr(walk, name)
        last = [np.interp(end, walk.time, values[:, k]) for k in range(3)]
        whole = integral(np.append(walk.time[inside], end), np.vstack([values[inside], last]))
        pieces = sum(integral(e.time, getattr(e, name)) for e in intervals)
        np.testing.assert_allclose(pieces, whole, atol=1e-9)


@pytest.mark.parametrize("rate", [1, 20])
def test_windows_come_at_the_update_rate_after_the_first_second(walk, rate):
    intervals, _ = cut_recording(walk, NavigatorConfig(filter=FilterConfig(update_rate=rate)))
    stops = np.array([e.stop for e in intervals if e.window is not None]) - walk.time[0]
    assert stops[0] == pytest.approx(1.0)
    np.testing.assert_allclose(np.diff(stops), 1.0 / rate, atol=1e-9)
    assert all(e.update for e in intervals if e.window is not None)


@pytest.mark.parametrize(("rate", "bound"), [(100.0, 1e-3), (200.0, 1e-3), (1000.0, 5e-3)])
def test_windows_equal_those_of_training_for_the_same_attitude(make_walk, rate, bound):
    walk = make_walk(3, 6.0, rate, PERFECT_IMU)
    intervals, front_end = cut_recording(walk, CONFIG)
    # The levelled attitude serves as truth; corrections at the intervals' ends are small steps.
    attitude = LevelledAttitude(front_end.start)
    R = np.concatenate([attitude.advance(e.time, e.gyro, e.accel)[:-1] for e in intervals])
    time = np.concatenate([e.time[:-1] for e in intervals])
    truth = Trajectory(time, np.zeros((len(time), 3)), Rotation.from_matrix(R))
    (stream,) = world_streams(replace(walk, truth=truth), attitude="true")
    theirs, _ = windows_of(stream, 20)
    ours = np.stack([e.window.imu_N for e in intervals if e.window is not None])
    n = min(len(ours), len(theirs))
    assert n > 40
    off = np.abs(ours[:n] - theirs[:n])
    # At an interval's end the attitude steps, and a faster sensor's average stops short of it.
    assert off.mean() < bound
    assert off.max() < 100.0 * bound
    assert ours.dtype == np.float32


def test_windows_start_with_their_stated_attitude(walk):
    intervals, _ = cut_recording(walk, CONFIG)
    by_stop = {round(e.stop, 6): e for e in intervals}
    checked = 0
    for interval in intervals:
        before = by_stop.get(round(interval.stop - WINDOW_SECONDS, 6))
        if interval.window is None or before is None:
            continue
        np.testing.assert_array_equal(interval.window.R_NB, before.R_NB)
        first = before.R_NB @ before.accel[-1]
        np.testing.assert_allclose(interval.window.imu_N[3:, 0], first, atol=1e-5)
        checked += 1
    assert checked > 100


def samples_within(walk: ImuSequence, start: float, stop: float) -> np.ndarray:
    return (walk.time > start) & (walk.time < stop)


@pytest.mark.parametrize("length", [0.25, 0.5, 5.0])
def test_a_gap_is_one_interval_and_no_window_spans_it(walk, without, length):
    start, stop = 6.02, 6.02 + length
    holed = without(walk, samples_within(walk, start + 1e-9, stop - 1e-9))
    intervals, front_end = cut_recording(holed, CONFIG)
    (gap,) = [e for e in intervals if e.gap]
    assert gap.start == pytest.approx(start)
    assert gap.stop == pytest.approx(stop)
    assert front_end.counts.gaps == [(pytest.approx(start), pytest.approx(length))]
    assert_seamless(intervals, holed.time[0])
    spans = [(e.stop - WINDOW_SECONDS, e.stop) for e in intervals if e.window is not None]
    assert not any(a < gap.stop - 1e-9 and b > gap.start + 1e-9 for a, b in spans)
    after = [b for a, b in spans if a > gap.start]
    assert min(after) == pytest.approx(stop + WINDOW_SECONDS)


@pytest.mark.parametrize(("start", "stop", "counted"), [(6.02, 6.17, 1), (6.0, 6.08, 0)])
def test_a_hole_is_bridged_and_what_lies_across_it_flagged(walk, without, start, stop, counted):
    holed = without(walk, samples_within(walk, start + 1e-9, stop - 1e-9))
    intervals, front_end = cut_recording(holed, CONFIG)
    assert not any(e.gap for e in intervals)
    gap = (pytest.approx(start), pytest.approx(stop - start))
    assert front_end.counts.gaps == [gap] * counted  # a tenth of a second is none
    assert_seamless(intervals, walk.time[0])
    missing = [e for e in intervals if e.flags.missing]
    assert missing == [e for e in intervals if e.start < stop - 1e-9 and e.stop > start + 1e-9]
    for e in intervals:
        if e.window is not None:
            touches = e.stop - WINDOW_SECONDS < missing[-1].stop - 1e-9
            assert e.window.flagged == (touches and e.stop > missing[0].start + 1e-9)


def test_after_a_gap_in_the_first_second_the_front_end_restarts(walk, without):
    holed = without(walk, samples_within(walk, 0.5 + 1e-9, 0.9 - 1e-9))
    intervals, front_end = cut_recording(holed, CONFIG)
    assert front_end.counts.gaps == [(pytest.approx(0.5), pytest.approx(0.4))]
    assert front_end.start.time == pytest.approx(0.9)
    assert_seamless(intervals, front_end.start.time)
    assert not any(e.gap for e in intervals)


def test_two_gaps_with_one_sample_between_them_are_counted_separately(walk, without):
    gone = samples_within(walk, 5.0 + 1e-9, 6.0 - 1e-9)
    gone[np.argmin(np.abs(walk.time - 5.5))] = False
    intervals, front_end = cut_recording(without(walk, gone), CONFIG)
    assert [length for _, length in front_end.counts.gaps] == pytest.approx([0.5, 0.5])
    (gap,) = [e for e in intervals if e.gap]  # no sample could level the attitude between them
    assert (gap.start, gap.stop) == (pytest.approx(5.0), pytest.approx(6.0))
    assert_seamless(intervals, walk.time[0])


def test_the_newest_gaps_are_listed_and_all_are_counted(walk):
    front_end = FrontEnd(CONFIG)
    for k in range(250):  # 0.5 s of samples, then 0.5 s without, once 0.8 s
        for j in range(50):
            row = (float(k) + (0.3 if k > 100 else 0.0) + 0.01 * j, *walk.gyro[j], *walk.accel[j])
            front_end.push(row)
    counts = front_end.counts
    assert counts.gap_count == 249
    assert counts.longest_gap == pytest.approx(0.81)
    assert [start for start, _ in counts.gaps] == pytest.approx(np.arange(149, 249) + 0.79)
    assert counts.lines()[1] == "gaps 249, longest 0.81 s"
