"""The network alone: displacements along the IMU's own levelled attitude, and their track.

Windows overlap by half: each contributes the mean velocity over its second, and the velocity
between two ticks is the mean over the windows that cover them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from stario.fusion.evaluation.benchmark.aligned import Aligned, Complex
from stario.fusion.imu.stateful import Predictor, StatefulInference
from stario.sequences.levelled_stream import TICK_SECONDS, LevelledStream
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

UPDATES = round(WINDOW_SECONDS / TICK_SECONDS)
"""Number of windows that begin within the length of one."""

_BATCH = 128


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of a network for the M windows of a piece.

    Attributes:
        displacement_N: (M, 3) displacement over the second from tick m [m].
        covariance_N: (M, 3, 3) covariance [m^2].
    """

    displacement_N: FloatArray
    covariance_N: FloatArray

    def track(self) -> Complex:
        """Return the horizontal position x + iy (M + 2,) [m] at the ticks, 0 at the first."""
        steps = (self.displacement_N[:, 0] + 1j * self.displacement_N[:, 1]) / UPDATES
        cover = np.ones(UPDATES)
        total, count = np.convolve(steps, cover), np.convolve(np.ones(len(steps)), cover)
        return np.concatenate([[0.0], np.cumsum(total / count)])


@runtime_checkable
class RecordingPredictor(Protocol):
    """Predictor of a whole recording that needs no network."""

    def predictions(self, recording: Aligned) -> list[Predictions]:
        """Return a predictor's predictions for every piece, in N; a network begins each anew."""
        ...


def predictions(model: Predictor | RecordingPredictor, recording: Aligned) -> list[Predictions]:
    """Return a network's predictions for every piece of a recording, in frame N.

    Args:
        model: network, its memory reset at every piece; or another predictor.
        recording: the recording, aligned with its truth.
    """
    if isinstance(model, RecordingPredictor):
        return model.predictions(recording)
    return [predict_stream(model, piece.stream) for piece in recording.pieces]


def predict_stream(model: Predictor, stream: LevelledStream) -> Predictions:
    """Return a network's predictions along an unbroken stretch, in frame N."""
    network = StatefulInference(model, UPDATES)
    windows, heading = stream.windows(), stream.headings
    parts = [
        network.predict(windows[first : first + _BATCH], heading[first : first + _BATCH])
        for first in range(0, len(windows), _BATCH)
    ]
    displacement, covariance = zip(*parts, strict=True)
    return Predictions(np.concatenate(displacement), np.concatenate(covariance))
