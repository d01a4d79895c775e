"""Tracks in TUM format: lines `t x y z qx qy qz qw`, body to world."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError, ReadError
from stario.sequences.files import atomic_write
from stario.sequences.readers.checked import rotations
from stario.sequences.readers.text import Column, RowFormat, read_table
from stario.sequences.sequence import Trajectory

_REMEDY = "pass track.trajectory, or Track.from_states(states).trajectory"

_FIELDS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write the valid poses with 9 decimals.

    Raises:
        InputError: there is no valid pose, the folder does not exist, or an argument has the wrong
            type.
    """
    check_type("trajectory", trajectory, Trajectory, _REMEDY)
    valid = trajectory.valid
    if not valid.any():
        raise InputError("trajectory", "no valid pose", "at least one")
    rows = np.column_stack(
        [trajectory.time[valid], trajectory.position_W[valid], trajectory.quat_xyzw[valid]]
    )
    with atomic_write(path) as file:
        np.savetxt(file, rows, fmt="%.9f", delimiter=" ")


def read_tum(path: Path | str) -> Trajectory:
    """Read a TUM track; lines starting with `#` and empty lines are skipped.

    Raises:
        ReadError: the file cannot be read, or a line does not hold eight finite numbers with
            increasing time and a unit quaternion; the error names line and field.
    """
    path, row_format, count = Path(path), RowFormat(delimiter=None), len(_FIELDS)
    numbered = row_format.rows(path)
    for number, line in numbered:
        if (cells := len(line.split())) != count:
            expected = f"{count}: {' '.join(_FIELDS)}"
            raise ReadError(path, f"line {number}", f"{cells} values", expected)
    places = [Column(k, title) for k, title in enumerate(_FIELDS)]
    rows = read_table(path, places, row_format).values

    def refusal(k: int, field: str, found: str, expected: str) -> ReadError:
        return ReadError(path, f"line {numbered[k][0]}, {field}", found, expected)

    if not (finite := np.isfinite(rows)).all():
        k, column = np.argwhere(~finite)[0].tolist()
        raise refusal(k, _FIELDS[column], repr(numbered[k][1].split()[column]), "a finite number")
    if not (later := np.diff(rows[:, 0]) > 0.0).all():
        k = int(np.argmin(later))
        found = f"{rows[k + 1, 0]!s} after {rows[k, 0]!s}"
        raise refusal(k + 1, "t", found, "strictly increasing seconds")
    lines = np.array([number for number, _ in numbered])
    attitude_WB = rotations(path, "qx qy qz qw", rows[:, 4:], "xyzw", lines, "line")
    return Trajectory(rows[:, 0], rows[:, 1:4], attitude_WB)
