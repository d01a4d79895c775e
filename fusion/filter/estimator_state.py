"""What goes into an estimator's step and comes out of it, and all that it knows in between."""

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
    """An IMU interval and what became of what was measured in it."""

    interval: ImuInterval
    offered: Displacement | None
    """What the network said of the window that ends here; None where there is none, or at rest."""
    displacement: Displacement | None
    """The same with its covariance as inflated, None where it was left out."""
    bearing: tuple[EkfState, EkfState] | None
    """The filter before and after a bearing of the magnetic field; None where there was none, and
    of recordings, whose measurements are kept."""
    zero_velocity: ZeroVelocity | None
    """None where the device moved, or the measurement was refused."""
    fixes: list[Accepted]
    """Those taken in, in order."""
    segment: Segment | None
    """The samples, None where fixes cut them."""


@dataclass(frozen=True, eq=False)
class Step:
    """A step that a late fix may ask to be taken again, and the state before it."""

    before: EstimatorState
    interval: ImuInterval
    displacement: Displacement | None
    fixes: Sequence[Fix]


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """Everything that an estimator knows between two intervals; nothing is changed in place.

    Attributes:
        ekf: pose, biases, clones and their covariance.
        clones: slots of the clones, oldest first.
        map_frame: where the fixes' frame lies.
        stillness: the last second's sums (`StillnessDetector`).
        magnetic: what the magnetic field usually is.
        outlier_share: of the displacements of late.
        bias_prior: of the gyroscope's bias, as it stands in the filter.
        accelerometer: what it is worth.
        sceptic: the filter without the outliers of the last seconds, where there were some.
        counts: what became of the updates.
        in_gap: whether the last interval had no samples.
        released: the newest pose that left the window, corrected by all of it.
        history: the steps of the last second of a stream.
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
