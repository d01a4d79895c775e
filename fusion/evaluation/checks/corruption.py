"""Faults to inject into a recording: each modifies its samples or its measured displacements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stario.sequences.arrays import even_grid, interpolated
from stario.sequences.sequence import FloatArray, ImuSequence

Rng = np.random.Generator
ModifySamples = Callable[[ImuSequence, Rng], ImuSequence]
ModifyPredictions = Callable[[FloatArray, FloatArray, Rng], None]
"""Function that modifies displacements (M, 3) and covariances (M, 3, 3) in place."""


@dataclass(frozen=True)
class Fault:
    """A fault of the samples or of the network's predictions.

    Attributes:
        name: name in the table.
        modify_samples: function that returns the recording with the fault; None for no change.
        modify_predictions: function that modifies the predictions; None for no change.
    """

    name: str
    modify_samples: ModifySamples | None = None
    modify_predictions: ModifyPredictions | None = None


def faults(duration: float) -> list[Fault]:
    """Return every fault of the table, for a recording of this duration [s]."""
    half, block = 0.5 * duration, 5.0 / duration
    return [
        Fault("none"),
        Fault("network off by 1 m for 5 s", modify_predictions=partial(_offset_block, share=block)),
        Fault("5 % of windows off by 2 m", modify_predictions=_outliers),
        Fault("covariance 100 times too small", modify_predictions=_overconfident),
        *(Fault(f"gap of {length:g} s", gap(half, length)) for length in (0.1, 1.0, 3.0)),
        *(Fault(f"{share:.0%} of samples dropped", drops(share)) for share in (0.05, 0.2)),
        *(Fault(f"{rate:g} Hz", partial(_resampled, rate=rate)) for rate in (190.0, 500.0)),
        Fault("accelerometer clipped", _clipped),
        *(
            Fault(f"one NaN in {field}", partial(_one_nan, field=field))
            for field in ("time", "gyro", "accel")
        ),
        Fault("one NaN from the network", modify_predictions=partial(_nan_prediction, which=0)),
        Fault("one NaN in the covariance", modify_predictions=partial(_nan_prediction, which=1)),
        Fault("1 % duplicated, 1 % swapped", _reordered),
        Fault("three wild timestamps", _wild_times),
        Fault("ten spikes", _spikes),
    ]


def _offset_block(mean: FloatArray, covariance: FloatArray, rng: Rng, share: float) -> None:
    fraction = (np.arange(len(mean)) + 1.0) / len(mean)
    mean[(fraction > 0.5) & (fraction <= 0.5 + share), 0] += 1.0


def _outliers(mean: FloatArray, covariance: FloatArray, rng: Rng) -> None:
    selected = rng.random(len(mean)) < 0.05
    mean[selected] += rng.choice([-2.0, 2.0], (int(selected.sum()), 3)) / np.sqrt(3.0)


def _overconfident(mean: FloatArray, covariance: FloatArray, rng: Rng) -> None:
    covariance *= 0.01


def _nan_prediction(mean: FloatArray, covariance: FloatArray, rng: Rng, which: int) -> None:
    (mean, covariance)[which][len(mean) // 2] = np.nan


def gap(start: float, seconds: float) -> ModifySamples:
    """Remove `seconds` of samples, from `start` seconds after the first sample on."""

    def modify_samples(sequence: ImuSequence, rng: Rng) -> ImuSequence:
        since = sequence.time - sequence.time[0] - start
        return sequence.select((since <= 0.0) | (since >= seconds))

    return modify_samples


def drops(share: float) -> ModifySamples:
    """Remove a share of the samples at random."""
    return lambda sequence, rng: sequence.select(rng.random(len(sequence)) >= share)


def _resampled(sequence: ImuSequence, rng: Rng, rate: float) -> ImuSequence:
    time = even_grid(sequence.time[0], sequence.time[-1], 1.0 / rate)
    gyro, accel = (
        interpolated(time, sequence.time, values) for values in (sequence.gyro, sequence.accel)
    )
    return replace(sequence, time=time, gyro=gyro, accel=accel)


def _clipped(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    limit = float(np.quantile(np.abs(sequence.accel).max(axis=1), 0.98))
    return replace(sequence, accel=np.clip(sequence.accel, -limit, limit))


def _one_nan(sequence: ImuSequence, rng: Rng, field: str) -> ImuSequence:
    values = getattr(sequence, field).copy()
    values[len(values) // 2] = np.nan
    return replace(sequence, **{field: values})


def _reordered(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    order = np.arange(len(sequence))
    for k in np.flatnonzero(rng.random(len(order) - 1) < 0.01):
        order[[k, k + 1]] = order[[k + 1, k]]
    return sequence.select(np.repeat(order, 1 + (rng.random(len(order)) < 0.01)))


def _wild_times(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    time = sequence.time.copy()
    time[rng.integers(0, len(time), 3)] += 1e6
    return replace(sequence, time=time)


def _spikes(sequence: ImuSequence, rng: Rng) -> ImuSequence:
    gyro, accel = sequence.gyro.copy(), sequence.accel.copy()
    gyro[rng.integers(0, len(gyro), 5), 1] += 200.0
    accel[rng.integers(0, len(accel), 5), 2] += 500.0
    return replace(sequence, gyro=gyro, accel=accel)
