"""RNIN: `{data_train,data_val,data_test}/<n>/SenseINS.csv` (Chen et al., ISMAR 2021), 200 Hz.

Columns by name: `times` (or `time`) [s], `gyro_x..` [rad/s], `acce_x..` [m/s^2], poses from motion
capture, `gt_q_w..z`, `gt_p_x..` [m], and visual-inertial odometry, `vio_q_w..z`, `vio_p_x..` [m],
both of the IMU in a world with z up, and the odometry's bias estimates. As the authors do, the
biases of the last row are subtracted, and the odometry's pose is the ground truth if there is no
motion capture, in which case `gt_q` is constant.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import magnetometer, trajectory
from stario.sequences.readers.published.fields import MAGNETIC, header_names, read_columns
from stario.sequences.sequence import ImuSequence

_FILE = "SenseINS.csv"
_STEMS = {
    **dict.fromkeys(("gyro", "acce", "gt_p", "vio_p", "vio_gyro_bias", "vio_acce_bias"), "xyz"),
    **dict.fromkeys(("gt_q", "vio_q"), "wxyz"),
}
_MAGNETIC = ("magnet", "mag", "magn")
"""Stems of the magnetic field's columns [uT], which only some copies have."""

_OWN = ("gt_q_w", "gt_p_x", "vio_q_w", "vio_p_x")


def read_rnin(path: Path) -> ImuSequence:
    """Read a recording from its folder or its `SenseINS.csv`."""
    file = path / _FILE if path.is_dir() else path
    if not file.is_file():
        raise ReadError(file, "file", "no such file", f"a recording's {_FILE}")
    clock = "times" if "times" in header_names(file) else "time"
    time, fields = read_columns(file, (clock, 10**9), _STEMS, _MAGNETIC)
    source = "gt" if (np.ptp(fields["gt_q"], axis=0) > 0).any() else "vio"
    folder = file.resolve().parent  # numbers restart in each folder: `data_train-12`
    return ImuSequence(
        name=f"{folder.parent.name}-{folder.name}" if folder.name.isdecimal() else folder.name,
        time=time,
        gyro=fields["gyro"] - fields["vio_gyro_bias"][-1],
        accel=fields["acce"] - fields["vio_acce_bias"][-1],
        truth=trajectory(file, time, fields[f"{source}_p"], fields.rotations(f"{source}_q")),
        magnetometer=magnetometer(time, fields.get(MAGNETIC)),
    )


def is_rnin(path: Path) -> bool:
    """Return whether a path is a folder with `SenseINS.csv` or a CSV with its columns."""
    if path.is_dir():
        return (path / _FILE).is_file()
    return path.name == _FILE or len(set(_OWN) & set(header_names(path))) >= 2
