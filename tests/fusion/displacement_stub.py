"""A predictor of a known share of a recording's true displacements, and its errors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.displacement_error import recording_errors, usable_streams
from stario.fusion.evaluation.pedestrian import Model, piece_of
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.levelled_stream import LevelledStream
from stario.sequences.sequence import ImuSequence, PositionTrack

streams_of = cache(usable_streams)


def with_waypoints(walk: ImuSequence, every: float = 8.0) -> ImuSequence:
    truth = walk.truth
    time = np.arange(1.0, 70.0, every)
    xy = truth.at(time).position_W[:, :2]
    return replace(walk, truth=None, positions=PositionTrack(time, xy, "waypoints"))


def yaw_WN(walk: ImuSequence, stream: LevelledStream) -> np.ndarray:
    """Yaw (K,) that rotates N to the true world at each tick."""
    attitude_WB = walk.truth.at(stream.ticks).attitude_WB
    return yaw_of(attitude_WB * Rotation.from_matrix(stream.R_NB).inv())


class Stub:
    """Predictor of the true displacements of successive windows, scaled and rotated."""

    def __init__(self, walk: ImuSequence, scale: float = 1.0, yaw: float = 0.0) -> None:
        [stream] = streams_of(walk)
        known = walk.truth.at(stream.ticks).position_W[:, :2] @ [1.0, 1j]
        steps = np.exp(-1j * yaw_WN(walk, stream)[:-2]) * (known[2:] - known[:-2])
        steps = scale * np.exp(1j * yaw) * steps[: stream.window_count]
        steps = np.pad(steps, (0, stream.window_count - len(steps)), "edge")
        steps = np.exp(-1j * stream.headings) * steps  # in the windows' frames
        self.displacement_H = np.stack([steps.real, steps.imag, 0.0 * steps.real], axis=1)
        self.served = 0

    def predict(self, windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, self.served = self.served, self.served + len(windows)
        covariance = np.broadcast_to(0.01 * np.eye(3), (len(windows), 3, 3))
        return self.displacement_H[first : self.served], covariance


def errors_of(recording: ImuSequence, model: Model) -> tuple[dict[str, float], pd.DataFrame]:
    """Figures, and blocks of squared errors."""
    return recording_errors(recording, [piece_of(model, s) for s in streams_of(recording)])


def horizontal_path(walk: ImuSequence) -> float:
    truth = walk.truth
    return replace(truth, position_W=truth.position_W * [1.0, 1.0, 0.0]).path_length()
