"""Displacements of a network along the IMU's own levelled attitude, and the track through them.

Windows overlap by half: each contributes the mean velocity over its second, and the velocity
between two ticks is the mean over the windows that cover them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stario.fusion.imu.direction import Complex
from stario.fusion.imu.stateful import Predictor, StatefulInference
from stario.sequences.errors import InputError
from stario.sequences.findings import warn
from stario.sequences.inspection.checks import check_units
from stario.sequences.inspection.constant_values import dead_axes
from stario.sequences.levelled_stream import TICK_SECONDS, LevelledStream, levelled_streams
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.windows import WINDOW_SECONDS

UPDATES = round(WINDOW_SECONDS / TICK_SECONDS)
"""Number of windows that begin within the length of one."""

_BATCH = 128


class Piece(NamedTuple):
    """An unbroken stretch of a recording with the displacements of its M windows.

    Attributes:
        stream: IMU, levelled without the truth.
        displacement_N: (M, 3) displacement over the second from tick m [m].
        covariance_N: (M, 3, 3) covariance [m^2].
    """

    stream: LevelledStream
    displacement_N: FloatArray
    covariance_N: FloatArray

    @property
    def windows(self) -> Complex:
        """Horizontal displacements (M,) [m]."""
        return np.asarray(self.displacement_N[:, 0] + 1j * self.displacement_N[:, 1])

    def track(self) -> Complex:
        """Return the horizontal position (K,) [m] at the stream's ticks, 0 at the first."""
        steps, cover = self.windows / UPDATES, np.ones(UPDATES)
        total, count = np.convolve(steps, cover), np.convolve(np.ones(len(steps)), cover)
        track = np.concatenate([[0.0], np.cumsum(total / count)])
        return track[: len(self.stream.R_NB)]


def usable_streams(sequence: ImuSequence) -> list[LevelledStream]:
    """Return the unbroken stretches of a recording, levelled.

    Raises:
        InputError: there is no unbroken stretch of 2 s, or a unit is wrong.
    """
    check_units(sequence)
    warn(sequence.name, dead_axes(sequence))
    streams = levelled_streams(sequence)
    if not streams:
        raise InputError(f"{sequence.name}: samples", "no unbroken stretch", "one of 2 s")
    return streams


def predicted(model: Predictor, stream: LevelledStream) -> Piece:
    """Return a stretch with the network's predictions, its memory cleared before."""
    network = StatefulInference(model, UPDATES)
    windows, heading = stream.windows(), stream.headings
    parts = [
        network.predict(windows[first : first + _BATCH], heading[first : first + _BATCH])
        for first in range(0, len(windows), _BATCH)
    ]
    displacement, covariance = zip(*parts, strict=True)
    return Piece(stream, np.concatenate(displacement), np.concatenate(covariance))
