"""Input, output and complete state of an estimator's step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from stario.fusion.filter.accel_noise import AccelNoiseScale
from stario.fusion.filter.alternative import AlternativeHypothesis
from stario.fusion.filter.ekf_state import EkfState, Estimate
from stario.fusion.filter.gyro_bias import GyroBiasPrior
from stario.fusion.filter.innovations import UpdateCounts
from stario.fusion.filter.magnetic import MagneticReference
from stario.fusion.filter.map_frame import MapFrameState
from stario.fusion.filter.zero_velocity import ZeroVelocity
from stario.fusion.fixes import Accepted, Fix
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import Segment
from stario.fusion.imu.stateful import Displacement as Displacement
from stario.sequences.sequence import FloatArray


class IntervalMeasurements(NamedTuple):
    """An IMU interval and the measurements applied in it."""

    interval: ImuInterval
    offered: Displacement | None
    """Predicted displacement of the window ending here; None if no window ends, or at rest."""
    displacement: Displacement | None
    """The same with its inflated covariance; None if it was rejected."""
    bearing: tuple[EkfState, EkfState] | None
    """Filter state before and after the update with a bearing; None if there was none, and for
    recordings, whose measurements all stay in memory."""
    zero_velocity: ZeroVelocity | None
    """Measurement at rest; None if the device moved or the measurement was rejected."""
    fixes: list[Accepted]
    """Fixes applied, in order."""
    segment: Segment | None
    """The preintegrated samples; None if fixes split them."""


@dataclass(frozen=True, eq=False)
class Step:
    """Inputs of a step and the state before it, from which a late fix can repeat it."""

    before: EstimatorState
    interval: ImuInterval
    displacement: Displacement | None
    fixes: Sequence[Fix]


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """Complete state of an estimator between two intervals; never modified in place.

    Attributes:
        ekf: pose, biases, clones and their covariance.
        clones: slots of the clones, oldest first.
        map_frame: what is known about the map frame.
        stillness: sums over the last second (`StillnessDetector`).
        magnetic: usual size, dip and spread of the magnetic field.
        outlier_share: fraction of outliers among recent displacements.
        bias_prior: prior of the gyroscope's bias, as currently applied in the filter.
        accel_noise: estimated scale of the accelerometer's noise.
        alternative: the alternative hypothesis; None while all displacements fit.
        counts: updates by outcome.
        in_gap: whether the last interval had no samples.
        released: newest pose that left the window, corrected by the whole window.
        history: steps of the last second of a stream; empty for a recording.
    """

    ekf: EkfState
    clones: tuple[int, ...]
    map_frame: MapFrameState
    stillness: tuple[FloatArray | None, ...]
    magnetic: MagneticReference
    outlier_share: float
    bias_prior: GyroBiasPrior
    accel_noise: AccelNoiseScale
    alternative: AlternativeHypothesis | None
    counts: UpdateCounts
    in_gap: bool
    released: Estimate | None
    history: tuple[Step, ...] = ()
