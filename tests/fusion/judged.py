"""Recordings aligned for judging, and a predictor of a known share of their true displacements."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from stario.fusion.evaluation.benchmark.aligned import Aligned, aligned_recording, predictions
from stario.fusion.evaluation.benchmark.displacement_error import (
    RecordingErrors,
    recording_errors,
)
from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning
from stario.sequences.sequence import ImuSequence, PositionTrack


def with_waypoints(walk: ImuSequence, every: float = 8.0) -> ImuSequence:
    truth = walk.truth
    assert truth is not None
    time = np.arange(1.0, 70.0, every)
    xy = truth.at(time).position_W[:, :2]
    return replace(walk, truth=None, positions=PositionTrack(time, xy, "waypoints"))


@cache
def aligned_once(recording: ImuSequence) -> Aligned:
    return aligned_recording(recording, Path("walk"))


class Stub:
    """Predictor of the true displacements of successive windows, scaled and rotated."""

    def __init__(self, walk: ImuSequence, scale: float = 1.0, yaw: float = 0.0) -> None:
        [piece] = aligned_once(walk).pieces
        known = piece.position_W
        steps = np.exp(-1j * piece.yaw_WN[:-2]) * (known[2:] - known[:-2])
        steps = scale * np.exp(1j * yaw) * steps[: piece.stream.window_count]
        steps = np.pad(steps, (0, piece.stream.window_count - len(steps)), "edge")
        steps = np.exp(-1j * piece.stream.headings) * steps  # in the windows' frames
        self.displacement_H = np.stack([steps.real, steps.imag, 0.0 * steps.real], axis=1)
        self.served = 0

    def predict(self, windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, self.served = self.served, self.served + len(windows)
        covariance = np.broadcast_to(0.01 * np.eye(3), (len(windows), 3, 3))
        return self.displacement_H[first : self.served], covariance


def errors_of(recording: ImuSequence, stub: Stub | PedestrianDeadReckoning) -> RecordingErrors:
    aligned = aligned_once(recording)
    return recording_errors(aligned, predictions(stub, aligned))


def horizontal_path(walk: ImuSequence) -> float:
    truth = walk.truth
    assert truth is not None
    return replace(truth, position_W=truth.position_W * [1.0, 1.0, 0.0]).path_length()
