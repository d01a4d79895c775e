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
"""Share of the force's size that its mean in the world keeps where axes are right."""

_BETTER = 0.2


def accel_axes(sequence: ImuSequence, truth: Trajectory) -> ImuSequence:
    """The recording with its accelerometer in the gyroscope's axes.

    Turned by the true attitude, the specific force averages to gravity. Where it does not, and
    does for another right-handed order of its axes (some phones log it so), that is taken and said.

    Args:
        sequence: the recording.
        truth: its poses, in any world with a constant vertical.
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
    kept = [float(np.linalg.norm(R_WB.apply(turn.apply(force)).mean(axis=0))) for turn in turns]
    same = int(np.argmin(turns.magnitude()))
    best = int(np.argmax(kept))
    if kept[same] > _GRAVITY_KEPT * size or kept[best] < kept[same] + _BETTER * size:
        return sequence
    if kept[best] < _GRAVITY_KEPT * size:
        return sequence
    R = turns[best]
    _log.warning(
        "%s: the accelerometer's axes are not the gyroscope's: turned to its %s",
        sequence.name, axes_named(R.as_matrix()),
    )  # fmt: skip
    return replace(sequence, accel=R.apply(sequence.accel))
