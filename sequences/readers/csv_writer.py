"""Writing a generic CSV: samples, rarer data and truth share rows where their times agree."""

from __future__ import annotations

from math import isnan
from pathlib import Path

import numpy as np

from stario.sequences.arrays import check_type
from stario.sequences.files import atomic_write
from stario.sequences.readers.checked import OPTIONAL
from stario.sequences.readers.columns import (
    HEADER,
    IMU,
    MAGNETIC_HEADER,
    PRESSURE_HEADER,
    SATELLITE_HEADER,
    SIGMA_HEADER,
    TRUTH_HEADER,
)
from stario.sequences.sequence import FloatArray, ImuSequence


def write_csv(path: Path | str, sequence: ImuSequence) -> None:
    """Write a recording so that `read_generic_csv` returns the same numbers; never a partial file.

    Samples of magnetometer and barometer, what a satellite receiver reported, and the truth's valid
    poses or positions go into the IMU's rows where
    their times are equal and into separate rows elsewhere; the truth's velocity and covariance
    have no column. The reader counts time from the first IMU sample.

    Raises:
        InputError: the folder does not exist, or `sequence` has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "call write_csv(path, sequence)")
    truth, field, track = sequence.truth, sequence.magnetometer, sequence.positions
    header, rows = HEADER, _Written(sequence)
    if field is not None:
        header += f",{MAGNETIC_HEADER}"
        rows.add(field.time, field.field)
    if truth is not None:
        header += f",{TRUTH_HEADER}"
        poses = np.column_stack([truth.position_W, truth.quat_xyzw])
        rows.add(truth.time[truth.valid], poses[truth.valid])
    elif track is not None:
        header += "," + ",".join(TRUTH_HEADER.split(",")[: track.position_W.shape[1]])
        header += "" if track.sigma is None else f",{SIGMA_HEADER}"
        columns = [track.position_W] if track.sigma is None else [track.position_W, track.sigma]
        rows.add(track.time[track.valid], np.column_stack(columns)[track.valid])
    if sequence.barometer is not None:
        header += f",{PRESSURE_HEADER}"
        rows.add(sequence.barometer.time, sequence.barometer.pressure_hPa[:, None])
    if sequence.satellites is not None:
        reported = sequence.satellites
        known = {name: getattr(reported, attribute) for name, attribute in OPTIONAL.items()}
        known = {name: values for name, values in known.items() if values is not None}
        header += "," + ",".join(SATELLITE_HEADER[name] for name in ("lat", "lon", *known))
        rows.add(reported.time, np.column_stack([reported.latlon_deg, *known.values()]))
    with atomic_write(path) as file:
        file.write("\n".join([header, *rows.merged()]) + "\n")


class _Written:
    """Rows of a file under construction: the IMU's, with values that share their times."""

    def __init__(self, sequence: ImuSequence) -> None:
        table = np.column_stack([sequence.time, sequence.gyro, sequence.accel])
        self._rows = [",".join(map(repr, row)) for row in table.tolist()]
        # Added values stay in order: they share only IMU rows newer than all before them.
        self._newest = np.maximum.accumulate(np.nan_to_num(sequence.time, nan=-np.inf))
        advances = np.flatnonzero(np.diff(self._newest, prepend=-np.inf) > 0)
        self._shared = {float(sequence.time[k]): int(k) for k in advances}
        self._own: list[tuple[float, str]] = []
        self._blank = "," * len(IMU)

    def add(self, time: FloatArray, values: FloatArray) -> None:
        """Append columns on the right: values (M, K) at increasing times (M,), NaN as blank."""
        empty = "," * values.shape[1]
        tails = [empty] * len(self._rows)
        own = []
        for t, row in zip(time.tolist(), values.tolist(), strict=True):
            text = "," + ",".join("" if isnan(value) else repr(value) for value in row)
            if t in self._shared:
                tails[self._shared[t]] = text
            else:
                own.append((t, f"{t!r}{self._blank}{text}"))
        self._rows = [row + tail for row, tail in zip(self._rows, tails, strict=True)]
        self._own = [(t, row + empty) for t, row in self._own] + own
        self._blank += empty

    def merged(self) -> list[str]:
        """Return all rows; a row without IMU samples precedes the first later IMU row."""
        own = sorted(self._own, key=lambda item: item[0])
        places = np.searchsorted(self._newest, [t for t, _ in own]).tolist()
        merged: list[str] = []
        taken = 0
        for place, (_, text) in zip(places, own, strict=True):
            merged += [*self._rows[taken:place], text]
            taken = place
        return merged + self._rows[taken:]
