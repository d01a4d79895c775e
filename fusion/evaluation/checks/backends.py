"""Filter against graph: accuracy, speed and latency; the speed of network, stream and training."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, get_args

import numpy as np
import pandas as pd

from stario.fusion.backends import BackendName
from stario.fusion.evaluation.checks.faults import (
    DummyPredictor,
    matched_config,
    with_true_displacements,
)
from stario.fusion.evaluation.compare import DEMONSTRATION_SEED, TRACK_OF, demonstration
from stario.fusion.evaluation.scores import Column, parts, scored, table, wide
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.filter import estimator
from stario.fusion.filter.record import innovations_of
from stario.fusion.graph.fixed_lag import FixedLag
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.recording import PreprocessedRecording
from stario.fusion.values.config import FilterConfig, NavigatorConfig
from stario.fusion.values.state import Track, track_from_states
from stario.network.model import DisplacementModel
from stario.network.runtime.survey import BATCHES, median_milliseconds
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.accuracy.metrics import evaluate_track
from stario.sequences.accuracy.nees import position_nees
from stario.sequences.datasets.stream_cache import recorded
from stario.sequences.noise import ImuNoise
from stario.sequences.readers import read_recording, write_csv
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, ImuErrors, simulate_imu
from stario.sequences.simulation.walks import generate_walk

ESTIMATORS = {"filtered": "filtered", "track": "track", "fixed_lag": "fixed-lag"}
"""The filter's track, that of the graph of the whole recording, and the newest states of the
fixed-lag graph."""

DISPLACEMENT_NOISE = 0.03
"""White noise of the simulated displacements, per axis [m]."""

_RUNS, _NETWORK_RUNS = 5, 30

_FIELDS = {"ate_m": "ATE [m]", "nees": "NEES", "s_per_min": "s/min"}
"""Figures of a recording: error as `compare` measures it, median position NEES (expected: 2.4), and
processor time [s] per minute of data without the network."""

_SLOWEST = Column("slowest [ms]", "slowest_ms", ".1f")

_COLUMNS = (
    *(
        Column(f"{title} {words}", metric, ".3f", np.median, {"track": name})
        for metric, words in _FIELDS.items()
        for name, title in ESTIMATORS.items()
    ),
    _SLOWEST,
)


def score_walk(seed: int, seconds: float) -> pd.DataFrame:
    """Score a simulated walk, measured once a second by its displacements with white noise.

    The sensor has the white noise of `ImuNoise` and a phone's biases, no other errors; the
    estimators are given the exact standard deviations. Person and carry are drawn at random.
    """
    errors = ImuErrors(
        noise=ImuNoise(),
        gyro_turn_on=PHONE_IMU.gyro_turn_on,
        accel_turn_on=PHONE_IMU.accel_turn_on,
    )
    config = matched_config(errors)
    config = replace(config, filter=replace(config.filter, update_rate=1))
    walk = generate_walk(seed, seconds)
    sequence = simulate_imu(walk, 200.0, errors, seed, name=f"walk {seed}")
    preprocessed = Navigator(DummyPredictor(), config).observe(sequence)
    preprocessed = with_true_displacements(preprocessed, walk, config, seed, DISPLACEMENT_NOISE)
    return _scored(sequence.name, preprocessed, walk, config)


def score_recording(
    model: Predictor, sequence: ImuSequence, config: NavigatorConfig
) -> pd.DataFrame:
    """Score a recording, measured by a network.

    Raises:
        InputError: it has no true poses, is too short, or its units or rate are wrong.
    """
    truth = true_poses(sequence)
    preprocessed = Navigator(model, config).observe(sequence)
    return _scored(sequence.name, preprocessed, truth, config)


def summary(scores: pd.DataFrame) -> dict[str, object]:
    """Return medians over recordings, and errors relative to the filter's, as plain values.

    Ratios are geometric means with their standard errors, without which two similar estimators seem
    to differ: the ratio of their medians changes by a tenth with another twenty walks.
    """
    table = wide(scores).set_index(["recording", "track"])[[*_FIELDS]].unstack("track")
    medians, errors = table.median(), table["ate_m"]
    logs = np.log(errors.div(errors["filtered"], axis=0))
    ratios = np.exp(logs.mean())
    figures = {
        "median_ate_m": medians["ate_m"],
        "median_ate_to_filtered": medians["ate_m"] / medians["ate_m"]["filtered"],
        "mean_ratio_to_filtered": ratios,
        "mean_ratio_error": ratios * logs.sem().fillna(0.0),
        "median_nees": medians["nees"],
        "s_per_min": medians["s_per_min"],
    }
    return {
        "recordings": len(errors),
        **{name: found[[*ESTIMATORS]].to_dict() for name, found in figures.items()},
        "slowest_update_ms": replace(_SLOWEST, over=np.max).value(scores),
    }


def score_table(scores: pd.DataFrame) -> str:
    """Return the scores as text."""
    found: Any = summary(scores)
    to_filtered, mean, error = (
        found[name]
        for name in ("median_ate_to_filtered", "mean_ratio_to_filtered", "mean_ratio_error")
    )
    others = [name for name in ESTIMATORS if name != "filtered"]
    ratios = [f"{ESTIMATORS[name]} {to_filtered[name]:.2f}" for name in others]
    means = [f"{ESTIMATORS[name]} {mean[name]:.2f} +- {error[name]:.2f}" for name in others]
    notes = (
        f"median ATE relative to filtered: {', '.join(ratios)}; "
        f"geometric mean over recordings: {', '.join(means)}",
        f"fixed-lag {60.0 / found['s_per_min']['fixed_lag']:.0f} times real time, slowest update "
        f"{found['slowest_update_ms']:.1f} ms",
    )
    rows = [*parts(scores, "recording", whole=None), ("median", scores)]
    return table(rows, _COLUMNS, ("",), notes)


def _scored(
    name: str, preprocessed: PreprocessedRecording, truth: Trajectory, config: NavigatorConfig
) -> pd.DataFrame:
    tracks: dict[str, Track] = {}
    seconds: dict[str, float] = {}
    for backend in get_args(BackendName):
        navigator = Navigator(DummyPredictor(), config, backend=backend)
        began = process_time()
        tracks[TRACK_OF[backend]] = navigator.track(preprocessed)
        seconds[TRACK_OF[backend]] = process_time() - began
    tracks["fixed_lag"], times = _streamed(preprocessed, config)
    seconds["fixed_lag"] = float(times.sum())
    duration = float(tracks["filtered"].time[-1] - tracks["filtered"].time[0])
    figures = {
        name: {
            "ate_m": evaluate_track(track.trajectory, truth).ate_m,
            "nees": position_nees(track.trajectory, truth).median,
            "s_per_min": 60.0 * seconds[name] / duration,
            "duration_s": duration,
        }
        for name, track in tracks.items()
    }
    figures["fixed_lag"]["slowest_ms"] = 1e3 * float(times.max())
    return scored(name, figures)


def _streamed(
    preprocessed: PreprocessedRecording, config: NavigatorConfig
) -> tuple[Track, FloatArray]:
    """Return the newest states of the fixed-lag graph, and the processor time of each step [s]."""
    filtered = estimator.begin(config, preprocessed.start, streaming=True)
    graph = FixedLag(filtered, config)
    states, times = [graph.nav_state(filtered)], []
    pairs = zip(preprocessed.intervals, preprocessed.measurements, strict=True)
    for interval, measurement in pairs:
        began = process_time()
        filtered, record = estimator.step(filtered, interval, measurement, (), config)
        graph.step(filtered, record)
        states.append(graph.nav_state(filtered))
        times.append(process_time() - began)
    health = filtered.health(preprocessed.counts, config.filter, states[-1])
    track = replace(track_from_states(states), innovations=innovations_of([]), health=health)
    return track, np.array(times)


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
