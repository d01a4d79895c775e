"""A network that raises an error or predicts other shapes: the caller sees it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import GRAPH as CONFIG
from support import stream

from stario.fusion import Navigator
from stario.sequences.errors import InputError


class Failing:
    """Raises an error instead of some predictions."""

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
    oracle = make_oracle(walk, walk.truth, CONFIG)
    expected = {state.time: state.p_W for state in stream(Navigator(oracle, CONFIG), walk)}
    navigator = Navigator(Failing(oracle, {5, 6, 20}), CONFIG, backend=backend)
    states, failures = [], 0
    for sample in zip(walk.time, walk.gyro, walk.accel, strict=True):
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
    config = replace(CONFIG, filter=replace(CONFIG.filter, update_rate=10))
    walk = walk.slice(0.0, 12.0)
    holed = without(walk, (walk.time > 10.055) & (walk.time < 10.205))
    samples = list(zip(holed.time, holed.gyro, holed.accel, strict=True))
    oracle = make_oracle(holed, walk.truth, config)
    whole = Navigator(Failing(oracle, set()), config)
    calls = []
    for sample in samples:
        calls.append(whole.model.calls)
        whole.push(*sample)
    (k,) = np.flatnonzero(np.diff(calls) == 2)
    navigator = Navigator(Failing(oracle, {calls[k] + 1}), config)
    for sample in samples[:k]:
        navigator.push(*sample)
    with pytest.raises(RuntimeError, match="out of memory"):
        navigator.push(*samples[k])
    for sample in samples[k + 1 :]:
        navigator.push(*sample)
    assert navigator.model.calls == whole.model.calls
    assert navigator.state.time == whole.state.time
    assert np.linalg.norm(navigator.state.p_W - whole.state.p_W) < 0.01


def zeros(count: int) -> np.ndarray:
    return np.zeros((count, 3))


def variances(count: int) -> np.ndarray:
    return np.tile(0.01 * np.eye(3), (count, 1, 1))


@pytest.mark.parametrize(
    ("predict", "named"),
    [
        (lambda n: None, "NoneType"),
        (lambda n: zeros(n), "ndarray"),
        (lambda n: (zeros(n), 0.01 * np.ones((n, 3))), r"covariances \(\d+, 3, 3\)"),
        (lambda n: (zeros(n)[:, :2], variances(n)), r"displacements \(\d+, 3\)"),
        (lambda n: (zeros(1), variances(1)), r"shapes \(1, 3\)"),  # would be every window's
        (lambda n: (zeros(n), variances(n) + np.triu(np.ones((3, 3)), 1)), "asymmetric"),
    ],
)
def test_predictions_of_other_shapes_are_refused(walk, predict, named):
    class Custom:
        def predict(self, windows):
            return predict(len(windows))

    with pytest.raises(InputError, match=f"model.*{named}"):
        Navigator(Custom(), backend="ekf").run(walk.slice(0.0, 4.0))


def test_predictions_may_be_lists(walk):
    class Custom:
        def predict(self, windows):
            return zeros(len(windows)).tolist(), variances(len(windows)).tolist()

    track = Navigator(Custom(), backend="ekf").run(walk.slice(0.0, 4.0))
    assert track.health.updates > 0
