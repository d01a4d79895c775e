"""Heights and floors with the barometer and without, at waypoints with floors or true poses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.known_positions import position_error
from stario.fusion.evaluation.scores import Column, parts, scored, table
from stario.fusion.floors import floor_at
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.state import Track
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack

FLOOR_METRES = 3.0
"""Distance of floors [m] for which waypoints count."""

WITHIN = 0.8
"""Error [m] up to which a waypoint lies on its floor."""

_NOTE = (
    "at waypoints, relative to the first, 3 m a floor (the truth, if there is one); NEES: 0.45 "
    "expected (median)"
)


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
    known = _known_heights(sequence)
    navigator = Navigator(model, config)
    track = navigator.run(sequence)
    tracks = {"pressure": track, "none": navigator.run(replace(sequence, barometer=None))}
    if track.filtered is not None:
        tracks["filtered"] = track.filtered
    figures = {name: _figures(each, *known) for name, each in tracks.items()}
    positions = sequence.positions
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


def _figures(track: Track, time: FloatArray, height: FloatArray) -> dict[str, float]:
    """Return the errors of a track's heights against known ones."""
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


_COLUMNS = (
    Column("n", "height_rms", ".0f", len),
    Column("height m", "height_rms"),
    Column("largest", "height_max", ".2f", max),
    Column("< 0.8 m", "within", ".0%", np.mean),
    Column("NEES", "height_nees"),
    Column("horizontal m", "horizontal"),
    Column("floors right", "floors", ".0%", np.mean),
)


def heights_table(scores: pd.DataFrame) -> str:
    """Return a row for each group and track: medians over recordings, shares and the largest."""
    rows = [
        ((group, track), part)
        for group, found in parts(scores)
        for track, part in parts(found, by="track", whole=None)
    ]
    return table(rows, _COLUMNS, ("group", "track"), notes=[_NOTE])
