"""Speed of filter, network and whole run, and what the filter's structured algebra saves."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.evaluation.compare import DEMONSTRATION_SEED, demonstration
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.jacobians import ACTUAL, ASSUMED, CORE, Block
from stario.fusion.imu.preintegration import preintegrate
from stario.fusion.navigator import Navigator
from stario.fusion.state import NavState
from stario.network.model import DisplacementModel
from stario.network.runtime.survey import BATCHES, median_milliseconds
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.datasets.stream_cache import recorded
from stario.sequences.noise import ImuNoise
from stario.sequences.readers import read_recording, write_csv
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk

_RUNS, _NETWORK_RUNS = 5, 30

_ENGINE_RUNS = 9
"""Number of runs of each engine, alternating; the fastest counts: other load only adds to it."""

_DURATION, _IMU_RATE, _UPDATE_RATE, _WINDOW = 5.0, 200.0, 20.0, 1.0
"""Data for the engines: duration [s], IMU rate [Hz], update rate [Hz] and window length [s]."""


class DenseEkf(StateCloningEkf):
    """The same filter using filterpy's own `predict` and `update` on the full matrices."""

    def _propagated(
        self, covariances: FloatArray, transition: FloatArray, noise: FloatArray
    ) -> FloatArray:
        actual = super()._propagated(covariances, transition, noise)[ACTUAL]
        self.F[:CORE, :CORE] = transition
        self.Q[:CORE, :CORE] = noise[ASSUMED]
        self.predict()
        return np.stack([self.P, actual])

    def _with_gain(
        self, blocks: Sequence[Block], R: FloatArray, HP: FloatArray, S: FloatArray
    ) -> FloatArray:
        actual, before = super()._with_gain(blocks, R, HP, S)[ACTUAL], self.covariances
        H = np.zeros((R.shape[1], self.dim_x))
        for first, block in blocks:
            H[:, first : first + block.shape[1]] = block
        self.x = np.zeros_like(self.x)  # filterpy finds the gain and moves it again
        self.update(self.z, lambda x: H, lambda x: H @ x)
        P, self.covariances = self.P, before
        return np.stack([P, actual])


def engine_speed() -> tuple[float, float]:
    """Return processor times [s] per minute of data: `StateCloningEkf` and `DenseEkf`.

    They run on a device that sways in place; preintegration is included, the network is not.
    """
    rng = np.random.default_rng(0)
    per_segment, per_window = round(_IMU_RATE / _UPDATE_RATE), round(_UPDATE_RATE * _WINDOW)
    n = round(_DURATION * _UPDATE_RATE) * per_segment + 1
    time = np.arange(n) / _IMU_RATE
    sway = np.sin(2.0 * np.pi * time)[:, None]
    gyro = sway * [0.5, -0.3, 0.8] + rng.normal(0.0, 0.01, (n, 3))
    accel = np.array([0.0, 0.0, STANDARD_GRAVITY]) + sway + rng.normal(0.0, 0.1, (n, 3))
    displacements = rng.normal(0.0, 0.1, (n // per_segment, 3))
    noise, covariance, zero = ImuNoise(), np.eye(3) * 0.01 * per_window, np.zeros(3)

    def run(ekf: StateCloningEkf) -> None:
        ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, np.eye(CORE) * 1e-4))
        clones = [ekf.clone()]
        for k, displacement in enumerate(displacements):
            part = slice(k * per_segment, (k + 1) * per_segment + 1)
            samples, state = (time[part], gyro[part], accel[part]), ekf.state
            ekf.propagate(preintegrate(*samples, state.b_g, state.b_a, noise, STANDARD_GRAVITY))
            clones.append(ekf.clone())
            if len(clones) > per_window:
                ekf.update_displacement(clones[0], displacement, covariance, gate=16.3)
                ekf.release(clones.pop(0))

    engines = [kind(per_window + 1) for kind in (StateCloningEkf, DenseEkf)]
    seconds = [
        [_timed(partial(run, ekf), process_time)[0] for ekf in engines] for _ in range(_ENGINE_RUNS)
    ]
    structured, dense = (np.min(seconds, axis=0) * 60.0 / _DURATION).tolist()
    return structured, dense


def speed_report(model: DisplacementModel) -> dict[str, Any]:
    """Measure s per minute of data and ms per window, as medians of interleaved runs."""
    structured, dense = engine_speed()
    sequence = demonstration()
    minutes = sequence.duration / 60.0
    runs: dict[str, list[float]] = {"run": [], "run_network": [], "filter_20_hz": []}
    default = Navigator(model, NavigatorConfig())
    fast = Navigator(model, NavigatorConfig(filter=FilterConfig(update_rate=20)))
    preprocessed = fast.observe(sequence)
    for _ in range(_RUNS):
        seconds, track = _timed(lambda: default.run(sequence))
        runs["run"].append(seconds / minutes)
        runs["run_network"].append(track.seconds_network / minutes)
        seconds, _track = _timed(lambda: fast.track(preprocessed))
        runs["filter_20_hz"].append(seconds / minutes)
    forms = [model.engine, TorchEngine(model.training_form)]
    medians = {name: float(np.median(values)) for name, values in runs.items()}
    return {
        "filter_s_per_min_20_hz": medians["filter_20_hz"],
        "filter_engine_s_per_min_20_hz": structured,
        "filter_engine_dense_s_per_min_20_hz": dense,
        "filter_engine_ratio": dense / structured,
        "run_s_per_min": medians["run"],
        "run_network_s_per_min": medians["run_network"],
        **push_speed(model),
        "update_rate_hz": default.config.filter.update_rate,
        **windows_speed(),
        "network": [
            {"batch": batch, "model": as_run, "torch": in_torch}
            for batch in BATCHES
            for as_run, in_torch in [median_milliseconds(forms, batch, _NETWORK_RUNS).tolist()]
        ],
    }


def windows_speed() -> dict[str, float]:
    """Time reading training windows from a CSV and from the cache, in s per hour of data."""
    sequence = simulate_imu(generate_walk(DEMONSTRATION_SEED, duration=600.0), 200.0, PHONE_IMU)
    hours = sequence.duration / 3600.0
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "walk.csv"
        write_csv(path, sequence)
        runs = [
            _timed(lambda: list(recorded([path], read_recording, {}, Path(name) / "cache")))[0]
            for _ in range(1 + _RUNS)
        ]
    return {
        "windows_built_s_per_hour": runs[0] / hours,
        "windows_cached_s_per_hour": float(np.median(runs[1:])) / hours,
    }


def push_speed(model: DisplacementModel) -> dict[str, float]:
    """Time one `push` [us]: without a state (median), with a network update (99th percentile)."""
    sequence = demonstration()
    navigator = Navigator(model, NavigatorConfig())
    plain, with_update = [], []
    rows = zip(sequence.time.tolist(), sequence.gyro.tolist(), sequence.accel.tolist(), strict=True)
    updates = 0
    for row in rows:
        began = perf_counter()
        state = navigator.push(*row)
        seconds = perf_counter() - began
        if state is None:
            plain.append(seconds)
        elif navigator.health.updates > updates:
            updates = navigator.health.updates
            with_update.append(seconds)
    return {
        "push_us_median": 1e6 * float(np.median(plain)),
        "push_us_with_update_p99": 1e6 * float(np.percentile(with_update, 99)),
    }


def speed_table(report: dict[str, Any]) -> str:
    """Return the report as text."""
    lines = [
        "filter, 20 updates/s, preintegration included: {filter_s_per_min_20_hz:.3f} s/min",
        "its engine alone: {filter_engine_s_per_min_20_hz:.3f} s/min",
        "the same with filterpy's dense algebra: {filter_engine_dense_s_per_min_20_hz:.3f} s/min "
        "({filter_engine_ratio:.1f} times slower)",
        "whole run at {update_rate_hz} updates/s: {run_s_per_min:.3f} s/min, "
        "of which network {run_network_s_per_min:.3f} s/min",
        "training windows: {windows_built_s_per_hour:.2f} s per hour of data from CSV, "
        "{windows_cached_s_per_hour:.3f} s from the cache, one process",
        "push: {push_us_median:.1f} us (median), "
        "{push_ms:.1f} ms with a network update (99th percentile)",
    ]
    network = "network, batch {batch}: {model:.3f} ms/window (in PyTorch: {torch:.3f})"
    push_ms = report["push_us_with_update_p99"] / 1e3
    return "\n".join(
        [
            *(line.format(**report, push_ms=push_ms) for line in lines),
            *(network.format(**speed) for speed in report["network"]),
        ]
    )


def _timed(work: Callable[[], Any], clock: Callable[[], float] = perf_counter) -> tuple[float, Any]:
    began = clock()
    result = work()
    return clock() - began, result
