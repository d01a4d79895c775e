"""How the IMU says that a window's velocity changed, for measurements of its mean."""

from __future__ import annotations

from collections import deque

import numpy as np

from stario.fusion.lie import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

_SLACK = 1e-6


class WindowMotion:
    """The last window's steps of dead reckoning: their lengths, and what the IMU alone added.

    Corrections of the filter between the steps are in none of them.
    """

    def __init__(self) -> None:
        # Of each step: dt [s], change of velocity [m/s], way beyond that of the first velocity [m].
        self._steps: deque[FloatArray] = deque()

    def add(
        self, dt: float, v_i: FloatArray, p_i: FloatArray, v_j: FloatArray, p_j: FloatArray
    ) -> None:
        """Take a step in, from velocity and position at its start to those at its end."""
        self._steps.append(np.concatenate([[dt], v_j - v_i, p_j - p_i - v_i * dt]))
        length = sum(float(step[0]) for step in self._steps)
        while length - self._steps[0][0] > WINDOW_SECONDS - _SLACK:
            length -= float(self._steps.popleft()[0])

    def gain(self) -> FloatArray:
        """Velocity now minus its mean over the window (3,) [m/s].

        With v_k = v - sum of the changes from step k on and the way v_k dt_k + beyond_k of each,
        v - mean = (sum of change_k t_k - beyond_k) / T, where step k ends t_k after the start.
        """
        gain, elapsed = np.zeros(3), 0.0
        for step in self._steps:
            elapsed += float(step[0])
            gain += step[1:4] * elapsed - step[4:]
        return gain / max(elapsed, _SLACK)

    def turn(self, R: FloatArray) -> None:
        """Give the steps in a world that is turned by R (3, 3)."""
        for step in self._steps:
            step[1:4], step[4:] = R @ step[1:4], R @ step[4:]

    def clear(self) -> None:
        """Forget all steps: behind a gap."""
        self._steps.clear()

    def checkpoint(self) -> list[FloatArray]:
        """Everything that `rewind` needs, as copies."""
        return [step.copy() for step in self._steps]

    def rewind(self, checkpoint: list[FloatArray]) -> None:
        """Go back to a checkpoint; it stays usable."""
        self._steps = deque(step.copy() for step in checkpoint)
