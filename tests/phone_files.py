"""Files of phone apps for a simulated walk: its field and gravity, time stamps, rows of text."""

from pathlib import Path

import numpy as np

from stario.sequences import ImuSequence
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray

FIELD_W = [18.0, 5.0, -43.0]
START_NS = 1_718_030_736_872_695_300
ZYX = "time,seconds_elapsed,z,y,x"


def in_body(walk: ImuSequence, vector_W: list[float]) -> FloatArray:
    return np.asarray(walk.truth.attitude_WB.apply(vector_W, inverse=True))


def field(walk: ImuSequence) -> FloatArray:
    return in_body(walk, FIELD_W)


def gravity(walk: ImuSequence) -> FloatArray:
    return in_body(walk, [0.0, 0.0, STANDARD_GRAVITY])


def ns(walk: ImuSequence) -> list[int]:
    return [START_NS + round(t * 1e9) for t in walk.time.tolist()]


def save(path: Path, header: str, *columns: object, sep: str = ",", decimal: str = ".") -> None:
    parts = [np.asarray(c).reshape(len(np.asarray(c)), -1).tolist() for c in columns]
    rows = [
        sep.join(str(x).replace(".", decimal) for part in row for x in part)
        for row in zip(*parts, strict=True)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows] if header else rows) + "\n", encoding="utf-8")


def zyx(folder: Path, walk: ImuSequence, **sensors: FloatArray) -> None:
    """Write one file for each sensor as Sensor Logger does, columns z, y, x."""
    for name, values in sensors.items():
        save(folder / f"{name}.csv", ZYX, ns(walk), walk.time, values[:, ::-1])
