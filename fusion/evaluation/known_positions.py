"""Comparison of a track with positions known without attitude: waypoints or satellite fixes.

What they contradict is part of the one verdict on a recording and its track.
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.evaluation.displacement_error import fit_yaw_and_position, known_truth, planar
from stario.fusion.imu.direction import Complex
from stario.fusion.report.health import TURNED_RAD, health_findings
from stario.fusion.values.satellites import APART_M, georeference_of
from stario.fusion.values.state import Track
from stario.sequences.accuracy.metrics import align, pose_errors
from stario.sequences.arrays import even_grid, interpolated, rms, scatter
from stario.sequences.findings import Finding, verdict
from stario.sequences.geodesy import Georeference
from stario.sequences.inspection.report import Inspection, inspect_recording
from stario.sequences.legs import jumps
from stario.sequences.sequence import (
    MAX_TRUTH_GAP,
    BoolArray,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
)

MIN_POSITIONS = 2
"""Minimum number of positions: a shift alone fits one; with two, their distance is compared."""

_COURSE_S, _WAY_S = (10.0, 5.0, 3.0), 1.0
"""Times [s] over which distances between positions are compared with the track's: the first tells
the course whatever the windings of either, as long as the room allows, the second the way along
them. With positions of uncertainty sigma they are at least four times as many seconds, in which a
walker moves as far."""

_MIN_CHORDS, _RESTING_M_S = 5, 0.2
"""Least number of such distances, and speed [m/s] below which one is rest."""

_SCALED = 1.25
"""Factor between both distances, in either direction, that contradicts the track."""

_MIRRORED, _MIRRORED_M = 0.4, 2.0
"""Share of the error that a mirrored track must leave, and error [m] from which that is tested."""

_SIGMAS = 3.0
"""Error in standard deviations, both over the whole track, that contradicts the track."""

_LEARNABLE = {
    "network_contradicts",
    "network_sigma",
    "network_direction",
    "track_scale",
    "track_error",
}
"""Codes of contradictions that weights trained on the recording's truth may resolve."""


def true_path(sequence: ImuSequence) -> float:
    """Return the length of the true path [m]: with known positions, of the lines between them.

    Raises what `known_truth` does.
    """
    _, known = known_truth(sequence)
    if sequence.truth is not None:
        return sequence.truth.path_length()
    return _length(known.position_W)


def length_ratio(track: Track, sequence: ImuSequence) -> float:
    """Return a track's length per true length, by lines between known positions within it.

    Those of true poses count once a second. NaN for fewer than `MIN_POSITIONS`. Unlike an error it
    does not depend on how often the way returns.
    """
    known = _known(sequence)
    fitted = None if known is None else placed(track, known, MIN_POSITIONS)
    if fitted is None:
        return float("nan")
    return _length(_track_at(track, fitted.time)) / _length(fitted.position_W)


def _length(position: FloatArray) -> float:
    """Return the length [m] of the lines between positions (N, k) [m]."""
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())


def position_error(track: Track, known: PositionTrack) -> tuple[float, int]:
    """Return the horizontal error [m] at known positions after a fit of yaw and position.

    It is the root mean square over those within the track, NaN for fewer than `MIN_POSITIONS`;
    their number is returned, too.
    """
    fitted = placed(track, known)
    if fitted is None or len(fitted) < MIN_POSITIONS:
        return float("nan"), 0 if fitted is None else len(fitted)
    error = fitted.position_W - _track_at(track, fitted.time)
    return rms(error), len(fitted)


def placed(track: Track, known: PositionTrack, least: int = 1) -> PositionTrack | None:
    """Return the known positions (n, 2) [m] that lie within a track and in none of its gaps.

    They are rotated about the vertical and shifted to fit the track best, in its frame; a single
    one lies exactly on it. None if there are fewer than `least`.
    """
    inside = _inside(track, known)
    time, truth = known.time[inside], known.position_W[inside]
    if len(time) < least:
        return None
    estimated = _track_at(track, time)
    fitted = fit_yaw_and_position(planar(truth), planar(estimated))
    return PositionTrack(time, np.column_stack([fitted.real, fitted.imag]), known.kind)


def fitted_georeference(track: Track, known: PositionTrack) -> Georeference | None:
    """Return where a track's frame lies on the earth by known positions with coordinates.

    The track is rotated about the vertical and shifted to fit them best. None if fewer than
    `MIN_POSITIONS` of them lie within it, or they are too close together to tell a direction.
    """
    if known.latlon_deg is None:
        return None
    inside = _inside(track, known) & np.isfinite(known.latlon_deg).all(axis=1)
    if inside.sum() < MIN_POSITIONS:
        return None
    return georeference_of(known.latlon_deg[inside], _track_at(track, known.time[inside]))


def _inside(track: Track, known: PositionTrack) -> BoolArray:
    """Return which valid positions (N,) lie within a track and in none of its gaps."""
    # A track of steps has two poses per second: none of its intervals is a gap.
    longest = max(MAX_TRUTH_GAP, 1.5 * float(np.median(np.diff(track.time))))
    return known.valid & track.trajectory.covers(known.time, longest)


def _track_at(track: Track, time: FloatArray) -> FloatArray:
    """Return the horizontal track (n, 2) [m]."""
    return interpolated(time, track.time, track.trajectory.position_W[:, :2])


def shown_positions(sequence: ImuSequence, track: Track) -> PositionTrack | None:
    """Return the known positions as `placed`, to draw next to a track; None with true poses."""
    if sequence.truth is not None or sequence.positions is None:
        return None
    return placed(track, sequence.positions)


def position_error_words(track: Track, known: PositionTrack) -> str:
    """Return the error at the known positions in words."""
    error, count = position_error(track, known)
    coverage = f"{count} of {int(known.valid.sum())} {known.kind} lie within the track"
    if np.isnan(error):
        return f"{coverage}: too few to compare with"
    words = f"{coverage}: {error:.2f} m rms from them, after a fit of yaw and position"
    if sigma := known.typical_sigma:
        words += f"; their sigma is {sigma:.2g} m per axis"
    if len(found := jumps(known)):
        words += f", but jump by up to {found.max():.0f} m"
    return words


def recording_verdict(
    sequence: ImuSequence, track: Track | None, found: Inspection | None = None, train: str = ""
) -> list[Finding]:
    """Return the verdict on a recording from inspection, the run's health and known positions.

    Args:
        sequence: the recording.
        track: its main track; None if it is refused.
        found: its inspection, if there is one already.
        train: command that trains weights on it, offered where its truth could teach them.
    """
    findings = [*(found or inspect_recording(sequence)).findings]
    if track is not None:
        findings += health_findings(track.health) if track.health else ()
        findings += position_findings(track, sequence)
    spoilt = any(finding.spoils_truth for finding in findings)
    learnable = any(f.code in _LEARNABLE and f.level == "warning" for f in findings)
    if train and sequence.truth is not None and learnable and not spoilt:
        text = "Its truth can teach the weights this motion."
        findings.append(Finding("train", text, f"Run `{train}`.", level="note"))
    return verdict(findings)


def position_findings(track: Track, sequence: ImuSequence) -> list[Finding]:
    """Return how known positions, of the truth or without attitude, contradict a track."""
    known = _known(sequence)
    if known is None:
        return []
    fitted = placed(track, known, _MIN_CHORDS)
    if fitted is None:
        return []
    truth, estimate = planar(fitted.position_W), planar(_track_at(track, fitted.time))
    error = float(np.sqrt(np.mean(np.abs(truth - estimate) ** 2)))
    return [
        *_mirror_image(known.kind, truth, estimate, error),
        *_scale(known, fitted.time, truth, estimate),
        *_direction(track, sequence.truth),
        *_beyond_sigma(track, known, fitted.time, error),
    ]


def _known(sequence: ImuSequence) -> PositionTrack | None:
    """Return the known positions; those of true poses once a second."""
    truth = sequence.truth
    if truth is None or not truth.valid.any():
        return None if truth is not None else sequence.positions
    pose = truth.at(even_grid(float(truth.time[0]), float(truth.time[-1]), 1.0))
    return PositionTrack(pose.time[pose.valid], pose.position_W[pose.valid, :2], "positions")


def _mirror_image(kind: str, truth: Complex, estimate: Complex, error: float) -> list[Finding]:
    mirrored = fit_yaw_and_position(truth.conj(), estimate)
    left = float(np.sqrt(np.mean(np.abs(mirrored - estimate) ** 2)))
    if error < _MIRRORED_M or left > _MIRRORED * error:
        return []
    text = f"Mirrored, the track fits the {kind} to {left:.1f} m instead of {error:.1f} m."
    advice = (
        "Has the accelerometer the opposite sign, or are axes left-handed? Try "
        "`--accel-sign apple`, else `--axes`."
    )
    return [Finding("mirror_image", text, advice, values={"error_m": error, "mirrored_m": left})]


def _scale(
    known: PositionTrack, time: FloatArray, truth: Complex, estimate: Complex
) -> list[Finding]:
    """Compare the lengths of both ways, of their course and along their windings."""
    least = 4.0 * (known.typical_sigma or 0.0)
    *courses, way = (
        _length_ratio(time, truth, estimate, max(seconds, least), least)
        for seconds in (*_COURSE_S, _WAY_S)
    )
    course = next((ratio for ratio in courses if math.isfinite(ratio)), math.nan)
    if not (min(course, way) > _SCALED or max(course, way) < 1.0 / _SCALED):  # nor if one is NaN
        return []
    text = f"The {known.kind} say that the way is {way:.2g} times as long as the track."
    advice = "These weights do not know this motion or carrying: rely on no length of the track."
    return [Finding("track_scale", text, advice, values={"scale": way, "course_scale": course})]


def _length_ratio(
    time: FloatArray, truth: Complex, estimate: Complex, seconds: float, least: float
) -> float:
    """Return how much longer the true way is, by chords over `seconds`; NaN for too few.

    Chords in which both moved less than `least` [m], or 0.2 m/s, are rest.
    """
    after = np.searchsorted(time, time + seconds - 1e-6)
    before = np.flatnonzero(after < len(time))
    moved, told = (np.abs(p[after[before]] - p[before]) for p in (truth, estimate))
    walked = np.maximum(moved, told) > max(_RESTING_M_S * seconds, least)
    if walked.sum() < _MIN_CHORDS:
        return math.nan
    return float(moved[walked].sum() / max(float(told[walked].sum()), 1e-3))


def _direction(track: Track, truth: Trajectory | None) -> list[Finding]:
    """Compare the directions of both ways as the device sees them, which takes true attitudes."""
    if truth is None:
        return []
    fitted = pose_errors(align(track.trajectory, truth, "yaw"), truth)
    spread = scatter(fitted.truth.position_W[:, :2])
    if spread < APART_M:
        return []
    turn = -float(np.angle(np.exp(1j * fitted.yaw).mean()))
    if abs(turn) < max(TURNED_RAD, _SIGMAS * rms(fitted.position_W[:, :2]) / spread):
        return []
    degrees = math.degrees(turn)
    text = f"Seen from the device, the track's direction is {degrees:.0f} degrees off the true one."
    advice = "These weights do not know this motion or carrying: rely on no direction of the track."
    return [Finding("network_direction", text, advice, values={"turn_deg": degrees})]


def _beyond_sigma(
    track: Track, known: PositionTrack, time: FloatArray, error: float
) -> list[Finding]:
    variance = track.trajectory.position_covariance_W
    if variance is None:
        return []
    of_track = np.interp(time, track.time, np.trace(variance[:, :2, :2], axis1=1, axis2=2))
    sigma = float(np.sqrt(of_track.mean() + 2.0 * (known.typical_sigma or 0.0) ** 2))
    if error < _SIGMAS * sigma:
        return []
    text = f"The track is {error:.1f} m off the {known.kind}; its sigma is {sigma:.1f} m."
    advice = "Its uncertainty is larger than stated: are positions, clock and axes right?"
    return [Finding("track_error", text, advice, values={"error_m": error, "sigma_m": sigma})]
