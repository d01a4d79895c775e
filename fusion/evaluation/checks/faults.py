"""Cost of faults in a recording: the same recording run with and without each.

A fault's effect on the fusion shows best with true displacements under white noise of a known size;
a network's own errors, which differ from window to window, hide it. Such displacements are used
unless a network is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.compare import navigators
from stario.fusion.evaluation.scores import Column, joined, scored, table
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.imu.inference import Predictor, WindowDisplacement
from stario.fusion.navigator import Navigator
from stario.fusion.recording import PreprocessedRecording
from stario.fusion.values.config import FilterConfig, NavigatorConfig
from stario.fusion.values.health import Health
from stario.fusion.values.state import Track
from stario.sequences.accuracy.metrics import align, evaluate_track
from stario.sequences.arrays import even_grid, interpolated
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.errors import InputError
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import ImuErrors, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_SECONDS

WHITE_NOISE = 0.05
"""White noise of the true displacements used without a network, per axis [m]."""

Rng = np.random.Generator
ModifySamples = Callable[[ImuSequence, Rng], ImuSequence]
ModifyPredictions = Callable[[FloatArray, FloatArray, Rng], None]
"""Function that modifies displacements (M, 3) and covariances (M, 3, 3) in place."""


@dataclass(frozen=True)
class Fault:
    """A fault of the samples or of the network's predictions.

    Attributes:
        name: name in the table.
        modify_samples: function that returns the recording with the fault; None for no change.
        modify_predictions: function that modifies the predictions; None for no change.
    """

    name: str
    modify_samples: ModifySamples | None = None
    modify_predictions: ModifyPredictions | None = None


def faults(duration: float) -> list[Fault]:
    """Return every fault of the table, for a recording of this duration [s]."""
    half, block = 0.5 * duration, 5.0 / duration
    return [
        Fault("none"),
        Fault("network off by 1 m for 5 s", modify_predictions=partial(_offset_block, share=block)),
        Fault("5 % of windows off by 2 m", modify_predictions=_outliers),
        Fault("covariance 100 times too small", modify_predictions=_overconfident),
        *(Fault(f"gap of {s:g} s", partial(gap, start=half, seconds=s)) for s in (0.1, 1.0, 3.0)),
        *(Fault(f"{s:.0%} of samples dropped", partial(drops, share=s)) for s in (0.05, 0.2)),
        *(Fault(f"{rate:g} Hz", partial(_resampled, rate=rate)) for rate in (190.0, 500.0)),
        Fault("accelerometer clipped", _clipped),
        *(Fault(f"one NaN in {k}", partial(_one_nan, field=k)) for k in ("time", "gyro", "accel")),
        Fault("one NaN from the network", modify_predictions=partial(_nan_prediction, which=0)),
        Fault("one NaN in the covariance", modify_predictions=partial(_nan_prediction, which=1)),
        Fault("1 % duplicated, 1 % swapped", _reordered),
        Fault("three wild timestamps", _wild_times),
        Fault("ten spikes", _spikes),
    ]


def _offset_block(mean: FloatArray, covariance: FloatArray, rng: Rng, share: float) -> None:
    fraction = (np.arange(len(mean)) + 1.0) / len(mean)
    mean[(fraction > 0.5) & (fraction <= 0.5 + share), 0] += 1.0


def _outliers(mean: FloatArray, covariance: FloatArray, rng: Rng) -> None:
    selected = rng.random(len(mean)) < 0.05
    mean[selected] += rng.choice([-2.0, 2.0], (int(selected.sum()), 3)) / np.sqrt(3.0)


def _overconfident(mean: FloatArray, covariance: FloatArray, rng: Rng) -> None:
    covariance *= 0.01


def _nan_prediction(mean: FloatArray, covariance: FloatArray, rng: Rng, which: int) -> None:
    (mean, covariance)[which][len(mean) // 2] = np.nan


def gap(sequence: ImuSequence, rng: Rng, start: float, seconds: float) -> ImuSequence:
    """Remove `seconds` of samples, from `start` seconds after the first sample on."""
    since = sequence.time - sequence.time[0] - start
    return sequence.select((since <= 0.0) | (since >= seconds))


def drops(sequence: ImuSequence, rng: Rng, share: float) -> ImuSequence:
    """Remove a share of the samples at random."""
    return sequence.select(rng.random(len(sequence)) >= share)


def _resampled(sequence: ImuSequence, rng: Rng, rate: float) -> ImuSequence:
    time = even_grid(sequence.time[0], sequence.time[-1], 1.0 / rate)
    gyro, accel = (interpolated(time, sequence.time, v) for v in (sequence.gyro, sequence.accel))
    return replace(sequence, time=time, gyro=gyro, accel=accel)


def _clipped(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    limit = float(np.quantile(np.abs(sequence.accel).max(axis=1), 0.98))
    return replace(sequence, accel=np.clip(sequence.accel, -limit, limit))


def _one_nan(sequence: ImuSequence, rng: Rng, field: str) -> ImuSequence:
    values = getattr(sequence, field).copy()
    values[len(values) // 2] = np.nan
    return replace(sequence, **{field: values})


def _reordered(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    order = np.arange(len(sequence))
    for k in np.flatnonzero(rng.random(len(order) - 1) < 0.01):
        order[[k, k + 1]] = order[[k + 1, k]]
    return sequence.select(np.repeat(order, 1 + (rng.random(len(order)) < 0.01)))


def _wild_times(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    time = sequence.time.copy()
    time[rng.integers(0, len(time), 3)] += 1e6
    return replace(sequence, time=time)


def _spikes(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    gyro, accel = sequence.gyro.copy(), sequence.accel.copy()
    gyro[rng.integers(0, len(gyro), 5), 1] += 200.0
    accel[rng.integers(0, len(accel), 5), 2] += 500.0
    return replace(sequence, gyro=gyro, accel=accel)


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
    graph: bool = True,
    only: Sequence[Fault] | None = None,
) -> pd.DataFrame:
    """Score a recording with each fault, the rows' group, by the track of filter and graph.

    Figures: absolute trajectory error [m] without and with the fault (`error_without`,
    `error_with`); distance from the truth at the end (`end_error`) and its reported standard
    deviation (`end_sigma`), the root of the covariance's trace [m]; whether every state is finite
    (`finite`). The label `reported` has the faults counted in the health report, in words, or why
    the recording is refused.

    Without a network, displacements are the true ones under white noise. `seed` is that of random
    faults; without `only`, all of them are run.

    Raises:
        InputError: the recording has no true poses, or is too short.
    """
    truth, predictor = true_poses(sequence), model or DummyPredictor()

    def observed(recording: ImuSequence) -> PreprocessedRecording:
        preprocessed = Navigator(predictor, config).observe(recording)
        if model is None:
            return with_true_displacements(preprocessed, truth, config, seed)
        return preprocessed

    found: list[pd.DataFrame] = []
    whole = observed(sequence)
    for name, navigator in navigators(predictor, config, graph).items():
        without = evaluate_track(navigator.track(whole).trajectory, truth).ate_m
        for fault in faults(sequence.duration) if only is None else only:
            rng, preprocessed = np.random.default_rng(seed), whole
            try:
                if fault.modify_samples is not None:
                    spoilt = fault.modify_samples(sequence, rng)
                    named = f"{sequence.name}, {fault.name}"  # in warnings of what was injected
                    preprocessed = observed(replace(spoilt, name=named))
                if fault.modify_predictions is not None:
                    preprocessed = _corrupted(preprocessed, fault.modify_predictions, rng)
                track = navigator.track(preprocessed)
            except InputError as refusal:
                unknown = dict.fromkeys(("error_with", "end_error", "end_sigma"), math.nan)
                figures, words = {**unknown, "finite": 1.0}, f"refused: {refusal}"
            else:
                assert track.health is not None
                figures, words = _figures(track, truth), reported(track.health)
            figures = {"error_without": without, **figures}
            found.append(scored(sequence.name, {name: figures}, fault.name, reported=words))
    return joined(found)


def fault_table(scores: pd.DataFrame) -> str:
    """Return the results as text."""
    columns = (
        Column("ATE without [m]", "error_without", ".3f"),
        Column("with [m]", "error_with", ".3f"),
        Column("end [m]", "end_error", ".3f"),
        Column("sigma [m]", "end_sigma", ".3f"),
    )
    rows = scores.groupby(["group", "track"], sort=False)
    lines = table(rows, columns, ("fault", "track")).splitlines()
    finite = np.where(scores["finite"] == 0.0, "NOT FINITE, ", "")
    reports = ["reported", *(finite + scores["reported"])]
    return "\n".join(f"{line}   {words}" for line, words in zip(lines, reports, strict=True))


def reported(health: Health) -> str:
    """Summarise the faults in a health report in a few words."""
    words = [f"{name} {n}" for name, n in health.samples.items() if n and name != "used"]
    words += [f"{name} {n}" for name, n in health.flagged.items() if n]
    words += [f"refused {reason} {n}" for reason, n in health.refused.items()]
    words += [f"gap {length:.1f} s" for _, length in health.gaps]
    words += [f"gated {health.gated} of {health.updates}", *health.notes]
    return ", ".join(words)


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
    pairs = zip(preprocessed.intervals, preprocessed.measurements, strict=True)
    measured = [(interval.stop, each.R_NB) for interval, each in pairs if each is not None]
    stop, R_NB = (np.array(values) for values in zip(*measured, strict=True))
    ends = np.clip([stop - WINDOW_SECONDS, stop], truth.time[0], truth.time[-1])
    first, last = truth.at(ends[0]), truth.at(ends[1])
    turn = about_z(yaw_of(Rotation.from_matrix(R_NB) * first.attitude_WB.inv()))
    mean_N = turn.apply(last.position_W - first.position_W)
    for d_N, time in zip(mean_N, stop - truth.time[0], strict=True):
        rng = np.random.default_rng([seed, max(0, round(time * config.filter.output_rate))])
        d_N += noise * rng.standard_normal(3)
    return _with_displacements(preprocessed, mean_N, np.tile(covariance, (len(stop), 1, 1)))


def _corrupted(
    preprocessed: PreprocessedRecording, modify: ModifyPredictions, rng: np.random.Generator
) -> PreprocessedRecording:
    """Apply a fault to all measurements at once."""
    measured = [each for each in preprocessed.measurements if each is not None]
    mean, covariance, _ = (np.stack(values) for values in zip(*measured, strict=True))
    modify(mean, covariance, rng)
    return _with_displacements(preprocessed, mean, covariance)


def _with_displacements(
    preprocessed: PreprocessedRecording, mean_N: FloatArray, covariance_N: FloatArray
) -> PreprocessedRecording:
    """Replace displacements (M, 3) and covariances (M, 3, 3) of the measurements, one by one."""
    new = zip(mean_N, covariance_N, strict=True)
    replaced = [
        None if each is None else WindowDisplacement(*next(new), each.R_NB)
        for each in preprocessed.measurements
    ]
    return replace(preprocessed, measurements=replaced)


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
