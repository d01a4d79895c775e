"""Accelerometers that were logged in other axes than the gyroscope beside them."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.conventions import axes_named
from stario.sequences.sequence import ImuSequence, Trajectory

_log = logging.getLogger(__name__)

_GRAVITY_KEPT = 0.9
"""Share of the force's size that its mean along the vertical keeps where axes are right."""

_BETTER, _SHARPER = 0.2, 0.02
"""By how much another order must keep more than the one as logged, and than the next best."""


def accel_axes(sequence: ImuSequence, truth: Trajectory) -> ImuSequence:
    """The recording with its accelerometer in the gyroscope's axes.

    Turned by the true attitude, the specific force averages to gravity. Where it does not, and
    does for another right-handed order of its axes (some phones log it so), that is taken and said.

    Args:
        sequence: the recording.
        truth: its poses, in a world with y or z up.
    """
    finite = np.isfinite(sequence.time) & np.isfinite(sequence.accel).all(axis=1)
    times, first = np.unique(sequence.time[finite], return_index=True)
    accel = sequence.accel[finite][first]
    pose = truth.at(times)
    if not pose.valid.any():
        return sequence
    R_WB, force = pose.attitude_WB[pose.valid], accel[pose.valid]
    size = float(np.linalg.norm(force, axis=1).mean())
    turns = Rotation.create_group("O")
    up = np.array([R_WB.apply(turn.apply(force)).mean(axis=0) for turn in turns]) / size
    kept = up[:, 1:].max(axis=1)
    same = int(np.argmin(turns.magnitude()))
    best, second = np.argsort(kept)[[-1, -2]]
    if np.abs(up[same, 1:]).max() > _GRAVITY_KEPT:  # perhaps upside down: Apple's sign
        return sequence
    if kept[best] < max(_GRAVITY_KEPT, kept[same] + _BETTER, kept[second] + _SHARPER):
        return sequence
    R = turns[best]
    _log.warning(
        "%s: the accelerometer's axes are not the gyroscope's: turned to its %s",
        sequence.name, axes_named(R.as_matrix()),
    )  # fmt: skip
    return replace(sequence, accel=R.apply(sequence.accel))
