"""Any sequence of faults leaves finite states, valid covariances and increasing times."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, NavState
from stario.sequences.errors import InputError

CONFIG = NavigatorConfig(filter=FilterConfig(update_rate=5))
RATE = 50.0
GRAVITY = np.array([0.0, 0.0, 9.8])

EYE = np.eye(3)


def meaningless(n: Navigator, at: float, size: float) -> None:
    n.update_position(at, [np.nan, size, 0.0], EYE)
    n.update_velocity(at, np.zeros(3), -EYE)
    n.update_yaw(np.inf, size, 0.0)


FIXES: dict[str, Callable[[Navigator, float, float], object]] = {
    "position": lambda n, at, s: n.update_position(at + 0.3 + s, [10.0 * s, 5.0, 0.0], 0.1 * EYE),
    "position far off": lambda n, at, s: n.update_position(at, 5e6 * s * np.ones(3), 1e-4 * EYE),
    "late yaw": lambda n, at, s: n.update_yaw(at, 4.0 * s, 0.1),
    "old velocity": lambda n, at, s: n.update_velocity(
        at - 3.0 * abs(s), [1.0, s, 0.0], 0.01 * EYE
    ),
    "fix without meaning": meaningless,
}
FAULTS = (
    *("fine", "not finite", "gap", "long gap", "duplicate", "back in time"),
    *("wild time", "wild times in a row", "spike", "saturated", "free fall"),
    *("network not finite", "network far off", "network too sure", "covariance without meaning"),
    *(*FIXES, "restored"),
)

FAULT = st.tuples(st.sampled_from(FAULTS), st.integers(1, 60), st.floats(-1.0, 1.0))
WALK = st.lists(FAULT, min_size=3, max_size=12)


class FaultyNetwork:
    """A network whose predictions depend on the current fault."""

    fault, size = "", 0.0

    def predict(self, windows):
        n = len(windows)
        mean = np.tile([0.5, 0.0, 0.0], (n, 1))
        covariance = np.tile(0.01 * np.eye(3), (n, 1, 1))
        if self.fault == "network not finite":
            mean[:] = np.nan if self.size > 0.0 else np.inf
        elif self.fault == "network far off":
            mean += 1e3 * self.size
        elif self.fault == "network too sure":
            covariance *= 1e-12
        elif self.fault == "covariance without meaning":
            covariance *= np.nan if self.size > 0.5 else -1.0
        return mean, covariance


class Stream:
    def __init__(self, backend: str) -> None:
        self.model = FaultyNetwork()
        self.backend: Any = backend
        self.navigator = Navigator(self.model, CONFIG, backend=self.backend)
        self.rng = np.random.default_rng(0)
        self.now = 0.0
        self.newest = -np.inf

    def push(self, time: float, gyro: Any, accel: Any) -> None:
        state = self.navigator.push(time, gyro, accel)
        if state is not None:
            assert state.time > self.newest
            self.newest = state.time
            assert_valid(state)

    def samples(self, count: int, fault: str, size: float) -> None:
        for _ in range(count):
            self.now += 1.0 / RATE
            gyro = self.rng.normal(0.0, 0.3, 3)
            accel = self.rng.normal(GRAVITY, 1.0)
            time = self.now
            if fault == "not finite":
                (gyro if size > 0.0 else accel)[0] = np.nan if size > 0.5 else np.inf
            elif fault == "duplicate":
                self.push(time, gyro, accel)
            elif fault == "back in time":
                time -= 3.0 * abs(size)
            elif fault == "spike":
                gyro[1] += 400.0 * size
                accel[2] += 900.0 * size
            elif fault == "saturated":
                accel = np.clip(3.0 * accel, -20.0, 20.0)
            elif fault == "free fall":
                accel[:] = 0.0
            self.push(time, gyro, accel)

    def inject(self, fault: str, count: int, size: float) -> None:
        self.model.fault, self.model.size = fault, size
        if fault == "gap":
            self.now += 5.0 * abs(size)
        elif fault == "long gap":
            self.now += 10.0 + 1e5 * abs(size)
        elif fault.startswith("wild time"):
            for k in range(1 if fault == "wild time" else 4):
                self.push(self.now + 1e6 * abs(size) + 20.0 + k, np.zeros(3), np.zeros(3))
        elif fault in FIXES:
            FIXES[fault](self.navigator, self.now - 0.3, size)
        elif fault == "restored":
            data = self.navigator.snapshot()
            self.navigator = Navigator(self.model, CONFIG, backend=self.backend)
            self.navigator.restore(data)
        self.samples(count, fault, size)
        if self.navigator.state is not None:
            assert_valid(self.navigator.state)


def assert_valid(state: NavState) -> None:
    for name in ("time", "R_WB", "v_W", "p_W", "b_g", "b_a", "covariance"):
        assert np.isfinite(getattr(state, name)).all(), name
    np.testing.assert_allclose(state.R_WB @ state.R_WB.T, np.eye(3), atol=1e-6)
    sigma = np.sqrt(np.maximum(np.diag(state.covariance), 1e-300))
    assert np.linalg.eigvalsh(state.covariance / np.outer(sigma, sigma)).min() > -1e-6


@pytest.mark.parametrize("backend", ["ekf", "graph"])
@pytest.mark.parametrize("examples", [6, pytest.param(200, marks=pytest.mark.slow)])
def test_no_sequence_of_faults_breaks_a_stream(backend, examples):
    @settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    @given(WALK)
    def run(walk):
        stream = Stream(backend)
        try:
            stream.samples(80, "fine", 0.0)
            for fault, count, size in walk:
                stream.inject(fault, count, size)
        except InputError as error:
            # The only error that a stream of samples may raise: no gravity in its first second.
            assert "first second" in str(error)  # noqa: PT017
        health = stream.navigator.health
        assert health.lines()
        assert sum(health.samples.values()) > 0

    run()
