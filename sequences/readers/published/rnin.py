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
from stario.sequences.readers.checked import trajectory
from stario.sequences.readers.published.by_name import NamedColumns, axes_of, header_names
from stario.sequences.sequence import ImuSequence

_FILE = "SenseINS.csv"
_COLUMNS = (
    *axes_of("gyro"),
    *axes_of("acce"),
    *axes_of("gt_q", "wxyz"),
    *axes_of("gt_p"),
    *axes_of("vio_q", "wxyz"),
    *axes_of("vio_p"),
    *axes_of("vio_gyro_bias"),
    *axes_of("vio_acce_bias"),
)
_MAGNETIC = ("magnet", "mag", "magn")
"""Stems of the magnetic field's columns [uT], which only some copies have."""

_OWN = ("gt_q_w", "gt_p_x", "vio_q_w", "vio_p_x")


def read_rnin(path: Path) -> ImuSequence:
    """Read a recording from its folder or its `SenseINS.csv`."""
    file = path / _FILE if path.is_dir() else path
    if not file.is_file():
        raise ReadError(file, "file", "no such file", f"a recording's {_FILE}")
    time_name = "times" if "times" in header_names(file) else "time"
    columns = NamedColumns(file, (time_name, *_COLUMNS), magnetic=_MAGNETIC)
    time = columns.seconds(time_name, unit_ns=10**9)
    captured = bool((np.ptp(columns.stack("gt_q", "wxyz"), axis=0) > 0).any())
    source = "gt" if captured else "vio"
    attitude_WB = columns.rotations(f"{source}_q")
    return ImuSequence(
        name=_name(file),
        time=time,
        gyro=columns.stack("gyro") - columns.stack("vio_gyro_bias")[-1],
        accel=columns.stack("acce") - columns.stack("vio_acce_bias")[-1],
        truth=trajectory(file, time, columns.stack(f"{source}_p"), attitude_WB),
        magnetometer=columns.magnetometer(time),
    )


def is_rnin(path: Path) -> bool:
    """Return whether a path is a folder with `SenseINS.csv` or a CSV with its columns."""
    if path.is_dir():
        return (path / _FILE).is_file()
    return path.name == _FILE or len(set(_OWN) & set(header_names(path))) >= 2


def _name(file: Path) -> str:
    """Return the name of a recording: `data_train-12`, as numbers restart in each folder."""
    folder = file.resolve().parent
    return f"{folder.parent.name}-{folder.name}" if folder.name.isdecimal() else folder.name
