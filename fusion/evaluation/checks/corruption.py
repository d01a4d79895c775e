"""Faults to inject into a recording: each modifies its samples or its measured displacements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stario.sequences.arrays import interpolated
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence

ModifySamples = Callable[[ImuSequence, np.random.Generator], ImuSequence]
ModifyPredictions = Callable[[FloatArray, FloatArray, FloatArray, np.random.Generator], None]
"""Function that modifies displacements (M, 3) and covariances (M, 3, 3) in place. Its first
argument is the fraction (M,) of all windows up to and including each."""


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
    half = 0.5 * duration
    return [
        Fault("none"),
        Fault("network off by 1 m for 5 s", modify_predictions=_offset_block(5.0 / duration, 1.0)),
        Fault("5 % of windows off by 2 m", modify_predictions=_outliers(0.05, 2.0)),
        Fault("covariance 100 times too small", modify_predictions=_overconfident(0.01)),
        *(Fault(f"gap of {length:g} s", gap(half, length)) for length in (0.1, 1.0, 3.0)),
        *(Fault(f"{share:.0%} of samples dropped", drops(share)) for share in (0.05, 0.2)),
        *(Fault(f"{rate:g} Hz", _resampled(rate)) for rate in (190.0, 500.0)),
        Fault("accelerometer clipped", _clipped(0.98)),
        *(Fault(f"one NaN in {field}", _one_nan(field)) for field in ("time", "gyro", "accel")),
        Fault("one NaN from the network", modify_predictions=_nan_prediction(0)),
        Fault("one NaN in the covariance", modify_predictions=_nan_prediction(1)),
        Fault("1 % duplicated, 1 % swapped", _reordered(0.01)),
        Fault("three wild timestamps", _wild_times(3)),
        Fault("ten spikes", _spikes(10)),
    ]


def _offset_block(share: float, metres: float) -> ModifyPredictions:
    def modify_predictions(
        fraction: FloatArray, mean: FloatArray, covariance: FloatArray, rng: np.random.Generator
    ) -> None:
        mean[(fraction > 0.5) & (fraction <= 0.5 + share), 0] += metres

    return modify_predictions


def _outliers(share: float, metres: float) -> ModifyPredictions:
    def modify_predictions(
        fraction: FloatArray, mean: FloatArray, covariance: FloatArray, rng: np.random.Generator
    ) -> None:
        selected = rng.random(len(mean)) < share
        mean[selected] += rng.choice([-metres, metres], (int(selected.sum()), 3)) / np.sqrt(3.0)

    return modify_predictions


def _overconfident(factor: float) -> ModifyPredictions:
    def modify_predictions(
        fraction: FloatArray, mean: FloatArray, covariance: FloatArray, rng: np.random.Generator
    ) -> None:
        covariance *= factor

    return modify_predictions


def _nan_prediction(which: int) -> ModifyPredictions:
    def modify_predictions(
        fraction: FloatArray, mean: FloatArray, covariance: FloatArray, rng: np.random.Generator
    ) -> None:
        (mean, covariance)[which][len(mean) // 2] = np.nan

    return modify_predictions


def _kept(sequence: ImuSequence, keep: BoolArray) -> ImuSequence:
    return replace(
        sequence, time=sequence.time[keep], gyro=sequence.gyro[keep], accel=sequence.accel[keep]
    )


def gap(start: float, seconds: float) -> ModifySamples:
    """Remove `seconds` of samples, from `start` seconds after the first sample on."""

    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        since = sequence.time - sequence.time[0] - start
        return _kept(sequence, (since <= 0.0) | (since >= seconds))

    return modify_samples


def drops(share: float) -> ModifySamples:
    """Remove a share of the samples at random."""
    return lambda sequence, rng: _kept(sequence, rng.random(len(sequence)) >= share)


def _resampled(rate: float) -> ModifySamples:
    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        time = np.arange(sequence.time[0], sequence.time[-1], 1.0 / rate)
        gyro, accel = (
            interpolated(time, sequence.time, values) for values in (sequence.gyro, sequence.accel)
        )
        return replace(sequence, time=time, gyro=gyro, accel=accel)

    return modify_samples


def _clipped(quantile: float) -> ModifySamples:
    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        limit = float(np.quantile(np.abs(sequence.accel).max(axis=1), quantile))
        return replace(sequence, accel=np.clip(sequence.accel, -limit, limit))

    return modify_samples


def _one_nan(field: str) -> ModifySamples:
    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        values = getattr(sequence, field).copy()
        values[len(values) // 2] = np.nan
        return replace(sequence, **{field: values})

    return modify_samples


def _reordered(share: float) -> ModifySamples:
    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        order = np.arange(len(sequence))
        for k in np.flatnonzero(rng.random(len(order) - 1) < share):
            order[[k, k + 1]] = order[[k + 1, k]]
        order = np.repeat(order, 1 + (rng.random(len(order)) < share))
        return replace(
            sequence,
            time=sequence.time[order],
            gyro=sequence.gyro[order],
            accel=sequence.accel[order],
        )

    return modify_samples


def _wild_times(count: int) -> ModifySamples:
    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        time = sequence.time.copy()
        time[rng.integers(0, len(time), count)] += 1e6
        return replace(sequence, time=time)

    return modify_samples


def _spikes(count: int) -> ModifySamples:
    def modify_samples(sequence: ImuSequence, rng: np.random.Generator) -> ImuSequence:
        gyro, accel = sequence.gyro.copy(), sequence.accel.copy()
        gyro[rng.integers(0, len(gyro), count // 2), 1] += 200.0
        accel[rng.integers(0, len(accel), count - count // 2), 2] += 500.0
        return replace(sequence, gyro=gyro, accel=accel)

    return modify_samples
