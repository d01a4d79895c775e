"""ADVIO: `<name>/iphone/*.csv` with `ground-truth/pose.csv` alongside (Cortés et al., ECCV 2018).

Rows without headers are time [s] and values; the gyroscope in rad/s, the magnetometer in uT, the
accelerometer in m/s^2 or, in some copies, in g with Apple's sign. Poses are time, position [m] and
quaternion, w first, in a world with y up; `iphone/arkit.csv` has ARKit's, used if there is no
ground truth. Poses that do not agree with the gyroscope are rejected with a warning.
"""

from __future__ import annotations

from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.phones.files import PhoneFiles, phone_recordings
from stario.sequences.readers.phones.phone import assemble_recording
from stario.sequences.sequence import ImuSequence

_PHONE = "iphone"
_POSES = ("ground-truth/pose.csv", "iphone/arkit.csv")


def read_advio(path: Path) -> ImuSequence:
    """Read a recording from its folder."""
    files = _files(path)
    if files is None:
        raise ReadError(path, _PHONE, "no gyro.csv and accelerometer.csv", "an ADVIO recording")
    poses = [path / name for name in _POSES if (path / name).is_file()][:1]
    name = path.resolve().name
    return assemble_recording(name, files, poses, orders=("wxyz",), core_motion=True)


def is_advio(path: Path) -> bool:
    """Return whether a folder holds a phone's files in `iphone` and one of the pose files."""
    return any((path / name).is_file() for name in _POSES) and _files(path) is not None


def _files(path: Path) -> PhoneFiles | None:
    folder = path / _PHONE
    found = phone_recordings(folder) if folder.is_dir() else []
    return next((files for files in found if not files.key), None)
