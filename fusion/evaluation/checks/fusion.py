"""The fusion on recordings, by group: beside its network, with fixes, samples missing, heights.

Errors are horizontal, root mean square after a fit of yaw and position: over all poses, or at the
waypoints. With fixes only the second half of each track counts: by then several have determined the
direction. Tracks with samples missing begin in the same pose, so ends need no alignment.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from time import process_time

import numpy as np
import pandas as pd
from scipy.stats import gmean

from stario.fusion.backends import BackendName
from stario.fusion.evaluation.checks.faults import (
    DummyPredictor,
    drops,
    gap,
    matched_config,
    with_true_displacements,
)
from stario.fusion.evaluation.compare import Metrics, measure, navigators
from stario.fusion.evaluation.displacement_error import known_truth
from stario.fusion.evaluation.known_positions import MIN_POSITIONS, position_error, true_path
from stario.fusion.evaluation.scores import Column, by_track, median_degrees, parts, scored, table
from stario.fusion.evaluation.tracks import network_track, true_poses
from stario.fusion.filter import estimator
from stario.fusion.filter.record import innovations_of
from stario.fusion.graph.fixed_lag import FixedLag
from stario.fusion.imu.inference import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.recording import PreprocessedRecording
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Fix, position_fix
from stario.fusion.values.floors import floor_at
from stario.fusion.values.lie import yaw_twist
from stario.fusion.values.state import Track, track_from_states
from stario.sequences.accuracy.metrics import pose_errors
from stario.sequences.accuracy.nees import nees
from stario.sequences.arrays import even_grid
from stario.sequences.errors import InputError
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, ImuErrors, simulate_imu
from stario.sequences.simulation.walks import generate_walk

DISPLACEMENT_NOISE = 0.03
"""White noise of the displacements of simulated walks, per axis [m]."""

SIGMA_BOUND = 3.0
"""Maximum yaw error of a consistent track, in standard deviations."""

GOOD_YAW = math.radians(10.0)
"""Maximum acceptable yaw error at the end [rad]."""

GAP_SECONDS, DROPPED, INSTANTS = 0.1, 0.05, 6
"""Length of a gap [s], share of samples that is dropped, and number of instants of a gap."""

MAX_SHIFT, MAX_TURN = 0.01, 3.0
"""Maximum acceptable shift of the end: in metres per metre of the path, and in yaw [deg]."""

FLOOR_METRES, WITHIN = 3.0, 0.8
"""Distance of floors for which waypoints count, and error up to which one lies on its floor [m]."""

_MIN_FIXES, _MIN_PATH = 4, 1.0
"""Minimum number of fixes, and path [m], of a track that is evaluated."""


def fusion_gain(
    model: Predictor, sequence: ImuSequence, config: NavigatorConfig, graph: bool = False
) -> pd.DataFrame:
    """Score the network alone and the filter: `error_m`, its `ratio` to the network's, NIS.

    The network's displacements are chained along the attitude levelled from the IMU.

    The error is also given in percent of the true path (of the legs between waypoints; not where
    positions are known whose noise adds up), and the processor time without the network
    (`s_per_min` of data). With `graph` also the graph of the recording, `track`, and the newest
    states of a stream's, `fixed_lag`, with its `slowest_ms`.

    With true poses also the NEES of position, and at the end of the truth the yaw error relative to
    its start [rad], the yaw's reported standard deviation [rad], and whether the error is good and
    within the bound.

    Raises:
        InputError: it has no ground truth or too few known positions, or cannot be run.
    """
    known_truth(sequence)  # before anything slow
    return _gains(Navigator(model, config).observe(sequence), sequence, config, graph)


def simulated_gain(seed: int, seconds: float, graph: bool = False) -> pd.DataFrame:
    """Score a simulated walk, measured once a second by its displacements with white noise.

    The sensor has the white noise of `ImuNoise` and a phone's biases, no other errors; the
    estimators are given the exact standard deviations. Person and carry are drawn at random.
    """
    errors = ImuErrors(
        noise=ImuNoise(), gyro_turn_on=PHONE_IMU.gyro_turn_on, accel_turn_on=PHONE_IMU.accel_turn_on
    )
    config = matched_config(errors)
    config = replace(config, filter=replace(config.filter, update_rate=1))
    walk = generate_walk(seed, seconds)
    sequence = simulate_imu(walk, 200.0, errors, seed, name=f"walk {seed}")
    preprocessed = Navigator(DummyPredictor(), config).observe(sequence)
    preprocessed = with_true_displacements(preprocessed, walk, config, seed, DISPLACEMENT_NOISE)
    return _gains(preprocessed, sequence, config, graph).assign(group="simulated")


def _gains(
    preprocessed: PreprocessedRecording, sequence: ImuSequence, config: NavigatorConfig, graph: bool
) -> pd.DataFrame:
    kind, _ = known_truth(sequence)
    path = 0.0 if kind == "positions" else true_path(sequence)
    alone = fitted_error(measure(network_track(preprocessed), sequence))
    if math.isnan(alone):
        found = f"fewer than {MIN_POSITIONS} within the track"
        raise InputError(f"{sequence.name}: positions", found, f"{MIN_POSITIONS} or more")
    figures: dict[str, Metrics] = {"network": {"error_m": alone}}
    for name, navigator in navigators(DummyPredictor(), config, graph).items():
        began = process_time()
        track = navigator.track(preprocessed)
        figures[name] = _gain(track, sequence, path, alone, process_time() - began)
    if graph:
        track, times = _streamed(preprocessed, config)
        stream = _gain(track, sequence, path, alone, float(times.sum()))
        figures["fixed_lag"] = {**stream, "slowest_ms": 1e3 * float(times.max())}
    return scored(sequence.name, figures)


def _gain(
    track: Track, sequence: ImuSequence, path: float, alone: float, seconds: float
) -> Metrics:
    measured = measure(track, sequence)
    error = fitted_error(measured)
    yaw = {} if sequence.truth is None else _yaw_at_the_end(track, sequence.truth)
    return {
        "error_m": error,
        "percent": 100.0 * error / path if path else None,
        "ratio": error / alone,
        "nis": measured["nis_mean"],
        "nees": measured["nees_median"],
        "s_per_min": 60.0 * seconds / float(track.time[-1] - track.time[0]),
        **yaw,
    }


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


def fitted_error(figures: Metrics) -> float:
    """Return the horizontal error after a fit of yaw and position [m]; NaN if unknown."""
    fitted = figures["ate_fit_m"]
    found = figures["known_positions_m"] if fitted is None else fitted
    return math.nan if found is None else found


def _yaw_at_the_end(track: Track, truth: Trajectory) -> dict[str, float]:
    assert track.covariance is not None  # both back ends give it
    errors = pose_errors(track.trajectory, truth)
    yaw = np.unwrap(errors.yaw)
    # The truth may end before the track, whose sigma grows further.
    last = np.searchsorted(track.time, errors.estimate.time[-1])
    error, sigma = float(yaw[-1] - yaw[0]), math.sqrt(track.covariance[last, 2, 2])
    return {
        "yaw_error": error,
        "yaw_sigma": sigma,
        "yaw_good": float(abs(error) < GOOD_YAW),
        "yaw_covered": float(abs(error) < SIGMA_BOUND * sigma),
    }


def fusion_gain_table(scores: pd.DataFrame) -> str:
    """Return a row for each group and track: ratios to the network, NIS, NEES, yaw at the end.

    Below are ratios of the other tracks' errors to the filter's: geometric means with their
    standard errors, without which two similar estimators seem to differ.
    """
    columns = (
        Column("n", "error_m", ".0f", len),
        Column("error m", "error_m"),
        Column("% of path", "percent", ".1f"),
        Column("ratio", "ratio", over=gmean),
        Column("p95", "ratio", over=lambda r: np.exp(np.quantile(np.log(r), 0.95))),
        Column("worst", "ratio", over=np.max),
        Column("NIS", "nis", ".1f", np.mean),
        Column("NEES", "nees", ".1f"),
        Column("yaw deg", "yaw_error", ".1f", median_degrees),
        Column("< 10 deg", "yaw_good", ".0%", np.mean),
        Column("< 3 sigma", "yaw_covered", ".0%", np.mean),
        Column("s/min", "s_per_min"),
        Column("slowest ms", "slowest_ms", ".1f", np.max),
    )
    notes = [
        "error: median, after a fit of yaw and position; ratio to the network's error: geometric "
        "mean, 95th percentile, worst",
        "NIS: mean, 3 expected; NEES of position: median, 2.4 expected; yaw: error at the end "
        "relative to the start",
        "s/min: processor time without the network per minute of data; slowest: update of a stream",
        *_to_filtered(scores),
    ]
    return table(by_track(scores), columns, ("group", "track"), notes)


def _to_filtered(scores: pd.DataFrame) -> Iterator[str]:
    by_name = scores.pivot_table("error_m", ["group", "recording"], "track", sort=False)
    for name in by_name.columns.difference(["network", "filtered"], sort=False):
        logs = np.log(by_name[name] / by_name["filtered"])
        ratio = math.exp(logs.mean())
        error = ratio * logs.sem() if logs.count() > 1 else 0.0
        yield f"{name} / filtered: {ratio:.2f} +- {error:.2f} (geometric mean)"


def track_with_fixes(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    every: float = 5.0,
    sigma: float = 0.3,
    backend: BackendName = "ekf",
) -> pd.DataFrame:
    """Score the second half of a recording's track with fixes.

    Figures: share of the fixes that were `applied`; horizontal `position_rms` [m] and median
    `position_nees`; `yaw_rms` [rad], mean `yaw_nees`, and the share of poses whose yaw error is
    within three standard deviations (`yaw_covered`).

    Raises:
        InputError: it has no true poses, is too short for enough fixes, or cannot be run.
    """
    truth = true_poses(sequence)
    known = true_fixes(truth, every, sigma, seed=0)
    fixes = [fix for fix in known if fix.time >= sequence.time[0]]  # truth may begin earlier
    if len(fixes) < _MIN_FIXES:
        raise InputError(f"{sequence.name}: fixes", str(len(fixes)), f"{_MIN_FIXES} or more")
    track = Navigator(model, config, backend=backend).run(sequence, fixes=fixes)
    assert track.covariance is not None  # both back ends give it
    assert track.health is not None
    errors = pose_errors(track.trajectory, truth)
    second_half = errors.estimate.time > 0.5 * (truth.time[0] + truth.time[-1])
    rows = np.searchsorted(track.time, errors.estimate.time[second_half])
    P, error, yaw = track.covariance[rows], errors.position_W[second_half], errors.yaw[second_half]
    figures = {
        "applied": track.health.fixes.get("applied", 0) / len(fixes),
        "position_rms": math.sqrt((error[:, :2] ** 2).sum(axis=1).mean()),
        "position_nees": float(np.median(nees(error, P[:, 6:9, 6:9]))),
        "yaw_rms": math.sqrt((yaw**2).mean()),
        "yaw_nees": float((yaw**2 / P[:, 2, 2]).mean()),
        "yaw_covered": float((np.abs(yaw) < SIGMA_BOUND * np.sqrt(P[:, 2, 2])).mean()),
    }
    name = "filtered" if backend == "ekf" else "track"
    return scored(sequence.name, {name: figures})


def true_fixes(truth: Trajectory, every: float, sigma: float, seed: int) -> list[Fix]:
    """Return a true position every `every` seconds, with errors of `sigma` [m] per axis."""
    at = truth.at(even_grid(truth.time[0], truth.time[-1], every))
    positions = at.position_W + np.random.default_rng(seed).normal(0.0, sigma, (len(at), 3))
    return [
        position_fix(float(time), position, sigma**2 * np.eye(3))
        for time, position in zip(at.time[at.valid], positions[at.valid], strict=True)
    ]


def fixes_table(scores: pd.DataFrame) -> str:
    """Return a row for each group: medians over recordings, and share of yaw errors in 3 sigma."""
    columns = (
        Column("n", "applied", ".0f", len),
        Column("fixes applied", "applied", ".0%", np.mean),
        Column("position m", "position_rms"),
        Column("NEES", "position_nees", ".1f"),
        Column("yaw deg", "yaw_rms", ".1f", median_degrees),
        Column("yaw NEES", "yaw_nees", ".1f"),
        Column("< 3 sigma", "yaw_covered", ".1%", np.mean),
    )
    note = "second half of each track; expected: NEES of position 2.4 (median), of yaw 1 (mean)"
    return table(parts(scores), columns, notes=[note])


def end_shifts(model: Predictor, sequence: ImuSequence, config: NavigatorConfig) -> pd.DataFrame:
    """Score a track without a few samples, in several ways: the shift of its end.

    `metres` is the horizontal distance between the ends over the length of the track, `degrees`
    the absolute difference of their yaws.

    Raises:
        InputError: the recording cannot be run, or its track is shorter than a metre.
    """
    navigator = Navigator(model, config, backend="ekf")
    whole = navigator.run(sequence).trajectory
    path = float(np.linalg.norm(np.diff(whole.position_W[:, :2], axis=0), axis=1).sum())
    if path < _MIN_PATH:
        raise InputError(f"{sequence.name}: track", f"{path:.2f} m", "at least a metre")
    instants = (np.arange(INSTANTS) + 0.5) / INSTANTS * sequence.duration
    rng = np.random.default_rng(0)
    faulty = {f"gap at {t:.0f} s": gap(sequence, rng, t, GAP_SECONDS) for t in instants.tolist()}
    faulty[f"{DROPPED:.0%} dropped"] = drops(sequence, rng, DROPPED)
    figures = {}
    for name, recording in faulty.items():
        other = navigator.run(recording).trajectory
        shift = float(np.linalg.norm(whole.position_W[-1, :2] - other.position_W[-1, :2])) / path
        turn = (other.attitude_WB[-1] * whole.attitude_WB[-1].inv()).as_matrix()
        degrees = abs(math.degrees(yaw_twist(turn)))
        within = float(shift <= MAX_SHIFT and degrees <= MAX_TURN)
        figures[name] = {"metres": shift, "degrees": degrees, "within": within}
    return scored(sequence.name, figures)


def end_shift_table(scores: pd.DataFrame) -> str:
    """Return a row for each group: share of the ends within limits, and how far ends move."""
    columns = (
        Column("ends", "metres", ".0f", len),
        Column(f"within {MAX_SHIFT:.0%} and {MAX_TURN:g} deg", "within", ".0%", np.mean),
        Column("of the path: median", "metres", ".2%"),
        Column("p95", "metres", ".2%", partial(np.quantile, q=0.95)),
        Column("worst", "metres", ".2%", np.max),
        Column("deg: median", "degrees"),
        Column("p95", "degrees", over=partial(np.quantile, q=0.95)),
        Column("worst", "degrees", over=np.max),
    )
    return table(parts(scores), columns)


def score_heights(model: Predictor, sequence: ImuSequence, config: NavigatorConfig) -> pd.DataFrame:
    """Score a recording's tracks: with the barometer, filtered, and without.

    Figures of each: `height_rms` and `height_max` [m], share `within` 0.8 m, median
    `height_nees`; with the barometer the share of waypoints on the `floors` found, not counting
    those on the way between two; horizontal error at the waypoints after a fit, `horizontal` [m].

    Raises:
        InputError: it has no barometer, or neither waypoints with floors nor true poses.
    """
    if sequence.barometer is None:
        raise InputError(f"{sequence.name}: barometer", "none", "a recording with one")
    known, positions = _known_heights(sequence), sequence.positions
    navigator = Navigator(model, config)
    track = navigator.run(sequence)
    tracks = {"pressure": track, "none": navigator.run(replace(sequence, barometer=None))}
    if track.filtered is not None:
        tracks["filtered"] = track.filtered
    figures = {name: _height_figures(each, *known) for name, each in tracks.items()}
    if positions is not None:
        for name, each in tracks.items():
            figures[name]["horizontal"] = position_error(each, positions)[0]
        if positions.floor is not None:
            figures["pressure"]["floors"] = _right_floors(track, positions)
    return scored(sequence.name, figures)


def _known_heights(sequence: ImuSequence) -> tuple[FloatArray, FloatArray]:
    """Return times [s] at which the height [m] is known, and these heights."""
    if sequence.truth is not None:
        truth = sequence.truth
        return truth.time[truth.valid], truth.position_W[truth.valid, 2]
    positions = sequence.positions
    if positions is None or positions.floor is None:
        expected = "waypoints with floors, or true poses"
        raise InputError(f"{sequence.name}: heights", "none", expected)
    at = positions.valid & np.isfinite(positions.floor)
    return positions.time[at], FLOOR_METRES * positions.floor[at]


def _height_figures(track: Track, time: FloatArray, height: FloatArray) -> dict[str, float]:
    inside = (time >= track.time[0]) & (time <= track.time[-1])
    time, height = time[inside], height[inside]
    assert track.covariance is not None  # both back ends give it
    estimated = np.interp(time, track.time, track.trajectory.position_W[:, 2])
    variance = np.interp(time, track.time, track.covariance[:, 8, 8])
    error = estimated - estimated[0] - height + height[0]
    return {
        "height_rms": math.sqrt(float(np.mean(error**2))),
        "height_max": float(np.abs(error).max()),
        "within": float(np.mean(np.abs(error) <= WITHIN)),
        "height_nees": float(np.median(error[1:] ** 2 / variance[1:])),
    }


def _right_floors(track: Track, positions: PositionTrack) -> float:
    """Return the share of waypoints that are on the floor that was found."""
    assert positions.floor is not None
    assert track.health is not None
    known = [(t, f) for t, f in zip(positions.time, positions.floor, strict=True) if f == f]
    found = [(floor_at(track.health.floors, t), f - known[0][1]) for t, f in known]
    on_floors = [there == floor for there, floor in found if there is not None]
    return float(np.mean(on_floors)) if on_floors else math.nan


def heights_table(scores: pd.DataFrame) -> str:
    """Return a row for each group and track: medians over recordings, shares and the largest."""
    columns = (
        Column("n", "height_rms", ".0f", len),
        Column("height m", "height_rms"),
        Column("largest", "height_max", ".2f", max),
        Column(f"< {WITHIN:g} m", "within", ".0%", np.mean),
        Column("NEES", "height_nees"),
        Column("horizontal m", "horizontal"),
        Column("floors right", "floors", ".0%", np.mean),
    )
    note = (
        f"at waypoints, relative to the first, {FLOOR_METRES:g} m a floor (the truth, if there is "
        "one); NEES: 0.45 expected (median)"
    )
    return table(by_track(scores), columns, ("group", "track"), notes=[note])
