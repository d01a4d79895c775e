"""A file of fixes: a CSV with the header `t,kind,x,y,z,sx,sy,sz` and one fix per line.

t     time [s] since the recording's first sample
kind  position, velocity or yaw
x y z position [m] or velocity [m/s] in W; a yaw gives its yaw [rad] in x and leaves y, z
sx    standard deviation [m], [m/s] or [rad]
sy sz standard deviations of the other axes; empty where they equal sx
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stario.fusion.fixes import KINDS, Fix, make_fix
from stario.sequences.errors import InputError, ReadError
from stario.sequences.sequence import ImuSequence
from stario.sequences.time_order import advancing

_COLUMNS = ("t", "kind", "x", "y", "z", "sx", "sy", "sz")


def read_fixes(path: Path | str) -> list[Fix]:
    """The fixes of a CSV file, in the format of this module's first lines.

    Raises:
        ReadError: the file cannot be read, its header or a line does not fit; names the line.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ReadError(path, "file", str(error), "a readable CSV of fixes") from error
    expected = ",".join(_COLUMNS)
    header = [word.strip() for word in rows[0]] if rows else []
    if header != list(_COLUMNS):
        raise ReadError(path, "line 1", ",".join(header) or "nothing", f"the header {expected}")
    return [_read_row(path, k, row) for k, row in enumerate(rows[1:], start=2) if any(row)]


def check_within(fixes: Sequence[Fix], sequence: ImuSequence) -> None:
    """Refuse fixes of which none is of the recording's time.

    Raises:
        InputError: they are of another clock.
    """
    counted = sequence.time[np.isfinite(sequence.time)]
    counted = counted[advancing(counted)]
    times, start, stop = [fix.time for fix in fixes], counted[0], counted[-1]
    if times and not any(start <= t <= stop for t in times):
        found = f"times from {min(times):.6g} to {max(times):.6g} s"
        expected = f"some within the recording's, {start:.6g} to {stop:.6g} s"
        raise InputError("fixes", found, expected, "count them from the recording's first sample")


def _read_row(path: Path, number: int, row: list[str]) -> Fix:
    where = f"line {number}"
    if len(row) > len(_COLUMNS):
        raise ReadError(path, where, f"{len(row)} values", f"at most {len(_COLUMNS)}")
    cells = dict(zip(_COLUMNS, [*(word.strip() for word in row), *[""] * 8], strict=False))
    kind = cells["kind"]
    if kind not in KINDS:
        raise ReadError(path, f"{where}, kind", repr(kind), f"one of {', '.join(KINDS)}")
    axes = "xyz"[: KINDS[kind]]
    cells |= {f"s{a}": cells[f"s{a}"] or cells["sx"] for a in axes}

    def number_in(name: str) -> float:
        try:
            value = float(cells[name])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ReadError(path, f"{where}, {name}", repr(cells[name]), "a finite number")
        return value

    sigma = [number_in(f"s{a}") for a in axes]
    if min(sigma) <= 0.0:
        raise ReadError(path, f"{where}, sigma", repr(min(sigma)), "a standard deviation > 0")
    value = np.array([number_in(a) for a in axes])
    return make_fix(number_in("t"), kind, value, np.diag(np.square(sigma)))  # type: ignore[arg-type]
