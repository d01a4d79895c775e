"""A network that remembers earlier windows gives the same track in a stream as in a batch."""

from __future__ import annotations

import numpy as np
import pytest

from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.evaluation.tracks import network_track_true_attitude
from stario.fusion.imu.stateful import StatefulInference
from stario.fusion.navigator import Navigator
from stario.fusion.recording import cut_recording
from stario.sequences.errors import InputError


class Counting:
    """Predicts one metre upwards per window in its memory, separately for each series."""

    def predict(self, windows):
        raise AssertionError("a network with memory must be called through `stateful_inference`")

    def stateful_inference(self, updates):
        return _Series(updates)


class _Series:
    def __init__(self, updates):
        self.counts, self.index = [0] * updates, 0

    def predict(self, windows):
        mean = np.zeros((len(windows), 3))
        for k in range(len(windows)):
            mean[k, 2] = self.counts[self.index % len(self.counts)]
            self.counts[self.index % len(self.counts)] += 1
            self.index += 1
        return mean, np.tile(np.eye(3), (len(windows), 1, 1))

    @property
    def memory(self):
        return self.index, tuple(self.counts)

    @memory.setter
    def memory(self, memory):
        self.index, self.counts = memory[0], list(memory[1])


def with_gap(walk, without):
    return without(walk, (walk.time - walk.time[0] > 8.0) & (walk.time - walk.time[0] < 9.0))


@pytest.mark.parametrize("rate", [1, 5])
def test_memory_is_kept_between_gaps_separately_for_each_series(walk, without, rate) -> None:
    config = NavigatorConfig(filter=FilterConfig(update_rate=rate))
    preprocessed = Navigator(Counting(), config).observe(with_gap(walk, without))
    stretches, all_counts = [[]], []
    for interval, measurement in zip(
        preprocessed.intervals, preprocessed.measurements, strict=True
    ):
        if interval.gap:
            stretches.append([])
        if measurement is not None:
            stretches[-1].append(measurement.d_N[2])
    assert len(stretches) == 2
    for stretch in stretches:
        assert stretch == pytest.approx([k // rate for k in range(len(stretch))])
        all_counts += stretch
    assert len(all_counts) > 15 * rate


def test_a_stream_equals_the_batch_also_after_a_restore(walk, without) -> None:
    sequence = with_gap(walk, without)
    track = Navigator(Counting(), backend="ekf").run(sequence).trajectory
    navigator = Navigator(Counting())
    states = []
    for k, sample in enumerate(zip(sequence.time, sequence.gyro, sequence.accel, strict=True)):
        if k == 700:
            navigator, data = Navigator(Counting()), navigator.snapshot()
            navigator.restore(data)
        state = navigator.push(*sample)
        if state is not None:
            states.append(state)
    at = np.searchsorted(track.time, [s.time for s in states])
    np.testing.assert_allclose([s.p_W for s in states], track.position_W[at], atol=1e-6)


def test_the_track_with_true_attitude_uses_memory_too(walk) -> None:
    config = NavigatorConfig(filter=FilterConfig(update_rate=1))
    track = network_track_true_attitude(Counting(), walk, config)
    speed = track.trajectory.velocity_W[:, 2]
    assert (np.diff(speed) >= 0.0).all()
    assert speed[-1] == pytest.approx(len(track.trajectory.time) - 2)


def test_a_model_without_memory_is_called_directly(still_model) -> None:
    network = StatefulInference(still_model, 10)
    assert not network.is_recurrent
    assert network.memory is None
    with pytest.raises(InputError, match="memory"):
        network.memory = (1, (1,))


class Walking:
    """Predicts 1.5 m ahead for every window, with a sigma of 1 cm per axis."""

    def predict(self, windows):
        n = len(windows)
        return np.tile([1.5, 0.0, 0.0], (n, 1)), np.tile(1e-4 * np.eye(3), (n, 1, 1))


def test_slopes_and_missing_samples_make_displacements_less_certain(walk, without) -> None:
    """A floor of unknown slope (0.03) the height, missing samples all axes: sigma is doubled."""
    holed = without(walk, (walk.time > 6.0) & (walk.time < 6.1))
    measurements = Navigator(Walking(), NavigatorConfig()).observe(holed).measurements
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
