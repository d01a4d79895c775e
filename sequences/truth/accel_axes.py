"""Correction of accelerometers that were logged in other axes than the gyroscope."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.conventions import axes_named
from stario.sequences.sequence import ImuSequence, Trajectory

_log = logging.getLogger(__name__)

_GRAVITY_KEPT = 0.9
"""Minimum ratio of the mean force along the vertical to its mean magnitude if axes are right."""

_BETTER, _SHARPER = 0.2, 0.02
"""Margins by which another axis order must exceed the logged and the next best in that ratio."""


def accel_axes(sequence: ImuSequence, truth: Trajectory) -> ImuSequence:
    """Rotate the accelerometer to the gyroscope's axes if it was logged in others.

    Rotated by the true attitude, the specific force averages to gravity. If it does not, but does
    in another right-handed axis order (some phones log it so), that order is used, with a warning.

    Args:
        sequence: the recording.
        truth: poses of the recording, in a world with y or z up.
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
        "%s: the accelerometer's axes are not the gyroscope's: its %s is used as x,y,z",
        sequence.name, axes_named(R.as_matrix()),
    )  # fmt: skip
    return replace(sequence, accel=R.apply(sequence.accel))
