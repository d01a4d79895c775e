"""A filter with a tilted, turned and moving initial state."""

import numpy as np

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.state import NavState
from stario.sequences.attitude.so3 import exp_so3


def initialised(slots: int, engine: type[StateCloningEkf] = StateCloningEkf) -> StateCloningEkf:
    sigma = np.repeat([0.05, 0.3, 0.1, 0.003, 0.05], 3)
    ekf = engine(slots)
    state = NavState(
        10.0,
        exp_so3(np.array([0.5, -0.7, 2.0])),
        np.array([1.0, -0.5, 0.1]),
        np.array([30.0, -20.0, 1.0]),
        np.array([0.001, 0.002, -0.001]),
        np.array([0.02, -0.01, 0.03]),
        np.diag(sigma**2),
    )
    ekf.initialise(state)
    return ekf
