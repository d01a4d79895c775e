"""Cost of faults in a recording: the same recording run with and without each.

A fault's effect on the fusion shows best with true displacements under white noise of a known size;
a network's own errors, which differ from window to window, hide it. Such displacements are used
unless a network is given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stario.fusion.backends import BackendName
from stario.fusion.config import FilterConfig, NavigatorConfig
from stario.fusion.evaluation.checks.corruption import Fault, ModifyPredictions, faults
from stario.fusion.evaluation.scores import Column, joined, rows_of, scored
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.health import Health
from stario.fusion.imu.stateful import Predictor, WindowDisplacement
from stario.fusion.navigator import Navigator
from stario.fusion.recording import PreprocessedRecording
from stario.fusion.state import Track
from stario.sequences.accuracy.metrics import align, evaluate_track
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.drawing.text_table import aligned
from stario.sequences.errors import InputError
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import ImuErrors, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_SECONDS

WHITE_NOISE = 0.05
"""White noise of the true displacements used without a network, per axis [m]."""


_COLUMNS = (
    Column("ATE without [m]", "error_without", ".3f"),
    Column("with [m]", "error_with", ".3f"),
    Column("end [m]", "end_error", ".3f"),
    Column("sigma [m]", "end_sigma", ".3f"),
)


def matched_walk(seconds: float = 120.0, seed: int = 0) -> tuple[ImuSequence, NavigatorConfig]:
    """Simulate a walk, and return it with a configuration that matches its sensor's errors."""
    errors = ImuErrors(noise=ImuNoise(), gyro_turn_on=5e-4, accel_turn_on=0.02)
    style = WalkStyle(carry="handheld", mount_rotvec=(0.3, -0.2, 0.9))
    walk = generate_walk(seed, seconds, style=style)
    sequence = simulate_imu(walk, 200.0, errors, seed, name=f"simulated walk {seed}")
    return sequence, matched_config(errors)


def matched_config(errors: ImuErrors) -> NavigatorConfig:
    """Return the configuration of a sensor whose errors are exactly as stated."""
    matched = FilterConfig(
        covariance_scale=1.0,
        correlated_errors=False,
        gyro_bias_sigma=errors.gyro_turn_on,
        accel_bias_sigma=errors.accel_turn_on,
        adaptive=False,
    )
    return NavigatorConfig(noise=errors.noise, filter=matched)


def run_faults(
    sequence: ImuSequence,
    config: NavigatorConfig,
    model: Predictor | None = None,
    seed: int = 0,
    backends: Sequence[BackendName] = get_args(BackendName),
    only: Sequence[Fault] | None = None,
) -> pd.DataFrame:
    """Score a recording with each fault, the rows' group, through each back end, their track.

    Figures: absolute trajectory error [m] without and with the fault (`error_without`,
    `error_with`); distance from the truth at the end (`end_error`) and its reported standard
    deviation (`end_sigma`), the root of the covariance's trace [m]; whether every state is finite
    (`finite`). The label `reported` has the faults counted in the health report, in words, or why
    the recording is refused.

    Args:
        sequence: a recording with true poses.
        config: configuration of the navigator.
        model: network; None for the true displacements under white noise.
        seed: seed of the random faults.
        backends: back ends to run.
        only: faults to run; None for all of them.

    Raises:
        InputError: the recording has no true poses, or is too short.
    """
    truth = true_poses(sequence)
    found: list[pd.DataFrame] = []
    whole = _observed(sequence, config, model, seed)
    for backend in backends:
        navigator = Navigator(model or DummyPredictor(), config, backend=backend)
        without = evaluate_track(navigator.track(whole).trajectory, truth).ate_m
        for fault in faults(sequence.duration) if only is None else only:
            try:
                track = navigator.track(_with_fault(fault, sequence, whole, config, model, seed))
            except InputError as refusal:
                figures, words = (
                    dict.fromkeys(_FIGURES, math.nan) | {"finite": 1.0},
                    f"refused: {refusal}",
                )
            else:
                assert track.health is not None
                figures, words = _figures(track, truth), reported(track.health)
            figures = {"error_without": without, **figures}
            found.append(scored(sequence.name, {backend: figures}, fault.name, reported=words))
    return joined(found)


def fault_table(scores: pd.DataFrame) -> str:
    """Return the results as text."""
    rows = list(scores.groupby(["group", "track"], sort=False))
    lines = aligned(rows_of(rows, _COLUMNS, "fault", "back end"))
    finite = Column("", "finite", over=np.min)
    reports = [
        ("" if finite.value(part) else "NOT FINITE, ") + part["reported"].iloc[0]
        for _, part in rows
    ]
    return "\n".join(
        f"{line}   {words}" for line, words in zip(lines, ["reported", *reports], strict=True)
    )


def reported(health: Health) -> str:
    """Summarise the faults in a health report in a few words."""
    words = [f"{name} {n}" for name, n in health.samples.items() if n and name != "used"]
    words += [f"{name} {n}" for name, n in health.flagged.items() if n]
    words += [f"refused {reason} {n}" for reason, n in health.refused.items()]
    words += [f"gap {length:.1f} s" for _, length in health.gaps]
    words += [f"gated {health.gated} of {health.updates}", *health.notes]
    return ", ".join(words)


def _observed(
    sequence: ImuSequence, config: NavigatorConfig, model: Predictor | None, seed: int
) -> PreprocessedRecording:
    preprocessed = Navigator(model or DummyPredictor(), config).observe(sequence)
    if model is None and sequence.truth is not None:
        return with_true_displacements(preprocessed, sequence.truth, config, seed)
    return preprocessed


def _with_fault(
    fault: Fault,
    sequence: ImuSequence,
    whole: PreprocessedRecording,
    config: NavigatorConfig,
    model: Predictor | None,
    seed: int,
) -> PreprocessedRecording:
    """Preprocess a recording with a fault; without one in the samples, `whole` has been already."""
    rng, preprocessed = np.random.default_rng(seed), whole
    if fault.modify_samples is not None:
        faulty = fault.modify_samples(sequence, rng)
        preprocessed = _observed(faulty, config, model, seed)
    if fault.modify_predictions is not None:
        preprocessed = _corrupted(preprocessed, fault.modify_predictions, rng)
    return preprocessed


class DummyPredictor:
    """Placeholder for a network."""

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return zero displacements with unit covariances."""
        n = len(np.asarray(windows))
        return np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))


def with_true_displacements(
    preprocessed: PreprocessedRecording,
    truth: Trajectory,
    config: NavigatorConfig,
    seed: int,
    noise: float = WHITE_NOISE,
) -> PreprocessedRecording:
    """Replace a preprocessed recording's displacements by the true ones with white noise.

    Like a network's, they are given in each window's levelled frame, in which the window itself is
    given. After the filter's scaling, their covariance is the true one: `noise` [m] per axis. A
    window's noise depends on the seed and its time, not on earlier windows.
    """
    covariance = noise**2 / config.filter.covariance_scale * np.eye(3)
    measurements = list(preprocessed.measurements)
    measured = {k: each for k, each in enumerate(measurements) if each is not None}
    stop = np.array([preprocessed.intervals[k].stop for k in measured])
    attitudes = np.array([each.R_NB for each in measured.values()])
    ends = np.clip([stop - WINDOW_SECONDS, stop], truth.time[0], truth.time[-1])
    first, last = truth.at(ends[0]), truth.at(ends[1])
    turn = about_z(yaw_of(Rotation.from_matrix(attitudes) * first.attitude_WB.inv()))
    displacement_N = turn.apply(last.position_W - first.position_W)
    times = stop - truth.time[0]
    for k, d_N, R_NB, time in zip(measured, displacement_N, attitudes, times, strict=True):
        rng = np.random.default_rng([seed, max(0, round(time * config.filter.output_rate))])
        noisy_N = d_N + noise * rng.standard_normal(3)
        measurements[k] = WindowDisplacement(noisy_N, covariance, R_NB)
    return replace(preprocessed, measurements=measurements)


def _corrupted(
    preprocessed: PreprocessedRecording, modify: ModifyPredictions, rng: np.random.Generator
) -> PreprocessedRecording:
    """Apply a fault to all measurements at once."""
    measurements = list(preprocessed.measurements)
    measured = {k: each for k, each in enumerate(measurements) if each is not None}
    mean, covariance, _ = (np.stack(values) for values in zip(*measured.values(), strict=True))
    modify(mean, covariance, rng)
    for (k, each), d_N, C in zip(measured.items(), mean, covariance, strict=True):
        measurements[k] = each._replace(d_N=d_N, covariance_N=C)
    return replace(preprocessed, measurements=measurements)


_FIGURES = ("error_with", "end_error", "end_sigma")


def _figures(track: Track, truth: Trajectory) -> dict[str, float]:
    assert track.covariance is not None  # both back ends give it
    end = align(track.trajectory, truth, "first").position_W[-1]
    last = truth.at(np.clip(track.time[-1:], *truth.time[[0, -1]])).position_W[0]
    arrays = [values for values in track.arrays().values() if values.dtype.kind == "f"]
    return {
        "error_with": evaluate_track(track.trajectory, truth).ate_m,
        "end_error": float(np.linalg.norm(end - last)),
        "end_sigma": math.sqrt(np.trace(track.covariance[-1, 6:9, 6:9])),
        "finite": float(all(bool(np.isfinite(values).all()) for values in arrays)),
    }
