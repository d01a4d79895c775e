"""A filter's state under test, which the functions of `filter.ekf` replace one after the other."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from support import nav_state

from stario.fusion.filter import ekf, kalman
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.values.state import NavState, changed
from stario.sequences.attitude.so3 import exp_so3

NOTHING = nav_state(np.zeros((15, 15)), math.nan)


class Driven:
    """Each function of `filter.ekf` is a method: it replaces the state and returns the outcome."""

    def __init__(self, slots: int, state: NavState = NOTHING) -> None:
        self.state = EkfState.initial(state, slots)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._apply, getattr(ekf, name))

    def _apply(self, function: Callable[..., Any], *args: Any, **options: Any) -> Any:
        answer = function(self.state, *args, **options)
        self.state, result = answer if isinstance(answer, tuple) else (answer, None)
        return result

    def initialise(self, state: NavState) -> None:
        self.state = EkfState.initial(state, len(self.state.clone_times))

    def clone(self, instead_of: int | None = None) -> int:
        free = self.state.clone_times.index(None) if instead_of is None else instead_of
        self._apply(ekf.clone, instead_of)
        return free

    def update_linear(self, residual: Any, blocks: Any, covariance: Any) -> kalman.UpdateResult:
        return self._apply(kalman.update, kalman.Linear(residual, blocks, covariance))

    @property
    def covariances(self) -> np.ndarray:
        return self.state.covariances

    @covariances.setter
    def covariances(self, value: np.ndarray) -> None:
        self.state = changed(self.state, covariances=value)

    @property
    def P(self) -> np.ndarray:
        return self.state.P

    @P.setter
    def P(self, value: np.ndarray) -> None:
        self.covariances = np.stack([value, value])


def initialised(slots: int) -> Driven:
    sigma = np.repeat([0.05, 0.3, 0.1, 0.003, 0.05], 3)
    R_WB = exp_so3(np.array([0.5, -0.7, 2.0]))
    v_W, p_W = np.array([[1.0, -0.5, 0.1], [30.0, -20.0, 1.0]])
    b_g, b_a = np.array([[0.001, 0.002, -0.001], [0.02, -0.01, 0.03]])
    state = nav_state(np.diag(sigma**2), 10.0, R_WB=R_WB, v_W=v_W, p_W=p_W, b_g=b_g, b_a=b_a)
    return Driven(slots, state)
