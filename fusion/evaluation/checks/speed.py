"""Speed of filter, network and whole run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.evaluation.compare import DEMONSTRATION_SEED, demonstration
from stario.fusion.navigator import Navigator
from stario.network.model import DisplacementModel
from stario.network.runtime.survey import BATCHES, median_milliseconds
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.datasets.stream_cache import recorded
from stario.sequences.readers import read_recording, write_csv
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk

_RUNS, _NETWORK_RUNS = 5, 30


def speed_report(model: DisplacementModel) -> dict[str, Any]:
    """Measure s per minute of data and ms per window, as medians of interleaved runs."""
    sequence = demonstration()
    minutes = sequence.duration / 60.0
    runs: dict[str, list[float]] = {"run": [], "run_network": [], "filter_20_hz": []}
    default = Navigator(model, NavigatorConfig())
    at_20_hz = NavigatorConfig(filter=FilterConfig(update_rate=20))
    fast = Navigator(model, at_20_hz, backend="ekf")
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
    network = "network, batch {batch}: {model:.3f} ms/window (in PyTorch: {torch:.3f})"
    lines = [
        "filter, 20 updates/s, preintegration included: {filter_s_per_min_20_hz:.3f} s/min",
        "whole run at {update_rate_hz} updates/s: {run_s_per_min:.3f} s/min, "
        "of which network {run_network_s_per_min:.3f} s/min",
        "training windows: {windows_built_s_per_hour:.2f} s per hour of data from CSV, "
        "{windows_cached_s_per_hour:.3f} s from the cache, one process",
        "push: {push_us_median:.1f} us (median), "
        f"{report['push_us_with_update_p99'] / 1e3:.1f} ms with a network update (99th percentile)",
    ]
    shown = [line.format(**report) for line in lines]
    return "\n".join([*shown, *(network.format(**speed) for speed in report["network"])])


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    began = perf_counter()
    result = work()
    return perf_counter() - began, result
