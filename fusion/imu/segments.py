"""an interval's samples as a preintegrated segment, with the noise that holds there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, repeat

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import Segment, preintegrate
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import FloatArray

_GAP_STEPS = 10


def segment_of(
    interval: ImuInterval,
    R_WB: FloatArray,
    b_g: FloatArray,
    b_a: FloatArray,
    config: NavigatorConfig,
) -> Segment:
    """The segment from an interval's start to its end.

    Args:
        interval: samples, or a gap.
        R_WB: (3, 3) attitude at its start; only a gap needs it.
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        config: noise and gravity.
    """
    if interval.gap:
        return _unseen(interval, R_WB, b_g, b_a, config)
    noise = _noise(interval, config)
    return preintegrate(
        interval.time, interval.gyro, interval.accel, b_g, b_a, noise, config.gravity
    )


def segment_of_all(
    intervals: Sequence[ImuInterval], b_g: FloatArray, b_a: FloatArray, config: NavigatorConfig
) -> Segment:
    """The segment of several intervals in a row, none of them a gap, each with its own noise.

    The noise of their mean would spread over half a second what a step's impact did in a tenth;
    position and speed at the end are then correlated as they are not.
    """
    first, rest = intervals[0], intervals[1:]

    def joined(name: str) -> FloatArray:  # each begins with the sample that ended the one before
        return np.concatenate([getattr(first, name), *(getattr(e, name)[1:] for e in rest)])

    noise = chain.from_iterable(repeat(_noise(e, config), len(e.time) - 1) for e in intervals)
    samples = joined("time"), joined("gyro"), joined("accel")
    return preintegrate(*samples, b_g, b_a, list(noise), config.gravity)


def _unseen(
    interval: ImuInterval,
    R_WB: FloatArray,
    b_g: FloatArray,
    b_a: FloatArray,
    config: NavigatorConfig,
) -> Segment:
    """Through a gap: constant velocity, under noise wide enough for a walker.

    The attitude stays, or turns as at both ends of a short one.
    """
    hover = R_WB.T @ [0.0, 0.0, config.gravity] + b_a
    noise = replace(
        config.noise,
        gyro_noise=config.filter.gap_gyro_noise,
        accel_noise=config.filter.gap_accel_noise,
    )
    # In one step position and velocity would be in error together: no graph can invert that.
    time = np.linspace(interval.start, interval.stop, _GAP_STEPS + 1)
    gyro, accel = np.tile(b_g, (len(time), 1)), np.tile(hover, (len(time), 1))
    if interval.short_gap:
        share = np.linspace(0.0, 1.0, len(time))[:, None]
        gyro = (1.0 - share) * interval.gyro[0] + share * interval.gyro[-1]
    return preintegrate(time, gyro, accel, b_g, b_a, noise, config.gravity)


def _noise(interval: ImuInterval, config: NavigatorConfig) -> ImuNoise:
    """White noise, wider where a sensor was saturated."""
    noise, f = config.noise, config.filter
    gyro, accel = noise.gyro_noise, interval.accel_factor * noise.accel_noise
    # What a saturated sensor missed is as unknown as what happens in a gap.
    if interval.flags.gyro:
        gyro = max(gyro, f.gap_gyro_noise)
    if interval.flags.accel:
        accel = max(accel, f.gap_accel_noise)
    return ImuNoise(gyro, accel, noise.gyro_walk, noise.accel_walk)
