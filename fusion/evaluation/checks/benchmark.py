"""Cost of the filter, and what its structured algebra saves over filterpy's dense one.

Timings are processor time, the minimum of several runs: other load on the machine only adds to it.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.jacobians import CORE, Block
from stario.fusion.imu.preintegration import Segment, preintegrate
from stario.fusion.state import NavState
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray

_DURATION, _IMU_RATE, _UPDATE_RATE, _WINDOW = 5.0, 200.0, 20.0, 1.0
"""Duration of the data [s], IMU rate [Hz], update rate [Hz] and window length [s]."""

_RUNS = 9
"""Number of runs of each engine, alternating; the fastest counts."""


class DenseEkf(StateCloningEkf):
    """The same filter using filterpy's own `predict` and `update` on the full matrices."""

    def _propagated(self, P: FloatArray, transition: FloatArray, noise: FloatArray) -> FloatArray:
        self.F[:CORE, :CORE] = transition
        self.Q[:CORE, :CORE] = noise
        self.predict()
        return self.P

    def _correct(
        self,
        residual: FloatArray,
        blocks: Sequence[Block],
        covariance: FloatArray,
        HP: FloatArray,
        HPH: FloatArray,
        whitener: FloatArray,
    ) -> FloatArray:
        H = np.zeros((len(residual), self.dim_x))
        for first, block in blocks:
            H[:, first : first + block.shape[1]] = block
        self.R = covariance
        self.update(residual[:, None], lambda x: H, lambda x: H @ x)
        return self.P


@dataclass(frozen=True)
class FilterSpeed:
    """Computing time [s] per minute of data, including preintegration but not the network.

    Attributes:
        structured: time of `StateCloningEkf`.
        dense: time of `DenseEkf`, filterpy's own algebra.
        preintegration: time that preintegrating the raw samples takes in either.
        states: size of the error state.
    """

    structured: float
    dense: float
    preintegration: float
    states: int

    @property
    def ratio(self) -> float:
        """How many times faster the structured algebra is."""
        return self.dense / self.structured


def filter_speed() -> FilterSpeed:
    """Time the filter and its dense counterpart on a swaying device with displacements."""
    data, slots = _SwayingDevice(), round(_UPDATE_RATE * _WINDOW) + 1
    engines = [StateCloningEkf(slots), DenseEkf(slots)]
    best = np.full(3, np.inf)
    for _ in range(_RUNS):
        seconds = [_timed(data.run, ekf) for ekf in engines]
        best = np.minimum(best, [*seconds, _timed(data.preintegrate)])
    structured, dense, preintegration = (best * 60.0 / _DURATION).tolist()
    return FilterSpeed(structured, dense, preintegration, engines[0].dim_x)


class _SwayingDevice:
    """IMU samples and displacements of a device that sways in place."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.per_segment = round(_IMU_RATE / _UPDATE_RATE)
        self.per_window = round(_UPDATE_RATE * _WINDOW)
        n = round(_DURATION * _UPDATE_RATE) * self.per_segment + 1
        self.time = np.arange(n) / _IMU_RATE
        sway = np.sin(2.0 * np.pi * self.time)[:, None]
        self.gyro = sway * [0.5, -0.3, 0.8] + rng.normal(0.0, 0.01, (n, 3))
        self.accel = np.array([0.0, 0.0, STANDARD_GRAVITY]) + sway + rng.normal(0.0, 0.1, (n, 3))
        self.noise = ImuNoise()
        self.displacements = rng.normal(0.0, 0.1, (n // self.per_segment, 3))

    def preintegrate(self) -> None:
        for first in range(0, len(self.time) - 1, self.per_segment):
            self._segment(first, np.zeros(3), np.zeros(3))

    def run(self, ekf: StateCloningEkf) -> None:
        zero = np.zeros(3)
        ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, np.eye(CORE) * 1e-4))
        covariance = np.eye(3) * 0.01 * self.per_window
        clones = [ekf.clone()]
        for k, displacement in enumerate(self.displacements):
            ekf.propagate(self._segment(k * self.per_segment, ekf.state.b_g, ekf.state.b_a))
            clones.append(ekf.clone())
            if len(clones) > self.per_window:
                ekf.update_displacement(clones[0], clones[-1], displacement, covariance, gate=16.3)
                ekf.release(clones.pop(0))

    def _segment(self, first: int, b_g: FloatArray, b_a: FloatArray) -> Segment:
        part = slice(first, first + self.per_segment + 1)
        return preintegrate(
            self.time[part],
            self.gyro[part],
            self.accel[part],
            b_g,
            b_a,
            self.noise,
            STANDARD_GRAVITY,
        )


def _timed(run: Callable[..., None], *args: StateCloningEkf) -> float:
    start = clock.process_time()
    run(*args)
    return clock.process_time() - start
