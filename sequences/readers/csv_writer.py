"""Writing a generic CSV: samples, rarer data and truth share rows where their times agree."""

from __future__ import annotations

from math import isnan
from pathlib import Path

import numpy as np

from stario.sequences.arrays import check_type
from stario.sequences.files import atomic_write
from stario.sequences.readers import checked, columns
from stario.sequences.sequence import FloatArray, ImuSequence


def write_csv(path: Path | str, sequence: ImuSequence) -> None:
    """Write a recording so that `read_generic_csv` returns the same numbers; never a partial file.

    Samples of magnetometer and barometer, what a satellite receiver reported, and the truth's valid
    poses or positions go into the IMU's rows where their times are equal and into separate rows
    elsewhere; the truth's velocity and covariance have no column. The reader counts time from the
    first IMU sample.

    Raises:
        InputError: the folder does not exist, or `sequence` has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "call write_csv(path, sequence)")
    truth, field, track = sequence.truth, sequence.magnetometer, sequence.positions
    titles, parts = [columns.HEADER], list[tuple[FloatArray, FloatArray]]()
    if field is not None:
        titles.append(columns.MAGNETIC_HEADER)
        parts.append((field.time, field.field))
    if truth is not None:
        titles.append(columns.TRUTH_HEADER)
        poses = np.column_stack([truth.position_W, truth.quat_xyzw])
        parts.append((truth.time[truth.valid], poses[truth.valid]))
    elif track is not None:
        titles += columns.TRUTH_HEADER.split(",")[: track.position_W.shape[1]]
        titles += [] if track.sigma is None else [columns.SIGMA_HEADER]
        values = [track.position_W, *([] if track.sigma is None else [track.sigma])]
        parts.append((track.time[track.valid], np.column_stack(values)[track.valid]))
    if sequence.barometer is not None:
        titles.append(columns.PRESSURE_HEADER)
        parts.append((sequence.barometer.time, sequence.barometer.pressure_hPa[:, None]))
    if sequence.satellites is not None:
        reported = sequence.satellites
        known = {name: getattr(reported, attribute) for name, attribute in checked.OPTIONAL.items()}
        known = {name: values for name, values in known.items() if values is not None}
        titles += [columns.SATELLITE_HEADER[name] for name in ("lat", "lon", *known)]
        parts.append((reported.time, np.column_stack([reported.latlon_deg, *known.values()])))
    with atomic_write(path) as file:
        file.write("\n".join([",".join(titles), *_rows(sequence, parts)]) + "\n")


def _rows(sequence: ImuSequence, parts: list[tuple[FloatArray, FloatArray]]) -> list[str]:
    """Return the IMU's rows with the columns of parts, whose NaN are blank, in the order of time.

    Values stay in order: they share only IMU rows newer than all before them. A row without IMU
    samples precedes the first later IMU row.
    """
    table = np.column_stack([sequence.time, sequence.gyro, sequence.accel])
    newest = np.maximum.accumulate(np.nan_to_num(sequence.time, nan=-np.inf))
    advances = np.flatnonzero(np.diff(newest, prepend=-np.inf) > 0)
    place = dict(zip(sequence.time[advances].tolist(), advances.tolist(), strict=True))
    own = sorted({t for time, _ in parts for t in time.tolist()} - set(place))
    place |= {t: k for k, t in enumerate(own, len(table))}
    rows = [",".join(map(repr, row)) for row in table.tolist()]
    rows += [f"{t!r}{',' * len(columns.IMU)}" for t in own]
    for time, values in parts:
        texts = (",".join("" if isnan(x) else repr(x) for x in row) for row in values.tolist())
        known = dict(zip([place[t] for t in time.tolist()], texts, strict=True))
        blank = "," * (values.shape[1] - 1)
        rows = [f"{row},{known.get(k, blank)}" for k, row in enumerate(rows)]
    before = np.searchsorted(newest, own) - 0.5
    order = np.argsort(np.append(np.arange(len(table)), before), kind="stable")
    return [rows[k] for k in order.tolist()]
