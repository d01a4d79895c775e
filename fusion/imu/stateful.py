"""Stateful inference: a track's windows in the order of time, the memory gone after each gap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stario.fusion.checked import floored
from stario.fusion.imu.intervals import ImuInterval, SampleCounts
from stario.sequences.attitude.levelling import STILL_ACCEL
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import rotated_windows

LEAST_SIGMA = 5e-3
"""No network knows a second's displacement better than this [m], whatever it says."""

FLAGGED_SCALE = 4.0
"""On the network's covariance where a window has spikes or saturated samples: twice the sigma."""

Displacement = tuple[FloatArray, FloatArray]
"""Displacement (3,) [m] and covariance (3, 3) [m^2] in the window's frame N."""


class Predictor(Protocol):
    """What a navigator needs of a model; `DisplacementModel` is one.

    A model whose network remembers earlier windows has `stateful_inference(updates)` besides, which
    gives a predictor for the windows of one unbroken stretch.
    """

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Windows (B, 6, 200) to displacement (B, 3) [m] and covariance (B, 3, 3) [m^2].

        Windows and answers are in frame H: z up, the device's heading zero.
        """
        ...


class StatefulInference:
    """What a model predicts of the windows of one track.

    Args:
        model: may remember.
        updates: windows that begin within the length of one.
    """

    def __init__(self, model: Predictor, updates: int) -> None:
        self._model, self._updates = model, updates
        self.restart()

    @property
    def is_recurrent(self) -> bool:
        """Whether earlier windows matter, so that a gap does."""
        return self._stretch is not self._model

    def restart(self) -> None:
        """Forget what was before a gap."""
        begin = getattr(self._model, "stateful_inference", None)
        self._stretch: Any = self._model if begin is None else begin(self._updates)

    def predict(
        self, windows_N: NDArray[np.float32], heading: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The stretch's next windows, shown to the model in the device's heading frame H.

        Args:
            windows_N: (B, 6, 200) in a gravity-aligned frame N.
            heading: (B,) the device's heading in N [rad].

        Returns:
            displacement (B, 3) [m] and covariance (B, 3, 3) [m^2] in N.
        """
        mean_H, covariance_H = self._stretch.predict(rotated_windows(windows_N, -heading))
        R_NH = about_z(heading).as_matrix()
        with np.errstate(invalid="ignore"):  # the estimator refuses what is not finite
            mean_N: FloatArray = (R_NH @ mean_H[:, :, None])[:, :, 0]
            return mean_N, R_NH @ covariance_H @ R_NH.transpose(0, 2, 1)

    def unfamiliar(self, windows: NDArray[np.float32]) -> int:
        """How many windows (B, 6, 200) move as nothing that the model's weights were trained on."""
        known = getattr(getattr(self._model, "card", None), "known_motion", None)
        if known is None:
            return 0
        moves = np.linalg.norm(windows[:, 3:].std(axis=2), axis=1) > STILL_ACCEL
        return int((moves & (known.novelty(windows) > 1.0)).sum())

    @property
    def memory(self) -> Any:
        """What the network remembers, as arrays and numbers; None without memory.

        Raises:
            InputError: a memory is put back into a network that has none, or the reverse.
        """
        return self._stretch.memory if self.is_recurrent else None

    @memory.setter
    def memory(self, memory: Any) -> None:
        self.restart()
        if (memory is not None) != self.is_recurrent:
            raise InputError("snapshot: network", "another kind of memory", "the same network's")
        if self.is_recurrent:
            self._stretch.memory = memory


def displacements_of(
    network: StatefulInference, intervals: Sequence[ImuInterval], counts: SampleCounts
) -> list[Displacement]:
    """The network's displacements of the intervals' windows, as far as it can be trusted.

    The windows, and those that move as nothing the weights know, are counted.
    """
    windows_N = np.stack([_window(interval) for interval in intervals])
    counts.windows += len(windows_N)
    counts.unfamiliar += network.unfamiliar(windows_N)
    heading = np.array([interval.heading for interval in intervals])
    return [
        (d_N, floored(FLAGGED_SCALE * C if interval.window_flagged else C, LEAST_SIGMA))
        for interval, d_N, C in zip(intervals, *network.predict(windows_N, heading), strict=True)
    ]


def _window(interval: ImuInterval) -> NDArray[np.float32]:
    assert interval.window is not None  # only intervals that have one are asked
    return interval.window
