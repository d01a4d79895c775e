"""Filter against graph: accuracy, speed and latency, on simulated walks or recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import process_time
from typing import get_args

import numpy as np

from stario.fusion.backends import BackendName
from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.checks.faults import (
    DummyPredictor,
    matched_config,
    with_true_displacements,
)
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.filter.estimator_state import innovations_of
from stario.fusion.graph.fixed_lag import FixedLagEstimator
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.recording import PreprocessedRecording
from stario.fusion.state import Track, track_from_states
from stario.sequences.accuracy.metrics import evaluate_track
from stario.sequences.accuracy.nees import position_nees
from stario.sequences.drawing.text_table import aligned
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, ImuErrors, simulate_imu
from stario.sequences.simulation.walks import generate_walk

ESTIMATORS = ("ekf", "graph", "fixed_lag")
"""The filter, the graph of the whole recording, and the newest states of the fixed-lag graph."""

DISPLACEMENT_NOISE = 0.03
"""White noise of the simulated displacements, per axis [m]."""


@dataclass(frozen=True)
class Score:
    """Results of the estimators on one recording.

    Attributes:
        name: name of the recording.
        duration_s: its length [s].
        ate_m: absolute trajectory error [m] by estimator, as `compare` measures it.
        nees: median position NEES (expected: 2.4) by estimator.
        s_per_min: processor time [s] per minute of data by estimator, without the network.
        slowest_ms: processor time of the fixed-lag graph's slowest update [ms].
    """

    name: str
    duration_s: float
    ate_m: dict[str, float]
    nees: dict[str, float]
    s_per_min: dict[str, float]
    slowest_ms: float


def score_walk(seed: int, seconds: float) -> Score:
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


def score_recording(model: Predictor, sequence: ImuSequence, config: NavigatorConfig) -> Score:
    """Score a recording, measured by a network.

    Raises:
        InputError: it has no true poses, is too short, or its units or rate are wrong.
    """
    truth = true_poses(sequence)
    preprocessed = Navigator(model, config).observe(sequence)
    return _scored(sequence.name, preprocessed, truth, config)


def summary(scores: Sequence[Score]) -> dict[str, object]:
    """Return medians over recordings, and errors relative to the filter's, as plain values."""

    def by_name(values: FloatArray) -> dict[str, float]:
        return dict(zip(ESTIMATORS, values.tolist(), strict=True))

    ate, nees, seconds = (_table(scores, field) for field in _FIELDS)
    medians, (ratios, errors) = np.median(ate, axis=0), _mean_ratios(ate)
    return {
        "recordings": len(scores),
        "median_ate_m": by_name(medians),
        "median_ate_to_ekf": by_name(medians / medians[0]),
        "mean_ratio_to_ekf": by_name(ratios),
        "mean_ratio_error": by_name(errors),
        "median_nees": by_name(np.median(nees, axis=0)),
        "s_per_min": by_name(np.median(seconds, axis=0)),
        "slowest_update_ms": max(score.slowest_ms for score in scores),
    }


def score_table(scores: Sequence[Score]) -> str:
    """Return the scores as text."""
    titles = ("EKF", "graph", "fixed-lag")
    head = [f"{title} {group}" for group in ("ATE [m]", "NEES", "s/min") for title in titles]
    slowest = [[score.slowest_ms] for score in scores]
    figures = np.hstack([*(_table(scores, field) for field in _FIELDS), slowest])
    rows = [(s.name, row) for s, row in zip(scores, figures, strict=True)]
    rows.append(("median", np.median(figures, axis=0)))
    cells = [[name, *(f"{v:.3f}" for v in row[:-1]), f"{row[-1]:.1f}"] for name, row in rows]
    medians, (each, error) = np.median(figures[:, :3], axis=0), _mean_ratios(figures[:, :3])
    ratio, speed = medians / medians[0], 60.0 / np.median(figures[:, 8])
    return "\n".join(
        [
            *aligned([["", *head, "slowest [ms]"], *cells]),
            f"median ATE relative to the EKF's: graph {ratio[1]:.2f}, fixed-lag {ratio[2]:.2f}; "
            f"geometric mean over recordings: graph {each[1]:.2f} +- {error[1]:.2f}, "
            f"fixed-lag {each[2]:.2f} +- {error[2]:.2f}",
            f"fixed-lag {speed:.0f} times real time, slowest update {figures[:, -1].max():.1f} ms",
        ]
    )


_FIELDS = ("ate_m", "nees", "s_per_min")


def _table(scores: Sequence[Score], field: str) -> FloatArray:
    return np.array([[getattr(score, field)[name] for name in ESTIMATORS] for score in scores])


def _mean_ratios(ate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the geometric mean (3,) of the ratios of errors (N, 3) to the EKF's, and its error.

    Without the standard error (3,), two similar estimators seem to differ: the ratio of their
    medians changes by a tenth with another twenty walks.
    """
    logs = np.log(ate / ate[:, :1])
    mean = np.exp(logs.mean(axis=0))
    return mean, mean * logs.std(axis=0) / math.sqrt(max(len(logs) - 1, 1))


def _scored(
    name: str, preprocessed: PreprocessedRecording, truth: Trajectory, config: NavigatorConfig
) -> Score:
    tracks: dict[str, Track] = {}
    seconds: dict[str, float] = {}
    for backend in get_args(BackendName):
        navigator = Navigator(DummyPredictor(), config, backend=backend)
        began = process_time()
        tracks[backend] = navigator.track(preprocessed)
        seconds[backend] = process_time() - began
    tracks["fixed_lag"], times = _streamed(preprocessed, config)
    seconds["fixed_lag"] = float(times.sum())
    duration = float(tracks["ekf"].time[-1] - tracks["ekf"].time[0])
    return Score(
        name=name,
        duration_s=duration,
        ate_m={k: evaluate_track(t.trajectory, truth).ate_m for k, t in tracks.items()},
        nees={k: position_nees(t.trajectory, truth).median for k, t in tracks.items()},
        s_per_min={k: 60.0 * s / duration for k, s in seconds.items()},
        slowest_ms=1e3 * float(times.max()),
    )


def _streamed(
    preprocessed: PreprocessedRecording, config: NavigatorConfig
) -> tuple[Track, FloatArray]:
    """Return the newest states of the fixed-lag graph, and the processor time of each step [s]."""
    estimator = FixedLagEstimator(config, preprocessed.start)
    states, times = [estimator.nav_state()], []
    for interval, measurement in zip(
        preprocessed.intervals, preprocessed.measurements, strict=True
    ):
        began = process_time()
        estimator.step(interval, measurement)
        states.append(estimator.nav_state())
        times.append(process_time() - began)
    health = estimator.health(preprocessed.front_end.counts)
    return track_from_states(states, innovations_of([]), health), np.array(times)
