"""A generic CSV: `t,gx,gy,gz,ax,ay,az` with units in the header and optional ground truth columns.

The header names each column and its unit, `t [s],gx [rad/s],...,ax [m/s^2],...`, in any order and
separated by commas, semicolons or tabs like the rows below it; comments (`#`) may precede it:

- `t` in s, ms, us or ns, from any origin, or as ISO dates, read exactly and returned as seconds
  since the first IMU row; `gx,gy,gz` angular rate in rad/s or deg/s; `ax,ay,az` specific force in
  m/s^2 or g (-m/s^2 or -g if the device reports gravity, as Apple's do). Units that are not named
  are rad/s, m/s^2 and, for time, the unit that gives a plausible sample rate.
- `mx,my,mz` magnetic field in uT (or nT, mT, T, gauss), in separate rows or in those of the IMU;
  blank, `NA` or `nan` where it was not sampled.
- ground truth: `px,py,pz` [m] in a world with z up and `qx,qy,qz,qw`, body to world. A row may
  leave it blank (truth at a lower rate), or gyroscope and accelerometer (truth at other times).
- or only `px,py` or `px,py,pz`: waypoints (if their median interval is two seconds or more), or
  a track of positions, for example from satellites.

A sample written as `nan` stays NaN; other columns are ignored.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import NORM_TOLERANCE
from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import magnetometer
from stario.sequences.readers.clocks import time_unit
from stario.sequences.readers.columns import (
    IMU,
    MAGNETIC,
    TRUTH,
    Column,
    Header,
    is_header,
    read_header,
    unit_factor,
)
from stario.sequences.readers.lines import (
    ends_within_a_row,
    first_lines,
    read_lines,
    unquoted,
    with_seconds,
)
from stario.sequences.readers.text import cell_value, is_missing, read_quickly, rows_below
from stario.sequences.sequence import (
    BoolArray,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
)
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import ACCEL_UNITS, GYRO_UNITS, MAGNETIC_UNITS, TIME_UNITS

_log = logging.getLogger(__name__)

_MIN_WAYPOINT_INTERVAL = 2.0
"""Minimum median interval between waypoints [s]; positions at a shorter one are a track."""

_HEAD_LINES = 200
"""Number of lines within which the header must be for a file to be recognised."""


def read_generic_csv(path: Path) -> ImuSequence:
    """Read a generic CSV in the format that the module's docstring describes."""
    lines = read_lines(path)
    header = read_header(path, lines)
    if len(lines) > header.lines + 1 and ends_within_a_row(path, header.separator):
        # The recorder was killed while it wrote: all earlier rows are complete.
        _log.warning("%s: skipped the last line, %d, which is cut short", path, len(lines))
        rows = _rows_carefully(path, lines[:-1], header)
    else:
        rows = _rows_quickly(path, header) or _rows_carefully(path, lines, header)
    gyro, gyro_converted = _vectors(path, header, rows, "g", GYRO_UNITS)
    accel, accel_converted = _vectors(path, header, rows, "a", ACCEL_UNITS)
    truth, positions = _ground_truth(path, rows)
    field = None
    if "mx" in rows.table:
        vectors, _ = _vectors(path, header, rows, "m", MAGNETIC_UNITS)
        field = magnetometer(rows.time, vectors, held=False)
    return ImuSequence(
        name=path.stem,
        time=rows.time[rows.is_imu],
        gyro=gyro[rows.is_imu],
        accel=accel[rows.is_imu],
        truth=truth,
        positions=positions,
        magnetometer=field,
        converted=frozenset(
            sensor
            for sensor, done in (("gyro", gyro_converted), ("accel", accel_converted))
            if done
        ),
    )


@dataclass(frozen=True)
class _Rows:
    """Columns by canonical name, times [s], mask of IMU samples, and line numbers of the rows."""

    table: dict[str, FloatArray]
    time: FloatArray
    is_imu: BoolArray
    line_numbers: Sequence[int]


def _rows_quickly(path: Path, header: Header) -> _Rows | None:
    """Return the rows of a large file if every row is complete, else None."""
    columns = header.columns
    names = ["t", *(name for name in (*IMU, *MAGNETIC, *TRUTH) if name in columns)]
    used = [columns[name].index for name in names]
    quick = read_quickly(path, header.lines, header.separator, used)
    if quick is None:
        return None
    stamps = quick.numbers(columns["t"].index)
    per_second = _per_second(path, columns["t"], quick.values[:, 0])
    if stamps is not None and stamps.dtype.kind == "i":
        time = np.asarray((stamps - stamps[0]) / per_second, dtype=np.float64)
    elif stamps is not None and per_second == 1 and stamps[0] == 0.0:
        time = np.asarray(stamps, dtype=np.float64)
    else:  # long decimals must be subtracted before they are rounded
        return None
    count = len(time)
    return _Rows(
        table=dict(zip(names, quick.values.T, strict=True)),
        time=time,
        is_imu=np.ones(count, dtype=np.bool_),
        line_numbers=range(quick.first_row, quick.first_row + count),
    )


def _rows_carefully(path: Path, lines: list[str], header: Header) -> _Rows:
    columns = header.columns
    below = rows_below(path, lines, header.lines)
    numbered = [(number, unquoted(line, header.separator)) for number, line in below]
    if with_seconds(numbered[0][1]) != numbered[0][1]:
        numbered = [(number, with_seconds(line)) for number, line in numbered]
        columns = {**columns, "t": replace(columns["t"], unit="s")}
        header = replace(header, columns=columns)
    used = [name for name in (*IMU, *MAGNETIC, *TRUTH) if name in columns]
    values = _numbers(path, numbered, header.separator, [columns[name] for name in used])
    is_imu = _imu_rows(numbered, header, values[:, : len(IMU)])
    if not is_imu.any():
        raise ReadError(path, "gx", "no row with IMU samples", "numbers in every IMU column")
    return _Rows(
        table={name: values[:, k] for k, name in enumerate(used)},
        time=_seconds(path, numbered, header, int(np.argmax(is_imu))),
        is_imu=is_imu,
        line_numbers=[number for number, _ in numbered],
    )


def is_generic_csv(path: Path) -> bool:
    """Return whether a file starts with a header that names columns of this format."""
    return is_header(first_lines(path, _HEAD_LINES, comments=True))


def _numbers(
    path: Path, numbered: list[tuple[int, str]], separator: str, columns: list[Column]
) -> FloatArray:
    """Return the given columns as (N, K), with blank cells as NaN."""
    text = "\n".join(line for _, line in numbered)
    used = [column.index for column in columns]
    with suppress(ValueError, IndexError):
        return np.loadtxt(text.split("\n"), delimiter=separator, ndmin=2, usecols=used)
    text = _blank(separator).sub("nan", text)
    with suppress(ValueError, IndexError):
        return np.loadtxt(text.split("\n"), delimiter=separator, ndmin=2, usecols=used)
    return np.array([_row(path, number, line, separator, columns) for number, line in numbered])


def _blank(separator: str) -> re.Pattern[str]:
    """Return a pattern for blank cells within a line; a line end is not a blank."""
    blanks = rf"[^\S\n{separator}]*"
    return re.compile(
        rf"(?<={separator}){blanks}(?={separator}|$)|^{blanks}(?={separator})", flags=re.MULTILINE
    )


def _row(path: Path, number: int, line: str, separator: str, columns: list[Column]) -> list[float]:
    """Parse one row slowly, to raise an error that names its line and column."""
    cells = line.split(separator)
    needed = 1 + max(column.index for column in columns)
    if len(cells) < needed:
        separator_fix = f"separate the values by {separator!r} as in the header"
        fix = separator_fix if len(cells) == 1 else "is the file cut short?"
        raise ReadError(path, f"line {number}", f"{len(cells)} values", f"{needed}", fix)
    row = []
    for column in columns:
        cell = cells[column.index].strip()
        try:
            row.append(cell_value(cell))
        except ValueError:
            where = f"line {number}, {column.title}"
            fix = "write a decimal point" if "," in cell else ""
            raise ReadError(path, where, repr(cell), "a number", fix) from None
    return row


def _imu_rows(numbered: list[tuple[int, str]], header: Header, values: FloatArray) -> BoolArray:
    """Return the mask of IMU samples: rows whose IMU cells are not all blank."""
    is_imu = np.ones(len(values), dtype=np.bool_)
    indices = [header.columns[name].index for name in IMU]
    for k in np.flatnonzero(np.isnan(values).all(axis=1)):
        cells = numbered[k][1].split(header.separator)
        is_imu[k] = not all(is_missing(cells[index]) for index in indices)
    return is_imu


def _seconds(
    path: Path, numbered: list[tuple[int, str]], header: Header, origin: int
) -> FloatArray:
    """Return seconds since the row `origin`, computed exactly from the digits."""
    column = header.columns["t"]
    stamps = []
    for number, line in numbered:
        cell = line.split(header.separator, column.index + 1)[column.index].strip()
        try:
            stamps.append(Decimal(cell))
        except InvalidOperation:
            where = f"line {number}, {column.title}"
            raise ReadError(path, where, repr(cell), "a time") from None
    finite = np.array([float(stamp) for stamp in stamps if stamp.is_finite()])
    per_second = _per_second(path, column, finite)
    start = next((stamp for stamp in stamps[origin:] if stamp.is_finite()), Decimal(0))
    return np.array([float((stamp - start) / per_second) for stamp in stamps])


def _vectors(
    path: Path, header: Header, rows: _Rows, letter: str, known: Mapping[str, float]
) -> tuple[FloatArray, bool]:
    """Return three columns (N, 3) in the first unit of `known`, and whether they were converted."""
    names = [letter + axis for axis in "xyz"]
    factors = np.array([unit_factor(path, header.columns[name], known) for name in names])
    values = np.stack([rows.table[name] for name in names], axis=1)
    return values * factors, bool((factors != 1.0).any())


def _per_second(path: Path, column: Column, time: FloatArray) -> int:
    """Return the units per second, as the header names them or else inferred from the rate."""
    if not column.unit:
        with suppress(ReadError):
            return time_unit(path, time)
    return unit_factor(path, column, TIME_UNITS)


def kind_of_positions(time: FloatArray) -> Literal["positions", "waypoints"]:
    """Return what positions at two or more times (N,) [s] are: waypoints, or a track."""
    sparse = float(np.median(np.diff(time))) >= _MIN_WAYPOINT_INTERVAL
    return "waypoints" if sparse else "positions"


def _ground_truth(path: Path, rows: _Rows) -> tuple[Trajectory | None, PositionTrack | None]:
    """Return the poses, or else the positions; None if fewer than two rows hold them."""
    names = [name for name in TRUTH if name in rows.table]
    if not names:
        return None, None
    values = np.stack([rows.table[name] for name in names], axis=1)
    kept = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(rows.time))
    has_attitude = "qx" in names
    listed = len(kept) > 0 and not rows.is_imu[kept[0] : kept[-1] + 1].any()
    if listed and not has_attitude:  # without samples in between, they may be in any order
        kept = kept[np.argsort(rows.time[kept], kind="stable")]
    kept = kept[increasing_mask(rows.time[kept])]
    if len(kept) < 2:
        what = ("ground truth", "trajectory") if has_attitude else ("a position", "track")
        _log.warning("%s: %d rows hold %s, too few for a %s", path, len(kept), *what)
        return None, None
    time, values = rows.time[kept], values[kept]
    if not has_attitude:
        return None, PositionTrack(time, values, kind_of_positions(time))
    norm = np.linalg.norm(values[:, 3:], axis=1)
    bad = np.abs(norm - 1.0) > NORM_TOLERANCE
    if bad.any():
        k = int(np.argmax(bad))
        where = f"line {rows.line_numbers[kept[k]]}, qx qy qz qw"
        fix = "leave the row's truth blank"
        raise ReadError(path, where, f"norm {norm[k]:.4g}", "a unit quaternion", fix)
    return Trajectory(time, values[:, :3], Rotation.from_quat(values[:, 3:])), None
