"""Conversion of recordings of any format to StarIO's CSV, the EuRoC layout or an archive."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stario.sequences.arrays import check_choice
from stario.sequences.errors import InputError
from stario.sequences.files import atomic_folder, atomic_write
from stario.sequences.inspection.checks import MIN_SECONDS, check_units
from stario.sequences.readers.archive import SUFFIXES as ARCHIVE_SUFFIXES
from stario.sequences.readers.archive import write_archive
from stario.sequences.readers.csv_writer import write_csv
from stario.sequences.readers.generic_csv import kind_of_positions
from stario.sequences.sequence import FloatArray, ImuSequence

log = logging.getLogger(__name__)

LAYOUTS = ("csv", "euroc", "archive")

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_POSE_HEADER = (
    "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)
_VELOCITY_HEADER = ",v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]"

EUROC_FILES = ("mav0/imu0/data.csv", "mav0/state_groundtruth_estimate0/data.csv")
"""Files of an EuRoC folder that is written, the IMU's first."""


def convert(sequence: ImuSequence, path: Path, layout: str | None = None) -> list[Path]:
    """Write a recording atomically.

    Numbers have enough digits to be read back bit for bit; the EuRoC layout holds times in integer
    nanoseconds. CSV and EuRoC drop the truth's covariance and invalid poses, the device's own
    attitude, attributes, and positions alongside true poses; CSV also drops the truth's velocity,
    floors and coordinates of waypoints, EuRoC all positions, magnetometer, barometer and
    satellites. An archive only drops positions alongside true poses, unless they are waypoints.
    Warnings name all but the invalid poses.

    Args:
        sequence: the recording.
        path: a file to write or replace, or the EuRoC recording's folder, which is new or holds
            nothing but such a recording.
        layout: one of `LAYOUTS`; None to infer it from the path's suffix, see `layout_of`.

    Returns:
        The files written.

    Raises:
        InputError: the layout is unknown, the path cannot be written, or the recording's numbers
            are not in s, rad/s and m/s^2, which the files would claim.
    """
    layout = layout_of(path, layout)
    check_content(sequence)
    _warn_about_losses(sequence, layout)
    if layout == "euroc":
        return write_euroc(path, sequence)
    if layout == "archive":
        write_archive(path, [sequence])
    else:
        write_csv(path, sequence)
    return [path]


def layout_of(path: Path, layout: str | None) -> str:
    """Return the given layout, or else csv for `.csv`, archive for `.h5`, euroc for a folder.

    Raises:
        InputError: the layout or the path's suffix is unknown, or they contradict each other.
    """
    by_suffix = {".csv": "csv", "": "euroc", **dict.fromkeys(ARCHIVE_SUFFIXES, "archive")}
    implied = by_suffix.get(path.suffix.lower())
    if layout is None:
        if implied is None:
            known = ".csv, .h5 or a folder name without a dot"
            raise InputError(str(path), path.suffix, known, "choose the layout with --to")
        return implied
    check_choice("layout", layout, LAYOUTS)
    if path.suffix and implied not in (None, layout):  # it would be read as the other one
        raise InputError(str(path), f"{path.suffix} for the layout {layout}", "a suffix that fits")
    return layout


def check_content(sequence: ImuSequence) -> ImuSequence:
    """Return the recording if its numbers are plausible in the units that the file will state.

    Raises:
        InputError: as for `check_units`.
    """
    if sequence.duration >= MIN_SECONDS:  # a shorter one is too short to check
        check_units(sequence)
    return sequence


def write_euroc(path: Path, sequence: ImuSequence) -> list[Path]:
    """Write `mav0/imu0/data.csv` and, with truth, `mav0/state_groundtruth_estimate0/data.csv`.

    Times are those of the sequence in whole nanoseconds, counted from the earliest if that is
    negative. The truth has EuRoC's first eight columns, w first, and three of velocity if known.

    Returns:
        The files written.

    Raises:
        InputError: a time is not finite, or the folder exists and holds other files.
    """
    if not np.isfinite(sequence.time).all():
        row = int(np.argmin(np.isfinite(sequence.time)))
        field, found = f"{sequence.name}: time of sample {row}", str(sequence.time[row])
        expected = "finite seconds: the EuRoC layout holds integer nanoseconds"
        raise InputError(field, found, expected, "convert to csv")
    truth = sequence.truth
    times = [sequence.time] if truth is None else [sequence.time, truth.time[truth.valid]]
    first = min(float(part.min()) for part in times if len(part))
    tables = {"imu0": (_IMU_HEADER, sequence.time, np.hstack([sequence.gyro, sequence.accel]))}
    if truth is not None and truth.valid.any():
        header, columns = _POSE_HEADER, [truth.position_W, truth.quat_xyzw[:, [3, 0, 1, 2]]]
        if truth.velocity_W is not None:
            header, columns = header + _VELOCITY_HEADER, [*columns, truth.velocity_W]
        poses = np.hstack(columns)[truth.valid]
        tables["state_groundtruth_estimate0"] = (header, truth.time[truth.valid], poses)
    with atomic_folder(path, EUROC_FILES) as folder:
        for name, (header, time, values) in tables.items():
            inner = folder / "mav0" / name
            inner.mkdir(parents=True)
            _write_table(inner / "data.csv", header, _nanoseconds(time, first), values)
    return [path / "mav0" / name / "data.csv" for name in tables]


def _nanoseconds(time: FloatArray, first: float) -> NDArray[np.int64]:
    """Return whole nanoseconds, counted from `first` if that is negative: stamps have no sign."""
    origin = round(min(first, 0.0) * 1e9)
    return np.asarray(np.round(time * 1e9), dtype=np.int64) - origin


def _write_table(path: Path, header: str, stamps: NDArray[np.int64], values: FloatArray) -> None:
    rows = (
        ",".join([str(stamp), *map(repr, row)])
        for stamp, row in zip(stamps.tolist(), values.tolist(), strict=True)
    )
    with atomic_write(path) as file:
        file.write("\n".join([header, *rows]) + "\n")


def _warn_about_losses(sequence: ImuSequence, layout: str) -> None:
    if layout == "archive":
        return
    truth, track, csv = sequence.truth, sequence.positions, layout == "csv"
    kind = "" if track is None else track.kind
    placed = track is not None and not (track.floor is None and track.latlon_deg is None)
    lost = {
        "the truth's velocity": csv and truth is not None and truth.velocity_W is not None,
        "the truth's covariance": truth is not None and truth.position_covariance_W is not None,
        f"{kind} alongside true poses": csv and truth is not None and track is not None,
        "floors and coordinates of waypoints": csv and kind == "waypoints" and placed,
        kind: not csv and track is not None,
        **{
            f"the {part}": not csv and getattr(sequence, part) is not None
            for part in ("magnetometer", "barometer", "satellites")
        },
        "the device's own attitude": sequence.device_attitude is not None,
        "its attributes": bool(sequence.attributes),
    }
    if words := ", ".join(part for part, is_lost in lost.items() if is_lost):
        log.warning("%s: %s has no place for %s: write .h5", sequence.name, layout, words)
    if track is None or truth is not None or not csv:
        return
    time = track.time[track.valid]
    if len(time) < 2:
        log.warning("%s: a CSV needs two %s: write .h5", sequence.name, kind)
    elif kind != (read_as := kind_of_positions(time)):  # by their interval
        words = "%s: a CSV's reader takes %s at such intervals for %s: write .h5"
        log.warning(words, sequence.name, kind, read_as)
