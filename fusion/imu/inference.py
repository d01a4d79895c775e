"""From intervals to displacements: windows of the last second, and the network's inference.

Inference is stateful: a track's windows in time order, with the memory cleared after each gap.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stario.fusion.imu.intervals import Flags, Window
from stario.fusion.values.checked import floored
from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.windows import (
    WINDOW_RATE,
    WINDOW_SECONDS,
    facing,
    mean_heading,
    resample,
    rotated_windows,
)

MIN_DISPLACEMENT_SIGMA = 5e-3
"""Minimum standard deviation of a second's displacement [m], whatever the network predicts."""

FLAGGED_SCALE = 4.0
"""Factor on the covariance of windows with spikes, saturated or missing samples (sigma doubled)."""

SLOPE_SIGMA = 0.03
"""Standard deviation of the floor's slope: the networks learned on level floors, and are sure of
the height. With it the median position NEES of KIPD, some of whose walks climb, falls from 12.4 to
7.2, that of RIDI from 4.6 to 3.8; with 0.05 that of OxIOD would be 1.4 (2.4 expected)."""

_ASYMMETRY = 1e-5
"""Largest asymmetry of predicted covariances, relative to their largest element: 32-bit rounding
and no more."""


class WindowDisplacement(NamedTuple):
    """Displacement over a window, in its levelled frame N.

    Attributes:
        d_N: (3,) [m].
        covariance_N: (3, 3) [m^2].
        R_NB: (3, 3) levelled attitude at the window's start.
    """

    d_N: FloatArray
    covariance_N: FloatArray
    R_NB: FloatArray


def slope_variance(d: FloatArray) -> FloatArray:
    """Return the variance [m^2] of the heights of displacements (..., 3) [m] due to slopes."""
    return np.asarray(SLOPE_SIGMA**2 * np.square(d[..., :2]).sum(axis=-1))


_TAIL_SAMPLES = 4
"""Samples kept from the previous interval: half a step of the window's grid at the fastest rate."""


class WindowBuffer:
    """The last second of unbroken samples.

    Args:
        rate: number of intervals per second.
    """

    def __init__(self, rate: int) -> None:
        self._grid = np.arange(round(WINDOW_RATE / rate)) / WINDOW_RATE
        # Each interval's part of a window: samples, levelled attitude at its start, and flag.
        self._parts: deque[tuple[NDArray[np.float32], FloatArray, bool]] = deque(
            maxlen=round(rate * WINDOW_SECONDS)
        )
        self._tail: FloatArray | None = None  # time and turned IMU (k, 7) before the interval

    def clear(self) -> None:
        """Drop all samples, so that no window spans a gap."""
        self._parts.clear()
        self._tail = None

    def add(self, table: FloatArray, attitudes: FloatArray, flags: Flags) -> None:
        """Add the next interval's samples (n, 7) with their levelled attitudes (n, 3, 3)."""
        rows = np.empty_like(table)
        rows[:, 0] = table[:, 0]
        rows[:, 1:4] = (attitudes @ table[:, 1:4, None])[:, :, 0]
        rows[:, 4:] = (attitudes @ table[:, 4:, None])[:, :, 0]
        tail, self._tail = self._tail, rows[-_TAIL_SAMPLES - 1 : -1]
        # The first average reaches half a grid step back, into the tail.
        samples = rows if tail is None else np.concatenate([tail, rows])
        imu_N = resample(samples[:, 0], samples[:, 1:], table[0, 0] + self._grid)
        flagged = flags.gyro or flags.accel or flags.missing
        self._parts.append((imu_N.astype(np.float32).T, attitudes[0], flagged))

    def window(self) -> Window | None:
        """Return the second that ends with the newest interval, once it is complete."""
        if len(self._parts) < (self._parts.maxlen or 0):
            return None
        imu_N, R_NB, flagged = zip(*self._parts, strict=True)
        heading = float(mean_heading(facing(np.array(R_NB))))
        return Window(np.concatenate(imu_N, axis=1), R_NB[0], heading, any(flagged))


BATCH = 512
"""Number of windows given to a model at once."""


class Predictor(Protocol):
    """Interface that a navigator requires of a model; `DisplacementModel` implements it.

    That of a recurrent network also has `is_recurrent`, true, and `predict_next`, as
    `DisplacementModel`: its predictions depend on the track's earlier windows.
    """

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Predict displacement (B, 3) [m] and covariance (B, 3, 3) [m^2] of windows (B, 6, 200).

        A window is one second at 200 Hz: angular rate [rad/s], then specific force [m/s^2], gravity
        included. Windows and predictions are in frame H: z up, the device's heading zero.
        """
        ...


class StatefulInference:
    """A model's predictions for the windows of one track.

    Args:
        model: the model; its network may remember earlier windows.
        updates: number of windows that begin within the length of one.

    Attributes:
        updates: that number.
        is_recurrent: whether predictions depend on earlier windows, and so on gaps.
        memory: what a recurrent network remembers, as arrays and numbers; None at the start, after
            a gap, and of other networks.
    """

    def __init__(self, model: Predictor, updates: int) -> None:
        self._model: Any = model
        self.updates, self.memory = updates, None
        self.is_recurrent = bool(getattr(model, "is_recurrent", False))

    def restart(self) -> None:
        """Clear the memory of windows before a gap."""
        self.memory = None

    def predict(
        self, windows_N: NDArray[np.float32], heading: FloatArray, begins: BoolArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Predict the track's next windows, given to the model in the device's heading frame H.

        Args:
            windows_N: (B, 6, 200), one or more, in a gravity-aligned frame N.
            heading: (B,) heading of the device in N [rad].
            begins: (B,) whether each is the first window after a gap; None for none of them.

        Returns:
            displacement (B, 3) [m] and covariance (B, 3, 3) [m^2] in N.

        Raises:
            InputError: the model's predictions are not arrays of these shapes, or a covariance is
                asymmetric.
        """
        restarts = (
            np.flatnonzero(begins).tolist() if self.is_recurrent and begins is not None else []
        )
        edges = sorted({*range(0, len(heading), BATCH), *restarts, len(heading)})
        answers = []
        for first, stop in pairwise(edges):
            if first in restarts:
                self.restart()
            windows_H = rotated_windows(windows_N[first:stop], -heading[first:stop])
            answers.append(self._predicted(windows_H))
        mean_H, covariance_H = map(np.concatenate, zip(*answers, strict=True))
        R_NH = about_z(heading).as_matrix()
        with np.errstate(invalid="ignore"):  # the estimator refuses values that are not finite
            mean_N: FloatArray = (R_NH @ mean_H[:, :, None])[:, :, 0]
            return mean_N, R_NH @ covariance_H @ R_NH.transpose(0, 2, 1)

    def _predicted(self, windows_H: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        if self.is_recurrent:
            *answer, self.memory = self._model.predict_next(windows_H, self.updates, self.memory)
        else:
            answer = self._model.predict(windows_H)
        return _checked(answer, len(windows_H))


def _checked(answer: Any, count: int) -> tuple[FloatArray, FloatArray]:
    """Return a model's predictions as arrays: other shapes would be broadcast, or fail unnamed."""
    expected = f"displacements ({count}, 3) and covariances ({count}, 3, 3)"
    try:
        mean, covariance = (np.asarray(part, dtype=np.float64) for part in answer)
    except (TypeError, ValueError):
        found = f"no pair of arrays from its `predict`, but {type(answer).__name__}"
        raise InputError("model", found, expected) from None
    if mean.shape != (count, 3) or covariance.shape != (count, 3, 3):
        found = f"shapes {mean.shape} and {covariance.shape} from its `predict`"
        raise InputError("model", found, expected)
    finite = covariance[np.isfinite(covariance).all(axis=(1, 2))]  # others are refused one by one
    asymmetry = np.abs(finite - finite.transpose(0, 2, 1)).max(initial=0.0)
    if asymmetry > _ASYMMETRY * np.abs(finite).max(initial=0.0):
        raise InputError("model", "asymmetric covariances from its `predict`", "symmetric ones")
    return mean, covariance


def displacements_of(
    network: StatefulInference, windows: Sequence[Window], begins: BoolArray | None = None
) -> list[WindowDisplacement]:
    """Predict the displacements of windows, with inflated and floored covariances.

    `begins` is as for `StatefulInference.predict`.
    """
    windows_N = np.stack([window.imu_N for window in windows])
    heading = np.array([window.heading for window in windows])
    mean_N, covariance_N = network.predict(windows_N, heading, begins)
    flagged = np.array([window.flagged for window in windows])
    covariance_N = np.where(flagged[:, None, None], FLAGGED_SCALE, 1.0) * covariance_N
    with np.errstate(invalid="ignore", over="ignore"):  # the estimator refuses such values
        covariance_N[:, 2, 2] += slope_variance(mean_N)
    return [
        WindowDisplacement(d_N, floored(C, MIN_DISPLACEMENT_SIGMA), window.R_NB)
        for d_N, C, window in zip(mean_N, covariance_N, windows, strict=True)
    ]
