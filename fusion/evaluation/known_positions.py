"""Comparison of a track with positions known without attitude: waypoints or satellite fixes."""

from __future__ import annotations

import numpy as np

from stario.fusion.evaluation.benchmark.displacement_error import fit_yaw_and_position
from stario.fusion.state import Track
from stario.sequences.arrays import interpolated
from stario.sequences.legs import jumps
from stario.sequences.sequence import MAX_TRUTH_GAP, FloatArray, ImuSequence, PositionTrack

MIN_POSITIONS = 2
"""Minimum number of positions: a shift alone fits one; with two, their distance is compared."""


def position_error(track: Track, known: PositionTrack) -> tuple[float, int]:
    """Return the horizontal error [m] at known positions after a fit of yaw and position.

    It is the root mean square over those within the track, NaN for fewer than `MIN_POSITIONS`;
    their number is returned, too.
    """
    fitted = placed(track, known)
    if fitted is None or len(fitted) < MIN_POSITIONS:
        return float("nan"), 0 if fitted is None else len(fitted)
    error = fitted.position_W - _track_at(track, fitted.time)
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))), len(fitted)


def placed(track: Track, known: PositionTrack) -> PositionTrack | None:
    """Return the known positions (n, 2) [m] that lie within a track and in none of its gaps.

    They are rotated about the vertical and shifted to fit the track best, in its frame; a single
    one lies exactly on it. None if there is none within its time.
    """
    # A track of steps has two poses per second: none of its intervals is a gap.
    longest = max(MAX_TRUTH_GAP, 1.5 * float(np.median(np.diff(track.time))))
    inside = known.valid & track.trajectory.covers(known.time, longest)
    time, truth = known.time[inside], known.position_W[inside]
    if not len(time):
        return None
    estimated = _track_at(track, time)
    fitted = fit_yaw_and_position(
        truth[:, 0] + 1j * truth[:, 1], estimated[:, 0] + 1j * estimated[:, 1]
    )
    return PositionTrack(time, np.column_stack([fitted.real, fitted.imag]), known.kind)


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
