"""Cost of bad moments: a recording run with and without each, inserted at three places.

What counts is the rest of the track, before and after the moment. Its horizontal error is compared
after fits of yaw and position: of each of the two parts by itself, which shows what the moment did
to the estimator, and of both together, which adds what the track lost within the moment.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from scipy.stats import gmean

from stario.fusion.evaluation.compare import navigators
from stario.fusion.evaluation.displacement_error import fit_yaw_and_position, known_truth, planar
from stario.fusion.evaluation.scores import Column, by_track, joined, scored, table
from stario.fusion.evaluation.tracks import network_track
from stario.fusion.imu.direction import Complex
from stario.fusion.imu.inference import Predictor
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.state import Track
from stario.sequences.arrays import interpolated
from stario.sequences.attitude.rotations import GyroIntegral
from stario.sequences.attitude.stacks import composed
from stario.sequences.clean_samples import clean_samples
from stario.sequences.sequence import BoolArray, ImuSequence
from stario.sequences.simulation.insertion import Inserted, insert_moment
from stario.sequences.simulation.moments import MOMENTS

PLACES = {"start": 0.0, "middle": 0.5, "end": 0.85}
"""Instants of a moment, as shares of the recording."""

MAX_RATIO, MAX_STEP, MAX_TURN = 1.2, 1.0, 10.0
"""Largest acceptable ratio of the errors, and corrections without a fix [m], [deg]."""

MAX_SECONDS = 180.0
"""A longer recording is cut after this time [s]: it is run again for every moment and place."""

_BEFORE_WAYPOINTS = 4.0
"""Time before the first known position from which a recording without poses is used [s]."""

_FIRST_SECONDS = 1.05
"""Time until the first window has been applied [s]: it is a second long."""

_MIN_KNOWN = 3
"""Minimum number of known positions in a part of the track for its error to count."""

CARRIES = ("handheld", "pocket", "swinging", "bag")
"""How the device is carried in the simulated walks, one each."""

_COLUMNS = (
    Column("n", "step", ".0f", len),
    Column("without [m]", "error_without"),
    Column("rest: mean", "ratio", over=gmean),
    Column("worst", "ratio", over=np.max),
    Column("joined: mean", "joined_ratio", over=gmean),
    Column("worst", "joined_ratio", over=np.max),
    Column(f"ratio < {MAX_RATIO:g}", "ratio", ".0%", lambda ratio: (ratio < MAX_RATIO).mean()),
    Column("end [sigma]", "end_sigmas", ".1f", np.max),
    Column("step [m]", "step", ".1f", np.max),
    Column("turn [deg]", "turn", ".1f", np.max),
    Column("both small", "small", ".0%", np.mean),
)


def moment_costs(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig,
    graph: bool = False,
    seed: int = 0,
) -> pd.DataFrame:
    """Score a recording without and with each moment and place, the rows' group, by track.

    It begins at the first known position, and is cut if it is long.

    Figures: error of the rest [m], its parts fitted separately (`error_without`, `error_with`,
    their `ratio`) or as a whole (`joined_...`); the end's error in its sigmas, the part before
    being fitted (`end_sigmas`); largest correction of position [m] and attitude [deg] between two
    outputs (`step`, `turn`, whether both are `small`, and without the moment).

    Raises:
        InputError: it has no ground truth, or cannot be run.
    """
    _, known = known_truth(sequence)
    earlier = 0.0 if sequence.truth is not None else _BEFORE_WAYPOINTS
    start = max(float(sequence.time[0]), float(known.time[0]) - earlier)
    sequence = sequence.slice(start, start + MAX_SECONDS)
    estimators = navigators(model, config, graph)
    first = estimators["filtered"]
    observed = first.observe(sequence)
    poses = sequence.truth or network_track(observed).trajectory
    without = {name: each.track(observed) for name, each in estimators.items()}
    found = []
    for moment in MOMENTS:
        for place, share in PLACES.items():
            inserted = insert_moment(sequence, poses, moment, share, seed)
            observed = first.observe(inserted.sequence)
            figures = {
                name: _cost(sequence, inserted, without[name], each.track(observed))
                for name, each in estimators.items()
            }
            found.append(scored(sequence.name, figures, f"{moment.name}, {place}"))
    return joined(found)


def moment_table(scores: pd.DataFrame) -> str:
    """Return a row for each moment, place and track: ratios of errors, largest corrections."""
    step, turn = scores[["step_without", "turn_without"]].max()
    notes = [
        "without: median error [m] of the parts before and after, each fitted in yaw and position;",
        "ratio of that error with the moment to that without: geometric mean, worst; joined: both "
        "parts fitted as one; share of recordings whose rest is below the limit",
        "end: its largest error, the part before being fitted, in sigmas",
        f"step, turn: largest correction between two outputs (without moments {step:.2f} m, "
        f"{turn:.1f} deg); share with at most {MAX_STEP:g} m and {MAX_TURN:g} deg",
    ]
    return table(by_track(scores), _COLUMNS, ("moment", "track"), notes)


def _cost(
    sequence: ImuSequence, inserted: Inserted, without: Track, track: Track
) -> dict[str, float]:
    with_it, start = inserted.sequence, inserted.start
    apart, as_one, _ = _errors_of_rest(sequence, without, start, start)
    apart_with, as_one_with, end = _errors_of_rest(with_it, track, start, inserted.stop)
    assert track.covariance is not None  # both back ends give it
    sigma = math.sqrt(float(np.trace(track.covariance[-1, 6:8, 6:8])))
    step, turn = largest_correction(with_it, track)
    step_without, turn_without = largest_correction(sequence, without)
    return {
        "error_without": apart,
        "error_with": apart_with,
        "ratio": apart_with / apart,
        "joined_without": as_one,
        "joined_with": as_one_with,
        "joined_ratio": as_one_with / as_one,
        "end_sigmas": end / sigma,
        "step": step,
        "turn": turn,
        "small": float(step <= MAX_STEP and turn <= MAX_TURN),
        "step_without": step_without,
        "turn_without": turn_without,
    }


def _errors_of_rest(
    sequence: ImuSequence, track: Track, start: float, stop: float
) -> tuple[float, float, float]:
    """Return `_errors` before and after a moment."""
    if sequence.truth is not None:
        inside = track.trajectory.valid & sequence.truth.covers(track.time)
        time = track.time[inside]
        position = sequence.truth.at(time).position_W
    else:
        assert sequence.positions is not None
        inside = sequence.positions.valid & track.trajectory.covers(sequence.positions.time)
        time, position = sequence.positions.time[inside], sequence.positions.position_W[inside]
    truth = planar(position)
    estimate = planar(interpolated(time, track.time, track.trajectory.position_W))
    rest = (time < start) | (time >= stop)
    return _errors(truth[rest], estimate[rest], time[rest] < start)


def _errors(truth: Complex, estimate: Complex, before: BoolArray) -> tuple[float, float, float]:
    """Return the errors [m] of both parts fitted by themselves, as one, and of the end.

    The first two are root mean squares; the end's is that after a fit of the part before.
    """
    squares = [
        np.abs(fit_yaw_and_position(estimate[part], truth[part]) - truth[part]) ** 2
        for part in (before, ~before)
        if part.sum() >= _MIN_KNOWN
    ]
    if not squares:
        return math.nan, math.nan, math.nan
    end = math.nan
    if before.sum() >= _MIN_KNOWN:
        end = abs(fit_yaw_and_position(estimate, truth, before)[-1] - truth[-1])
    joined = np.abs(fit_yaw_and_position(estimate, truth) - truth) ** 2
    return math.sqrt(np.concatenate(squares).mean()), math.sqrt(joined.mean()), end


def largest_correction(sequence: ImuSequence, track: Track) -> tuple[float, float]:
    """Return a track's largest unexplained steps between two outputs, [m] and [deg].

    The position should advance by the mean of the two velocities, the attitude by the gyroscope
    less the estimated bias. Steps across gaps are left out, and that of the first window, which
    makes the velocity known.
    """
    trajectory, b_g = track.trajectory, track.b_g
    assert trajectory.velocity_W is not None  # both back ends give them
    assert b_g is not None
    dt = np.diff(trajectory.time)[:, None]
    velocity = 0.5 * (trajectory.velocity_W[:-1] + trajectory.velocity_W[1:])
    steps = np.linalg.norm(np.diff(trajectory.position_W, axis=0) - dt * velocity, axis=1)
    time, gyro, _ = clean_samples(sequence)
    measured = GyroIntegral(time, gyro).attitude(trajectory.time)
    expected, turns = (
        composed(attitude[:-1].inv(), attitude[1:])
        for attitude in (measured, trajectory.attitude_WB)
    )
    bias = Rotation.from_rotvec(-dt * b_g[1:])
    rest = composed(composed(expected, bias).inv(), turns).magnitude()
    counts = trajectory.valid[1:] & (trajectory.time[1:] > trajectory.time[0] + _FIRST_SECONDS)
    return float(steps[counts].max()), float(np.degrees(rest[counts].max()))
