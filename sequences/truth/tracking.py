"""Faults of the truth's tracking that its poses alone show: jumps, and poses that stand still."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from stario.sequences.arrays import rms, runs, scatter
from stario.sequences.findings import Finding
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, Trajectory, is_gap
from stario.sequences.truth.findings import truth_finding

_JUMP_M, _FASTEST_M_S = 0.5, 15.0
"""Length [m] and speed [m/s] above which a step between successive poses may be a jump."""

_NEIGHBOURS, _FASTER = 21, 5.0
"""Number of steps whose median speed a jump exceeds by this factor: a vehicle's steps do not."""

_FROZEN_S = 2.0
"""Time [s] for which no tracked position repeats exactly while the device moves."""

_MOVING_RAD_S, _MOVING_M_S2 = 0.2, 0.5
"""Root mean square of the rate, and scatter of the force, above which a device moves."""


@dataclass(frozen=True, eq=False)
class TrackingFaults:
    """Result of `tracking_faults`.

    Attributes:
        jumps: time [s] and length [m] of each jump of the position.
        frozen: first and last time [s] of each stretch in which the position repeats exactly while
            the device moves.
        lost: (N,) bool, which of the truth's poses repeat exactly, position and attitude, there.
    """

    jumps: tuple[tuple[float, float], ...]
    frozen: tuple[tuple[float, float], ...]
    lost: BoolArray


def tracking_faults(sequence: ImuSequence) -> TrackingFaults:
    """Find jumps and frozen stretches of a recording's true poses."""
    truth = sequence.truth
    assert truth is not None
    known = np.flatnonzero(truth.valid)
    time, position = truth.time[known], truth.position_W[known]
    same = (np.diff(position, axis=0) == 0.0).all(axis=1)
    frozen = [
        (first, last)
        for first, last in runs(same)
        if time[last] - time[first] >= _FROZEN_S and _moves(sequence, time[first], time[last])
    ]
    quat = truth.quat_xyzw[known]
    lost = np.zeros(len(truth), dtype=np.bool_)
    for first, last in frozen:
        lost[known[first : last + 1]] = (quat[first : last + 1] == quat[first]).all(axis=1)
    kept = truth.valid & ~lost  # the steps into and out of a frozen stretch are part of that fault
    return TrackingFaults(
        jumps=_jumps(truth.time[kept], truth.position_W[kept]),
        frozen=tuple((float(time[first]), float(time[last])) for first, last in frozen),
        lost=lost,
    )


def without_lost(truth: Trajectory, faults: TrackingFaults) -> Trajectory:
    """Return the truth with its lost poses invalid; they would be compared as rest."""
    return replace(truth, valid=truth.valid & ~faults.lost) if faults.lost.any() else truth


def tracking_findings(faults: TrackingFaults) -> list[Finding]:
    """Return a finding for each kind of fault."""
    found = []
    if faults.frozen:
        start, stop = max(faults.frozen, key=lambda stretch: stretch[1] - stretch[0])
        seconds = sum(stop - start for start, stop in faults.frozen)
        text = (
            f"a position that repeats exactly for {seconds:.1f} s while the device moves, "
            f"longest from {start:.1f} to {stop:.1f} s"
        )
        fix = "leave the truth's cells blank where its tracking is lost"
        found.append(truth_finding("frozen", text, fix, seconds=seconds, start_s=start))
    if faults.jumps:
        at, length = max(faults.jumps, key=lambda jump: jump[1])
        count = len(faults.jumps)
        others = f", the longest of {count} jumps" if count > 1 else ""
        text = f"a position that jumps by {length:.3g} m at {at:.2f} s{others}"
        fix = "leave the truth's cells blank around a glitch, or split the recording there"
        found.append(truth_finding("jumps", text, fix, count=count, longest_m=length))
    return found


def _jumps(time: FloatArray, position: FloatArray) -> tuple[tuple[float, float], ...]:
    if len(time) < _NEIGHBOURS:
        return ()
    steps, lengths = np.diff(time), np.linalg.norm(np.diff(position, axis=0), axis=1)
    speeds = lengths / steps
    usual = median_filter(speeds, _NEIGHBOURS, mode="nearest")
    jump = (lengths > _JUMP_M) & (speeds > _FASTEST_M_S) & (speeds > _FASTER * usual)
    jump &= ~is_gap(steps)
    return tuple((float(time[k + 1]), float(lengths[k])) for k in np.flatnonzero(jump))


def _moves(sequence: ImuSequence, start: float, stop: float) -> bool:
    inside = (sequence.time >= start) & (sequence.time <= stop)
    values = np.column_stack([sequence.gyro, sequence.accel])[inside]
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        return False
    return rms(values[:, :3]) > _MOVING_RAD_S and scatter(values[:, 3:]) > _MOVING_M_S2
