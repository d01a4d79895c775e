"""The filter's recipe for one epoch: propagate, measure, update, clone, report.

Derivation: error, transition and measurement as in `stario.fusion.ekf`; the displacement between
clones follows TLIO (Liu et al. 2020), on the right-invariant error (Barrau and Bonnabel 2017).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from stario.fusion.config import NavigatorConfig
from stario.fusion.ekf import StateCloningEkf
from stario.fusion.engine import UpdateResult
from stario.fusion.intake import Epoch, IntakeCounts, Start
from stario.fusion.segments import segment_of
from stario.fusion.state import Health, Innovations, NavState
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

STILL_TILT_SIGMA = 0.01
"""Of the first attitude when the device was at rest [rad]."""

SMALLEST_SIGMA = 1e-6
"""What is known exactly is given this much, so that the covariance stays positive definite."""

Measurement = tuple[FloatArray, FloatArray]
"""Displacement (3,) [m] and covariance (3, 3) [m^2] in the window's frame N."""


@dataclass(frozen=True, eq=False)
class PriorPose:
    """What is known of the first pose, at the time of the first sample.

    Attributes:
        R_WB: (3, 3) attitude.
        v_W: (3,) velocity [m/s].
        p_W: (3,) position [m].
        tilt_sigma: [rad].
        yaw_sigma: [rad].
        velocity_sigma: per axis [m/s].
        position_sigma: per axis [m].
    """

    R_WB: FloatArray
    v_W: FloatArray
    p_W: FloatArray
    tilt_sigma: float = 0.02
    yaw_sigma: float = 0.02
    velocity_sigma: float = 0.1
    position_sigma: float = 1e-3


class FilterRecipe:
    """The state-cloning EKF driven by epochs.

    Args:
        config: noise and filter settings.
        start: time and levelled attitude of the first sample.
        prior: what is known of the first pose; None starts level, at rest, at the origin.
        keep_innovations: False for streams, whose memory must not grow.
    """

    def __init__(
        self,
        config: NavigatorConfig,
        start: Start,
        prior: PriorPose | None = None,
        keep_innovations: bool = True,
    ) -> None:
        self._config = config
        self._uses_clones = config.filter.measurement == "displacement"
        self.ekf = StateCloningEkf(
            slots=config.filter.window_updates if self._uses_clones else 0, gravity=config.gravity
        )
        self._slots: deque[int] = deque()
        self._velocity_steps: deque[FloatArray] = deque(
            maxlen=round(config.filter.output_rate * WINDOW_SECONDS)
        )
        self._gate = float(chi2.ppf(config.filter.gate, 3))
        self._log = _InnovationLog(keep_innovations)
        self._initialise(start, prior)

    def step(self, epoch: Epoch, measurement: Measurement | None) -> NavState:
        """Move to the epoch's end and take in the measurement of the window that ends there."""
        if epoch.gap:
            self._forget_window()
        ekf = self.ekf
        before = ekf.v_W
        ekf.propagate(segment_of(epoch, ekf.R_WB, ekf.b_g, ekf.b_a, self._config))
        self._velocity_steps.append(ekf.v_W - before)
        if measurement is not None:
            self._update(epoch, measurement)
        if self._uses_clones and (epoch.update or epoch.gap):
            self._clone(epoch.stop)
        return self.state(in_gap=epoch.gap)

    def state(self, in_gap: bool = False) -> NavState:
        """The estimate now."""
        ekf = self.ekf
        return NavState(
            time=ekf.time,
            R_WB=ekf.R_WB,
            v_W=ekf.v_W,
            p_W=ekf.p_W,
            b_g=ekf.b_g,
            b_a=ekf.b_a,
            covariance=ekf.world_covariance(),
            in_gap=in_gap,
        )

    def innovations(self) -> Innovations:
        """Every innovation so far."""
        return self._log.stacked()

    def health(self, counts: IntakeCounts) -> Health:
        """The report so far."""
        return self._log.health(counts, self.state())

    def _initialise(self, start: Start, prior: PriorPose | None) -> None:
        f = self._config.filter
        tilt = STILL_TILT_SIGMA if start.still else f.tilt_sigma
        level = PriorPose(start.R_WB, np.zeros(3), np.zeros(3), tilt, f.yaw_sigma, f.velocity_sigma)
        pose = prior or level
        sigma = [pose.tilt_sigma] * 2 + [pose.yaw_sigma]
        sigma += [pose.velocity_sigma] * 3 + [pose.position_sigma] * 3
        sigma += [f.gyro_bias_sigma] * 3 + [f.accel_bias_sigma] * 3
        covariance = np.diag(np.square(np.maximum(sigma, SMALLEST_SIGMA)))
        zero = np.zeros(3)
        self.ekf.initialise(start.time, pose.R_WB, pose.v_W, pose.p_W, zero, zero, covariance)
        if self._uses_clones:
            self._clone(start.time)

    def _update(self, epoch: Epoch, measurement: Measurement) -> None:
        # What is not finite is the filter's to refuse and count.
        with np.errstate(invalid="ignore"):
            result = self._offer(epoch, *measurement)
        self._log.add(epoch.stop, self.ekf, result)

    def _offer(
        self, epoch: Epoch, displacement_N: FloatArray, covariance_N: FloatArray
    ) -> UpdateResult:
        covariance_N = covariance_N * self._config.filter.overlap_scale
        if self._uses_clones:
            slot = self._slots[0]
            R_WN = yaw_between(self.ekf.clone_pose(slot)[0], epoch.R_NB_window)
            return self.ekf.update_displacement(
                slot, None, R_WN @ displacement_N, R_WN @ covariance_N @ R_WN.T, self._gate
            )
        R_WN = yaw_between(self.ekf.R_WB, epoch.R_NB)
        mean_W = R_WN @ displacement_N / WINDOW_SECONDS
        covariance = R_WN @ covariance_N @ R_WN.T / WINDOW_SECONDS**2
        return self.ekf.update_mean_velocity(mean_W + self._velocity_gain(), covariance, self._gate)

    def _velocity_gain(self) -> FloatArray:
        """Current velocity minus its mean over the window, from the IMU alone (trapezoids)."""
        gain, n = np.zeros(3), len(self._velocity_steps)
        for age, step in enumerate(reversed(self._velocity_steps)):
            gain += step * (n - age - 0.5) / n
        return gain

    def _clone(self, time: float) -> None:
        if len(self._slots) == self.ekf.slots:
            self.ekf.release(self._slots.popleft())
        self._slots.append(self.ekf.clone(time))

    def _forget_window(self) -> None:
        """No displacement spans a gap: its clones are of no more use."""
        while self._slots:
            self.ekf.release(self._slots.popleft())
        self._velocity_steps.clear()


def yaw_between(R_WB: FloatArray, R_NB: FloatArray | None) -> FloatArray:
    """R_WN about the vertical: from the levelled frame's yaw to the estimated world's."""
    assert R_NB is not None  # a window always comes with the attitude it started at
    R = R_WB @ R_NB.T
    sine, cosine = R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]
    norm = math.hypot(sine, cosine)
    s, c = (sine / norm, cosine / norm) if norm > 0.0 else (0.0, 1.0)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class _InnovationLog:
    """Innovations of the filter's updates and their statistics."""

    def __init__(self, keep_rows: bool) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._offered = self._gated = 0
        self._refused: dict[str, int] = {}
        self._nis_sum, self._nis_count = 0.0, 0
        self._keep_rows = keep_rows

    def add(self, time: float, ekf: StateCloningEkf, result: UpdateResult) -> None:
        self._offered += 1
        if not result.accepted:
            self._refused[result.reason] = self._refused.get(result.reason, 0) + 1
            return
        gated = result.scale > 1.0
        self._gated += gated
        self._nis_sum += result.nis
        self._nis_count += 1
        if self._keep_rows:
            residual = np.ravel(ekf.y)
            sigma = np.sqrt(np.diag(ekf.S))
            self._rows.append((time, *residual, *sigma, result.nis, float(gated)))

    def stacked(self) -> Innovations:
        table = np.array(self._rows).reshape(-1, 9)
        return Innovations(
            time=table[:, 0],
            residual_W=table[:, 1:4],
            sigma=table[:, 4:7],
            nis=table[:, 7],
            gated=table[:, 8] > 0.5,
        )

    def health(self, counts: IntakeCounts, state: NavState) -> Health:
        sigma = np.sqrt(np.diag(state.covariance))
        groups = {
            "tilt_rad": sigma[0:2],
            "yaw_rad": sigma[2:3],
            "velocity_m_s": sigma[3:6],
            "position_m": sigma[6:9],
            "gyro_bias_rad_s": sigma[9:12],
            "accel_bias_m_s2": sigma[12:15],
        }
        return Health(
            samples=counts.samples(),
            gaps=list(counts.gaps),
            updates=self._offered,
            gated=self._gated,
            refused=dict(self._refused),
            mean_nis=self._nis_sum / self._nis_count if self._nis_count else math.nan,
            final_sigma={name: float(np.max(values)) for name, values in groups.items()},
        )
