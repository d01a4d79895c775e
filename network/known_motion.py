"""Known motion: the distance of a window from those that weights were trained on.

Five features that do not depend on its yaw describe a window; those of the training windows are
summarised by their k-means centres (Lloyd 1982), which are stored on the card. A window further
from every centre than 95 % of the training windows is outside the known motion: there a network's
errors exceed its stated sigma. Ranges of single features are a weak test: for people, phones and
places unseen in training, 84 to 99 % of the windows lay outside according to the centres, with
twice the mean NIS, but only 2 to 22 % according to the ranges.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stario.sequences.attitude.levelling import STILL_ACCEL
from stario.sequences.legs import LegStream
from stario.sequences.sequence import STANDARD_GRAVITY, BoolArray, FloatArray
from stario.sequences.windows import (
    WINDOW_RATE,
    WINDOW_SAMPLES,
    WINDOW_SECONDS,
    WorldStream,
    cut_windows,
    window_starts,
)

FEATURES = ("acceleration", "turning", "fast", "middle", "vertical")
"""Root mean squares of linear acceleration [m/s^2] and angular rate [rad/s]; shares [1] of the
acceleration's power above 10 Hz, between 3 and 10 Hz, and along the vertical."""

STEP_SECONDS = 5.0
"""Length of the stretches whose step rate is estimated [s]."""

_CENTRES = 200
_WINDOWS_OF_CENTRE = 20
"""Minimum number of windows without overlap per centre: with fewer, the centres become the windows
themselves, and no other window is near them."""

_MIN_WINDOWS = 60
"""Minimum number of windows without overlap, a minute, to summarise known motion."""

_MAX_WINDOWS = 20_000
_AT_ONCE = 256
_WALKING = 0.3
_PERCENTILE = 95.0

OUTSIDE_VARIANCE = 2.0
"""Variance factor well outside, where the mean NIS was 5 to 7 against 2 to 3 inside."""


@dataclass(frozen=True)
class KnownMotion:
    """Summary of the training windows.

    Attributes:
        centres: k-means centres of the windows, each five numbers on the scales of
            `scaled_features`.
        limit: distance to the nearest centre that 95 % of the training windows do not exceed.
        ranges: 1st and 99th percentile of each of `FEATURES`, of "step_rate" [Hz] and of "speed"
            [m/s], for reports.
    """

    centres: tuple[tuple[float, ...], ...]
    limit: float
    ranges: dict[str, tuple[float, float]]

    def novelty(self, windows: NDArray[np.float32]) -> FloatArray:
        """Return the distance (B,) of windows (B, 6, 200) to known motion, 1 at the limit."""
        distances, _ = self._tree.query(scaled_features(features(windows)))
        return np.asarray(distances / self.limit)

    def is_unfamiliar(self, windows: NDArray[np.float32]) -> BoolArray:
        """Return which windows (B, 6, 200) move, and unlike those of the training."""
        moves = np.linalg.norm(windows[:, 3:].std(axis=2), axis=1) > STILL_ACCEL
        return np.asarray(moves & (self.novelty(windows) > 1.0))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(np.array(self.centres))

    def variance_factor(self, windows: NDArray[np.float32]) -> FloatArray:
        """Return factors (B,) on the variance of predictions: 1 inside, rising outside."""
        return np.asarray(np.clip(2.0 * self.novelty(windows) - 1.0, 1.0, OUTSIDE_VARIANCE))

    def extended(self, other: KnownMotion | None) -> KnownMotion:
        """Return this motion and another, with this limit: that of weights that keep both."""
        if other is None:
            return self
        both = dict(self.ranges)
        for key, (low, high) in other.ranges.items():
            known_low, known_high = both.get(key, (low, high))
            both[key] = min(low, known_low), max(high, known_high)
        return KnownMotion((*self.centres, *other.centres), self.limit, both)

    def as_dict(self) -> dict[str, object]:
        """Return plain values for the card; each centre is a line of numbers."""
        lines = [" ".join(f"{x:g}" for x in row) for row in self.centres]
        return {"limit": self.limit, "ranges": self.ranges, "centres": lines}


def known_motion_from_dict(content: dict[str, Any]) -> KnownMotion:
    """Rebuild known motion from the values of `as_dict`.

    Raises:
        ValueError, TypeError, KeyError: the values are malformed.
    """
    centres = tuple(tuple(float(x) for x in line.split()) for line in content["centres"])
    limit = float(content["limit"])
    ranges = {str(k): (float(low), float(high)) for k, (low, high) in content["ranges"].items()}
    whole = centres and all(len(row) == len(FEATURES) for row in centres)
    if not (whole and np.isfinite(centres).all() and 0.0 < limit < math.inf):
        raise ValueError(f"known_motion: {len(centres)} centres, limit {limit}")
    return KnownMotion(centres, limit, ranges)


def features(windows: NDArray[np.float32]) -> FloatArray:
    """Return `FEATURES` (B, 5) of windows (B, 6, 200) in a gravity-aligned frame."""
    gyro, accel = windows[:, :3].astype(np.float64), windows[:, 3:].astype(np.float64)
    accel[:, 2] -= STANDARD_GRAVITY
    varying = accel - accel.mean(axis=2, keepdims=True)
    spectrum = np.abs(np.fft.rfft(varying * np.hanning(WINDOW_SAMPLES), axis=2)) ** 2
    power = spectrum.sum(axis=1)
    frequency = np.arange(power.shape[1]) / WINDOW_SECONDS
    whole = np.maximum(power.sum(axis=1), 1e-12)
    return np.stack(
        [
            np.sqrt((accel**2).sum(axis=1).mean(axis=1)),
            np.sqrt((gyro**2).sum(axis=1).mean(axis=1)),
            power[:, frequency > 10.0].sum(axis=1) / whole,
            power[:, (frequency > 3.0) & (frequency <= 10.0)].sum(axis=1) / whole,
            spectrum[:, 2].sum(axis=1) / whole,
        ],
        axis=1,
    )


def scaled_features(values: FloatArray) -> FloatArray:
    """Rescale features (B, 5) so that equal distances are equally significant.

    Magnitudes are compared by their ratio, above the sensors' noise.
    """
    acceleration, turning, fast, middle, vertical = values.T
    return np.stack(
        [
            np.log(acceleration + 0.05),
            np.log(turning + 0.02),
            np.log(fast + 0.003),
            3.0 * middle,
            3.0 * vertical,
        ],
        axis=1,
    )


def step_rates(imu_N: NDArray[np.float32]) -> FloatArray:
    """Return the step rate (K,) [Hz] of each stretch of 5 s with walking.

    It is the strongest frequency of the vertical acceleration between 1.2 and 3.2 Hz: the cadence
    of walking and running, above that of swinging arms or legs.

    Args:
        imu_N: (N, 6) samples at 200 Hz in a gravity-aligned frame.
    """
    samples = round(STEP_SECONDS * WINDOW_RATE)
    count = len(imu_N) // samples
    vertical = imu_N[: count * samples, 5].astype(np.float64).reshape(count, samples)
    vertical = vertical[vertical.std(axis=1) > _WALKING]
    varying = (vertical - vertical.mean(axis=1, keepdims=True)) * np.hanning(samples)
    padded = 8 * samples
    power = np.abs(np.fft.rfft(varying, n=padded, axis=1)) ** 2
    frequency = np.arange(power.shape[1]) * WINDOW_RATE / padded
    walked = (frequency > 1.2) & (frequency < 3.2)
    return np.asarray(frequency[walked][np.argmax(power[:, walked], axis=1)])


def known_motion(
    streams: Sequence[WorldStream], legs: Sequence[LegStream] = ()
) -> KnownMotion | None:
    """Summarise the motion in training streams; return None for less than a minute of them.

    Args:
        streams: streams with full ground truth.
        legs: streams with weak truth.
    """
    imus = [stream.imu_W for stream in streams] + [stream.imu_N for stream in legs]
    count = sum(len(imu) // WINDOW_SAMPLES for imu in imus)
    if count < _MIN_WINDOWS:
        return None
    stride = max(20, sum(map(len, imus)) // _MAX_WINDOWS)
    values = np.concatenate([features(windows) for imu in imus for windows in _cut(imu, stride)])
    told = {
        "step_rate": np.concatenate([step_rates(imu) for imu in imus]),
        "speed": np.concatenate([_speeds(stream, stride) for stream in streams]),
    }
    most = min(_CENTRES, count // _WINDOWS_OF_CENTRE)
    centres, limit = _centres(scaled_features(values), most)
    columns = dict(zip(FEATURES, values.T, strict=True)) | told
    return KnownMotion(centres, limit, {k: _range(v) for k, v in columns.items() if len(v)})


def _cut(imu: NDArray[np.float32], stride: int) -> Iterator[NDArray[np.float32]]:
    """Yield windows (B, 6, 200) every `stride` samples, a few at a time."""
    starts = window_starts(imu, stride)
    for first in range(0, len(starts), _AT_ONCE):
        yield cut_windows(imu, starts[first : first + _AT_ONCE])


def _speeds(stream: WorldStream, stride: int) -> FloatArray:
    """Return the horizontal speeds (B,) [m/s] over the windows."""
    moved = stream.position_W[WINDOW_SAMPLES::stride] - stream.position_W[:-WINDOW_SAMPLES:stride]
    return np.asarray(np.linalg.norm(moved[:, :2], axis=1) / WINDOW_SECONDS)


def _centres(known: FloatArray, count: int) -> tuple[tuple[tuple[float, ...], ...], float]:
    from scipy.cluster.vq import kmeans2, vq

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about a centre without windows
        found, _ = kmeans2(known, count, minit="points", seed=0)
    rounded = np.round(found, 3)
    limit = max(float(np.percentile(vq(known, rounded)[1], _PERCENTILE)), 1e-3)
    return tuple(tuple(row) for row in rounded.tolist()), limit


def _range(values: FloatArray) -> tuple[float, float]:
    low, high = np.percentile(values, [1.0, 99.0])
    return round(float(low), 4), round(float(high), 4)
