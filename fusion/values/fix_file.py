"""A file of fixes: a CSV with the header `t,kind,x,y,z,sx,sy,sz` and one fix per line.

t     time since the recording's first sample [s]
kind  position, velocity or yaw
x y z position [m] or velocity [m/s] in W; a yaw [rad] is given in x, with y and z empty
sx    standard deviation [m], [m/s] or [rad]
sy sz standard deviations of the other axes; empty, or no column, where they equal sx

Columns may be in any order, separated by commas, semicolons or tabs; numbers may have a
decimal comma where that is not the separator. `yaw [deg]` is a kind as well.
A position without z is horizontal; its height is unknown. Lines that begin with # are comments.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from stario.fusion.values.fixes import KINDS, MAX_YAW, UNKNOWN_HEIGHT, Fix, log, make_fix
from stario.fusion.values.lie import UNKNOWN_YAW
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.text import decimal_mark, read_lines
from stario.sequences.sequence import ImuSequence
from stario.sequences.time_order import increasing_mask

_COLUMNS = ("t", "kind", "x", "y", "z", "sx", "sy", "sz")
_REQUIRED = (*_COLUMNS[:3], "sx")

_UNITS = {"t": ("s",), "kind": ()}
"""Units that a header may name for a column; for the others m, m/s and rad."""


def read_fixes(path: Path | str) -> list[Fix]:
    """Read fixes from a CSV file in the format described at the top of this module.

    Raises:
        ReadError: the file cannot be read, its header or a line is invalid, or it holds no fix;
            names line and column.
    """
    path = Path(path)
    # A comment is blanked, not removed, so that errors count the lines of the file.
    lines = ["" if line.lstrip().startswith("#") else line for line in read_lines(path)]
    title = next((line for line in lines if line.strip()), "")
    separator = max(",;\t", key=title.count)
    decimal = decimal_mark(lines[lines.index(title) + 1 :], separator)
    try:
        rows = enumerate(map(_trimmed, csv.reader(lines, delimiter=separator)), start=1)
        (first, titles), *numbered = [(number, row) for number, row in rows if row] or [(1, [])]
    except csv.Error as error:
        raise ReadError(path, "file", str(error), "a readable CSV of fixes") from error
    header = [_without_unit(word).lower() for word in titles]
    if found := _wrong_column(header):
        raise ReadError(path, f"line {first}", found, f"the header {','.join(_COLUMNS)}")
    fixes = []
    for number, row in numbered:
        cells = [word.strip().replace(decimal, ".") for word in row]
        fixes.append(_read_row(path, f"line {number}", header, cells))
    if not fixes:
        raise ReadError(path, "file", "a header only", "at least one fix")
    positions = [fix for fix in fixes if fix.kind == "position"]
    if len(positions) > 2:
        _warn_of_degrees(path, positions)
    return fixes


def _warn_of_degrees(path: Path, positions: list[Fix]) -> None:
    """Say if positions differ by hardly any of their sigma, as those of a walk in degrees do."""
    extent = float(np.ptp([fix.value[:2] for fix in positions], axis=0).max())
    if 0.0 < extent < 0.1 * math.sqrt(min(fix.covariance[0, 0] for fix in positions)):
        text = "%s: its positions are within %.2g m: if x and y are degrees of latitude and "
        text += "longitude, write metres (`stario.sequences.Georeference` converts)"
        log.warning(text, path, extent)


def _trimmed(row: list[str]) -> list[str]:
    """Return a row without the blank cells at its end, which spreadsheets write."""
    width = max((k for k, cell in enumerate(row, 1) if cell.strip()), default=0)
    return row[:width]


def _wrong_column(header: Sequence[str]) -> str:
    """Return in words which column is unknown, missing or given twice; empty if none is."""
    if not header:
        return "nothing"
    for word in header:
        if word not in _COLUMNS:
            return f"an unknown column {word!r}"
        if header.count(word) > 1:
            return f"two columns {word!r}"
    missing = [word for word in _REQUIRED if word not in header]
    return f"no column {missing[0]!r}" if missing else ""


def _without_unit(title: str) -> str:
    """Return the name without its unit; the whole title if the unit is not the expected one."""
    name, _, unit = title.strip().partition("[")
    units = _UNITS.get(name.strip().lower(), ("m", "m/s", "rad"))
    return name.strip() if not unit or unit.rstrip("] ") in units else title.strip()


def check_within(fixes: Sequence[Fix], sequence: ImuSequence) -> None:
    """Check that at least one fix lies within the recording.

    Raises:
        InputError: none does; their times are then on another clock.
    """
    sample_times = sequence.time[np.isfinite(sequence.time)]
    sample_times = sample_times[increasing_mask(sample_times)]
    times, start, stop = [fix.time for fix in fixes], sample_times[0], sample_times[-1]
    if times and not any(start <= t <= stop for t in times):
        found = f"times from {min(times):.6g} to {max(times):.6g} s"
        expected = f"some within the recording's, {start:.6g} to {stop:.6g} s"
        raise InputError("fixes", found, expected, "count times from the recording's first sample")


def _read_row(path: Path, where: str, header: Sequence[str], row: Sequence[str]) -> Fix:
    if len(row) > len(header):
        raise ReadError(path, where, f"{len(row)} values", f"at most {len(header)}")
    words = [*row, *[""] * len(header)]
    cells = dict.fromkeys(_COLUMNS, "") | dict(zip(header, words, strict=False))
    kind, _, unit = cells["kind"].lower().replace(" ", "").partition("[")
    if kind not in KINDS or unit not in ("", "deg]", "rad]") or (unit and kind != "yaw"):
        expected = f"one of {', '.join(KINDS)}, yaw [deg]"
        raise ReadError(path, f"{where}, kind", repr(cells["kind"]), expected)
    axes = "xyz"[: KINDS[kind]]
    if kind == "position" and not cells["z"] and not cells["sz"]:
        cells |= {"z": "0", "sz": str(UNKNOWN_HEIGHT)}
    cells |= {f"s{a}": cells[f"s{a}"] or cells["sx"] for a in axes}
    value, sigma = (_numbers(path, where, cells, [p + a for a in axes]) for p in ("", "s"))
    if sigma.min() <= 0.0:
        raise ReadError(path, f"{where}, sigma", f"{sigma.min():g}", "a standard deviation > 0")
    if unit == "deg]":
        value, sigma = np.radians(value), np.radians(sigma)
    if kind == "yaw" and (abs(value[0]) > MAX_YAW or sigma[0] > UNKNOWN_YAW):
        found = f"{cells['x']} +- {cells['sx']}"
        remedy = "" if unit == "deg]" else "for degrees, use the kind `yaw [deg]`"
        raise ReadError(path, f"{where}, yaw", found, "radians", remedy)
    (time,) = _numbers(path, where, cells, ["t"])
    return make_fix(time, kind, value, np.diag(np.square(sigma)))  # type: ignore[arg-type]


def _numbers(
    path: Path, where: str, cells: Mapping[str, str], names: Sequence[str]
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values = []
    for name in names:
        try:
            value = float(cells[name])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ReadError(path, f"{where}, {name}", repr(cells[name]), "a finite number")
        values.append(value)
    return np.array(values)
