"""A generic CSV: `t,gx,gy,gz,ax,ay,az` with units in the header and optional ground truth columns.

The guide to formats (examples/guides/formats.md) says what users may write. The header names each
column and its unit, in any order, or a row below it does; comments (`#`) may precede it. Units that
are not named are rad/s, m/s^2, uT and, for time, the unit that gives a plausible sample rate. Times
are read exactly and returned as seconds since the first IMU row.

A sample written as `nan` stays NaN. Positions without attitude are waypoints if their median
interval is two seconds or more, or else a track; a row may lack gyroscope and accelerometer.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers import checked, columns, text
from stario.sequences.readers.clocks import Samples, clock_unit, resample_to_gyro
from stario.sequences.readers.table_head import refuse_several_devices
from stario.sequences.sequence import (
    BoolArray,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Satellites,
    Trajectory,
)
from stario.sequences.time_order import increasing_mask
from stario.sequences.units import ACCEL_UNITS, GYRO_UNITS, MAGNETIC_UNITS

_log = logging.getLogger(__name__)

_MIN_WAYPOINT_INTERVAL = 2.0
"""Minimum median interval between waypoints [s]; positions at a shorter one are a track."""

_SHARED_ROWS = 0.75
"""Share of the gyroscope's rows with an accelerometer below which that is interpolated."""

_ALTERNATING = 0.1
"""Share of neighbouring rows of which one holds it, above which the rows alternate."""

_ZERO_ROWS, _EITHER = 0.05, 0.9
"""Share of rows of zeros of each sensor, and of rows with just one sensor, from which they are
separate rows: neither sensor at rest reads exactly 0, 0, 0."""


def read_generic_csv(path: Path) -> ImuSequence:
    """Read a generic CSV in the format that the module's docstring describes."""
    rows = _read_rows(path)
    gyro, gyro_factor = rows.vectors("g", GYRO_UNITS)
    accel, accel_factor = rows.vectors("a", ACCEL_UNITS)
    rows, time, gyro, accel, alone = _samples(rows, gyro, accel)
    truth, positions = _ground_truth(rows)
    field = rows.vectors("m", MAGNETIC_UNITS)[0] if "mx" in rows.values else None
    barometer = None
    if place := rows.columns.get(columns.PRESSURE):
        values = rows.values[columns.PRESSURE]
        barometer = checked.barometer(path, place.title, rows.time, values, place.unit)
    converted = {
        "gyro": gyro_factor != 1.0,
        "accel": abs(accel_factor) != 1.0,
        "sign": accel_factor < 0.0,
    }
    return ImuSequence(
        name=path.stem,
        time=time,
        gyro=gyro,
        accel=accel,
        truth=truth,
        positions=positions,
        magnetometer=checked.magnetometer(rows.time, field, held=False),
        barometer=barometer,
        satellites=_satellites(rows),
        source=f"generic CSV{rows.assumed}",
        converted=frozenset(sensor for sensor, done in converted.items() if done),
        alone_s=alone,
    )


def is_generic_csv(path: Path) -> bool:
    """Return whether a file starts with a header that names IMU columns of this format."""
    return bool(columns.named_columns(path) & set(columns.IMU))


@dataclass(frozen=True)
class _Rows:
    """Columns (N,) of a file by canonical name, times [s], IMU samples; `assumed` of `Samples`."""

    path: Path
    columns: Mapping[str, text.Column]
    values: dict[str, FloatArray]
    time: FloatArray
    is_imu: BoolArray
    line_numbers: text.IntArray
    assumed: str

    def vectors(self, letter: str, known: Mapping[str, float]) -> tuple[FloatArray, float]:
        """Return three columns (N, 3) in the first unit of `known`, and the factor to it."""
        names = [letter + axis for axis in "xyz"]
        factor = columns.unit_of_axes(self.path, [self.columns[name] for name in names], known)[1]
        return np.stack([self.values[name] for name in names], axis=1) * factor, factor


def _read_rows(path: Path) -> _Rows:
    lines = text.read_lines(path)
    header = columns.read_header(path, lines)
    separator, places, clock = header.separator, header.columns, header.columns["t"]
    decimal = text.decimal_mark(lines[header.lines :], separator)
    cells = _first_cells(path, lines, header, decimal)
    dated = text.with_seconds(cells[clock.index : clock.index + 1])
    row_format = text.RowFormat(header.lines, separator, decimal, dated != cells[clock.index :][:1])
    wanted = {name: places[name] for name in ("t", *columns.QUANTITIES) if name in places}
    table = _table(path, wanted, row_format, lines)
    names = list(wanted)[: len(table.columns)]
    _warn_of_wide_rows(table, header)
    refuse_several_devices(table, header.titles, places["gx"].index)
    is_imu = _imu_rows(table, [names.index(name) for name in columns.IMU])
    if not is_imu.any():
        raise ReadError(path, "gx", "no row with IMU samples", "numbers in every IMU column")
    finite = table.values[np.isfinite(table.values[:, 0]), 0]
    if row_format.dated:
        clock = replace(clock, unit="s")
    unit_ns, assumed = clock_unit(path, clock, finite, or_seconds=True)
    time = table.seconds(unit_ns, int(np.argmax(is_imu)))
    values = dict(zip(names, table.values.T, strict=True))
    read = {name: places[name] for name in names}
    return _Rows(path, read, values, time, is_imu, table.line_numbers, assumed)


def _table(
    path: Path, wanted: dict[str, text.Column], row_format: text.RowFormat, lines: list[str]
) -> text.Table:
    """Return columns; without the rare ones, the last, where these hold something else."""
    cut = text.ends_within_a_row(path, row_format.delimiter)
    try:
        return text.read_table(path, list(wanted.values()), row_format, cut, lines)
    except ReadError as error:
        common = [place for name, place in wanted.items() if name not in columns.RARE]
        if len(common) == len(wanted):
            raise
        table = text.read_table(path, common, row_format, cut, lines)
        _log.warning("pressure and satellites skipped: %s", error)
        return table


def _first_cells(path: Path, lines: list[str], header: columns.Header, decimal: str) -> list[str]:
    """Return the cells of the first row, checked to be no more than there are titles."""
    numbered = enumerate(lines[header.lines :], header.lines + 1)
    number, first = next(((k, line) for k, line in numbered if text.is_row(line)), (0, ""))
    cells = text.unquoted(first, header.separator, decimal).rstrip(f"{header.separator} ")
    count = cells.count(header.separator) + 1
    if count > len(header.titles):
        found, expected = f"{count} values", f"{len(header.titles)} as in the header"
        fix = "name every column, and write decimal points"
        raise ReadError(path, f"line {number}", found, expected, fix)
    return cells.split(header.separator)


def _warn_of_wide_rows(table: text.Table, header: columns.Header) -> None:
    """Say that rows hold more values than there are titles: two lines became one, for example."""
    mark, most = header.separator, len(header.titles) - 1
    wide = [number for number, line in table.rows if line.rstrip(f"{mark} ").count(mark) > most]
    if wide:
        more = f" and {len(wide) - 1} others" if len(wide) > 1 else ""
        _log.warning(
            "%s: line %d%s: more values than the header has titles; the first %d were read",
            table.path, wide[0], more, most + 1,
        )  # fmt: skip


def _imu_rows(table: text.Table, imu: list[int]) -> BoolArray:
    """Return the mask (N,) of IMU samples: rows whose IMU cells are not all blank."""
    is_imu = np.ones(len(table.values), dtype=np.bool_)
    if len(empty := np.flatnonzero(np.isnan(table.values[:, imu]).all(axis=1))):
        cells = zip(*(table.cells(table.columns[k].index) for k in imu), strict=True)
        is_imu[empty] = ~np.array([all(map(text.is_missing, row)) for row in cells])[empty]
    return is_imu


def _samples(
    rows: _Rows, gyro: FloatArray, accel: FloatArray
) -> tuple[_Rows, FloatArray, FloatArray, FloatArray, dict[str, float]]:
    """Return rows, times (N,), gyroscope, accelerometer (N, 3), `ImuSequence.alone_s`.

    If the sensors are mostly in different rows, the accelerometer is interpolated to those of the
    gyroscope, and the time of all rows starts at the first one at which both are known.
    """
    known = rows.is_imu & np.isfinite(rows.time)
    gyro, accel = _without_zeros(rows.path, gyro, accel)
    of_gyro, of_accel = (known & ~np.isnan(values).any(axis=1) for values in (gyro, accel))
    shared = of_accel[of_gyro]
    apart = len(shared) > 0 and shared.mean() < _SHARED_ROWS
    if apart and shared.any():  # a sensor that fails for a while stays NaN, to be counted
        apart = np.diff(shared).mean() > _ALTERNATING
    if of_accel.sum() < 2 or not apart:
        return rows, rows.time[rows.is_imu], gyro[rows.is_imu], accel[rows.is_imu], {}
    ns = np.rint(np.where(known, rows.time, 0.0) * 1e9).astype(np.int64)
    rates, forces = Samples(ns[of_gyro], gyro[of_gyro]), Samples(ns[of_accel], accel[of_accel])
    stamps, rate, force, alone = resample_to_gyro(rows.path, rates, forces)
    rows = replace(rows, time=rows.time - float(stamps[0]) * 1e-9)
    return rows, text.seconds(stamps, stamps[0]), rate, force, alone


def _without_zeros(
    path: Path, gyro: FloatArray, accel: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return both sensors (N, 3) with NaN for zeros that stand for the one that was not read."""
    no_gyro, no_accel = ((values == 0.0).all(axis=1) for values in (gyro, accel))
    if min(no_gyro.mean(), no_accel.mean()) < _ZERO_ROWS or (no_gyro != no_accel).mean() < _EITHER:
        return gyro, accel
    _log.warning("%s: rows of zeros are those of the other sensor: both are joined by time", path)
    return np.where(no_gyro[:, None], np.nan, gyro), np.where(no_accel[:, None], np.nan, accel)


def _satellites(rows: _Rows) -> Satellites | None:
    known = {
        name: columns.RARE_UNITS[name][rows.columns[name].unit] * rows.values[name]
        for name in columns.SATELLITE_HEADER
        if name in rows.values
    }
    if not known:
        return None
    try:
        latlon_deg = checked.in_degrees(rows.path, np.stack([known["lat"], known["lon"]], axis=1))
    except ReadError as error:  # satellites are optional
        _log.warning("satellites skipped: %s", error)
        return None
    rest = {attribute: known[name] for name, attribute in checked.OPTIONAL.items() if name in known}
    return checked.satellites(rows.time, latlon_deg, rest)


def kind_of_positions(time: FloatArray) -> Literal["positions", "waypoints"]:
    """Return what positions at two or more times (N,) [s] are: waypoints, or a track."""
    sparse = float(np.median(np.diff(time))) >= _MIN_WAYPOINT_INTERVAL
    return "waypoints" if sparse else "positions"


def _ground_truth(rows: _Rows) -> tuple[Trajectory | None, PositionTrack | None]:
    """Return the poses, or else the positions; None if fewer than two rows hold them."""
    names = [name for name in (*columns.TRUTH, columns.SIGMA) if name in rows.values]
    if not names:
        return None, None
    values = np.stack([rows.values[name] for name in names], axis=1)
    kept = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(rows.time))
    has_attitude = "qx" in names
    listed = len(kept) > 0 and not rows.is_imu[kept[0] : kept[-1] + 1].any()
    if listed and not has_attitude:  # without samples in between, they may be in any order
        kept = kept[np.argsort(rows.time[kept], kind="stable")]
    kept = kept[increasing_mask(rows.time[kept])]
    if len(kept) < 2:
        what = ("ground truth", "trajectory") if has_attitude else ("a position", "track")
        _log.warning("%s: %d rows hold %s, too few for a %s", rows.path, len(kept), *what)
        return None, None
    time, values = rows.time[kept], values[kept]

    lines = rows.line_numbers[kept]
    if not has_attitude:
        sigma = values[:, -1] if columns.SIGMA in names else None
        if sigma is not None and sigma.min() <= 0.0:
            where = f"line {lines[np.argmin(sigma)]}, {columns.SIGMA}"
            raise ReadError(rows.path, where, f"{sigma.min():g}", "a standard deviation above 0 m")
        place = values if sigma is None else values[:, :-1]
        return None, PositionTrack(time, place, kind_of_positions(time), sigma=sigma)
    attitude_WB = checked.rotations(rows.path, "qx qy qz qw", values[:, 3:], "xyzw", lines, "line")
    return Trajectory(time, values[:, :3], attitude_WB), None
