"""Products and interpolation of long stacks of rotations: SciPy's results, but faster.

SciPy multiplies a stack element by element, and its `Slerp` prepares all intervals for any number
of times.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import FloatArray


def composed(first: Rotation, second: Rotation) -> Rotation:
    """Return `first * second` for stacks of equal length; one of them may be a single rotation."""
    px, py, pz, pw = np.moveaxis(first.as_quat(), -1, 0)
    qx, qy, qz, qw = np.moveaxis(second.as_quat(), -1, 0)
    quat_xyzw = np.stack(
        [
            pw * qx + qw * px + (py * qz - pz * qy),
            pw * qy + qw * py + (pz * qx - px * qz),
            pw * qz + qw * pz + (px * qy - py * qx),
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )
    return Rotation.from_quat(quat_xyzw)


def slerp(known: FloatArray, rotations: Rotation, time: FloatArray) -> Rotation:
    """Interpolate rotations at a constant rate between neighbours.

    Args:
        known: (N,) times of the rotations [s], strictly increasing, N > 1.
        rotations: N rotations.
        time: (M,) from `known[0]` to `known[-1]` [s], in any order.

    Returns:
        M rotations.
    """
    interval = np.maximum(np.searchsorted(known, time) - 1, 0)
    used, of_time = np.unique(interval, return_inverse=True)
    before = rotations[used]
    turns = composed(before.inv(), rotations[used + 1]).as_rotvec()[of_time]
    share = (time - known[interval]) / (known[interval + 1] - known[interval])
    return composed(before[of_time], Rotation.from_rotvec(turns * share[:, None]))
