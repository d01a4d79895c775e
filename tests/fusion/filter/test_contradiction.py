"""Displacements that contradict the filter: a steady error of theirs is a state until one fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import stream

from stario.fusion import Navigator
from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.evaluation.checks.corruption import faults
from stario.fusion.evaluation.checks.faults import matched_walk, run_faults
from stario.fusion.evaluation.scores import wide
from stario.fusion.filter.contradiction import Contradiction
from stario.fusion.filter.displacements import update_with
from stario.fusion.filter.ekf import clone, initialised
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.innovations import InnovationStatistics
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.state import NavState
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk

SECONDS = 120.0


# Walks in which a filter without that state followed the last false displacements and then gated
# the correct ones: errors of 2.4, 2.9 and 3.4 m.
@pytest.mark.parametrize(
    "seed", [pytest.param(5, marks=pytest.mark.slow), pytest.param(7, marks=pytest.mark.slow), 10]
)
def test_five_seconds_of_false_displacements_leave_no_lasting_error(seed: int) -> None:
    [block] = [fault for fault in faults(SECONDS) if fault.name == "network off by 1 m for 5 s"]
    sequence, config = matched_walk(SECONDS, seed)
    [result] = wide(
        run_faults(sequence, config, seed=seed, backends=("ekf",), only=[block])
    ).itertuples()
    assert result.error_with < result.error_without + 0.3


# With the default noise, which trusts the accelerometer little: errors of 2.6 to 3.6 m if false
# displacements are dropped instead of telling how the velocity changes.
@pytest.mark.parametrize(
    ("seed", "backend", "limit"),
    [
        pytest.param(1, "ekf", 0.3, marks=pytest.mark.slow),
        (2, "ekf", 0.3),
        pytest.param(2, "graph", 0.35, marks=pytest.mark.slow),
    ],
)
def test_five_false_seconds_leave_no_lasting_error_with_the_default_noise(
    seed: int, backend: str, limit: float
) -> None:
    [block] = [fault for fault in faults(SECONDS) if fault.name == "network off by 1 m for 5 s"]
    sequence, _ = matched_walk(SECONDS, seed)
    [result] = wide(
        run_faults(sequence, NavigatorConfig(), seed=seed, backends=(backend,), only=[block])
    ).itertuples()
    assert result.error_with < result.error_without + limit


def test_the_last_false_displacement_is_not_taken_for_right() -> None:
    """In this walk the velocity is by then so uncertain that it fits as well."""
    [block] = [fault for fault in faults(SECONDS) if fault.name == "network off by 1 m for 5 s"]
    walk = generate_walk(4, SECONDS)
    sequence = simulate_imu(walk, 200.0, PHONE_IMU, 4)
    [result] = wide(
        run_faults(sequence, NavigatorConfig(), backends=("graph",), only=[block])
    ).itertuples()
    assert result.error_with < result.error_without + 0.35


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_stream_forgets_false_displacements_too(
    make_walk: Callable[..., ImuSequence], make_oracle: Callable[..., Any], backend: Any
) -> None:
    walk = make_walk(1, 30.0)
    oracle = make_oracle(walk, walk.truth, NavigatorConfig(), noise=0.02, sigma=0.05)
    ends = []
    for first, stop in ((0, 0), (20, 30)):  # none, or five seconds
        navigator = Navigator(OffByOneMetre(oracle, first, stop), backend=backend)
        ends.append(stream(navigator, walk)[-1].p_W)
    assert np.linalg.norm(ends[1] - ends[0]) < 1.0


def test_single_false_displacements_do_not_widen_the_gyro_bias_prior() -> None:
    """The bias varies as much as its prior allows: taken as evidence, that cost 5.5 m."""
    [single] = [fault for fault in faults(SECONDS) if fault.name == "5 % of windows off by 2 m"]
    sequence, config = matched_walk(SECONDS, seed=9)
    adaptive = replace(config, filter=replace(config.filter, adaptive=True))
    [result] = wide(
        run_faults(sequence, adaptive, seed=9, backends=("ekf",), only=[single])
    ).itertuples()
    assert result.error_with < result.error_without + 0.3


class OffByOneMetre:
    """An oracle whose predictions number `first` to `stop` - 1 are off by 1 m."""

    def __init__(self, inner: Any, first: int, stop: int) -> None:
        self.inner, self.first, self.stop, self.count = inner, first, stop, 0

    def predict(self, windows: Any) -> Any:
        mean, covariance = self.inner.predict(windows)
        for k in range(len(mean)):
            if self.first <= self.count < self.stop:
                mean[k, 0] += 1.0
            self.count += 1
        return mean, covariance


NOISE = ImuNoise(gyro_noise=2e-3, accel_noise=0.02, gyro_walk=3e-5, accel_walk=1e-4)
CONFIG = NavigatorConfig(
    NOISE, FilterConfig(covariance_scale=1.0, gyro_bias_sigma=3e-3, accel_bias_sigma=0.05)
)


def test_a_snapshot_includes_the_contradiction(
    make_walk: Callable[..., ImuSequence], make_oracle: Callable[..., Any]
) -> None:
    walk = make_walk(1, 60.0)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.02)
    parts = [walk.slice(0.0, 52.0 - 1e-9), walk.slice(52.0, 60.0)]
    model = OffByOneMetre(oracle, 98, 106)
    whole = Navigator(model, CONFIG)
    stream(whole, parts[0])
    # The false displacements have not ended yet.
    state = whole._stream.state
    assert state is not None
    assert state.contradiction is not None
    second_model = OffByOneMetre(oracle, 98, 106)
    second_model.count = model.count
    resumed = Navigator(second_model, CONFIG)
    resumed.restore(whole.snapshot())
    for ours, theirs in zip(stream(whole, parts[1]), stream(resumed, parts[1]), strict=True):
        np.testing.assert_array_equal(ours.p_W, theirs.p_W)


def displacement(d_N: np.ndarray, sigma: float = 0.1) -> WindowDisplacement:
    return WindowDisplacement(d_N, sigma**2 * np.eye(3), np.eye(3))


def contradicted(velocity_sigma: float) -> tuple[EkfState, Contradiction]:
    """A device at rest whose displacements have been off by 1 m since five seconds."""
    zero = np.zeros(3)
    P = np.diag(np.repeat([1e-4, velocity_sigma**2, 1e-4, 1e-8, 1e-4], 3))
    s = clone(initialised(NavState(10.0, np.eye(3), zero, zero, zero, zero, P), 1))
    s = replace(s.with_offset_widened(0.01), offset_W=OFFSET_W)
    return s, Contradiction((5.0,))


OFFSET_W = np.array([1.0, 0.0, 0.0])
F, STATISTICS = FilterConfig(), InnovationStatistics(outlier_share=0.0)


def test_an_outlier_opens_a_steady_error_and_moves_nothing() -> None:
    s, _ = contradicted(0.1)
    s = s.without_offset()
    opened = update_with(displacement(5.0 * OFFSET_W), s, None, STATISTICS, F)
    assert opened.result.gated
    assert not opened.fits
    assert opened.contradiction is not None
    assert np.linalg.norm(opened.ekf.p_W) < 0.05
    np.testing.assert_allclose(opened.ekf.offset_W, 5.0 * OFFSET_W, atol=0.2)


def test_a_filter_that_calls_many_displacements_false_may_itself_be_wrong() -> None:
    s, _ = contradicted(0.1)
    doubtful = InnovationStatistics(outlier_share=0.5)
    far = update_with(displacement(5.0 * OFFSET_W), s.without_offset(), None, doubtful, F)
    assert far.contradiction is None
    assert far.result.scale > 1.0


@pytest.mark.parametrize("velocity_sigma", [0.1, 1.0])
def test_a_displacement_that_fits_ends_it_and_one_that_shares_the_error_does_not(
    velocity_sigma: float,
) -> None:
    """However uncertain the velocity is by then, so that either would fit."""
    s, contradiction = contradicted(velocity_sigma)
    right = update_with(displacement(np.zeros(3)), s, contradiction, STATISTICS, F)
    assert right.contradiction is None
    assert right.revoked == (5.0,)
    assert not right.ekf.offset_W.any()
    false = update_with(displacement(OFFSET_W), s, contradiction, STATISTICS, F)
    assert false.contradiction is not None
    assert false.contradiction.times == (5.0, 10.0)
    # Less the error, both are zero.
    for after in (right, false):
        np.testing.assert_allclose(after.ekf.v_W, 0.0, atol=0.05)


def test_an_error_that_lasts_was_the_filters() -> None:
    """After six seconds the displacements are believed."""
    s, _ = contradicted(0.1)
    s = replace(s, clone_times=(9.0,))
    late = update_with(displacement(OFFSET_W), s, Contradiction((3.9,)), STATISTICS, F)
    assert late.contradiction is None
    assert late.revoked == ()
    assert late.fits
    assert not late.ekf.offset_W.any()
    assert not late.ekf.P[late.ekf.offset_rows].any()
