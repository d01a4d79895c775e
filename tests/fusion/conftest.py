"""Simulated walks and a predictor that returns the ground truth, for tests of the navigator."""

from copy import deepcopy
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from training_runs import narrow

from stario.fusion.config import NavigatorConfig
from stario.fusion.recording import cut_recording
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.sequence import ImuSequence, Trajectory
from stario.sequences.simulation.imu import ImuErrors, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_SECONDS, rotated_windows


class Windows(NamedTuple):
    """The windows of a recording, as a network receives them.

    Attributes:
        stop: (n,) their ends [s].
        R_NB: (n,) levelled attitudes at their starts.
        heading: (n,) headings of the device in N [rad].
        contents: their samples in axes without that heading, as bytes.
    """

    stop: np.ndarray
    R_NB: Rotation
    heading: np.ndarray
    contents: list[bytes]


cut_once = lru_cache(maxsize=8)(cut_recording)
"""`cut_recording`; its results must not be changed."""


@pytest.fixture(scope="session", autouse=True)
def _cut_once():
    """Cut each recording once per settings: for the oracle and for the tracks of every back end.

    The front end is copied, since its counts are changed later.
    """

    def copied(sequence, config):
        intervals, front_end = cut_once(sequence, config)
        return list(intervals), deepcopy(front_end)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stario.fusion.recording.cut_recording", copied)
        yield


@lru_cache(maxsize=16)
def windows_of(sequence: ImuSequence, config: NavigatorConfig) -> Windows:
    """Windows into which a navigator cuts a recording; many tests share a few recordings."""
    intervals, _ = cut_once(sequence, config)
    complete = [e for e in intervals if e.window is not None]
    heading = np.array([e.window.heading for e in complete])
    windows = rotated_windows(np.stack([e.window.imu_N for e in complete]), -heading)
    return Windows(
        stop=np.array([e.stop for e in complete]),
        R_NB=Rotation.from_matrix(np.stack([e.window.R_NB for e in complete])),
        heading=heading,
        contents=[window.tobytes() for window in windows],
    )


class Oracle:
    """Predicts the true displacement of every window of one recording, optionally with white noise.

    A window is identified by its content, so that predictions are the same in streams and batches.
    Like a network's, they are in the window's frame, whose heading is that of the device according
    to the attitude with which the window was prepared.
    """

    def __init__(
        self,
        sequence: ImuSequence,
        truth: Trajectory,
        config: NavigatorConfig,
        noise: float = 0.0,
        sigma: float = 0.02,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        windows = windows_of(sequence, config)
        first, last = truth.at(windows.stop - WINDOW_SECONDS), truth.at(windows.stop)
        turn = about_z(yaw_of(windows.R_NB * first.attitude_WB.inv()))
        displacement = turn.apply(last.position_W - first.position_W)
        displacement += noise * rng.standard_normal(displacement.shape)
        displacement = about_z(-windows.heading).apply(displacement)
        self._displacements = dict(zip(windows.contents, displacement, strict=True))
        self._covariance = sigma**2 * np.eye(3)
        self.calls = 0

    def predict(self, windows):
        self.calls += 1
        mean = np.array([self._displacements[w.tobytes()] for w in np.asarray(windows)])
        return mean, np.tile(self._covariance, (len(mean), 1, 1))


class Still:
    """Predicts zero displacement for every window, with a sigma of 1 m per axis."""

    def predict(self, windows):
        n = len(windows)
        return np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))


NOISY = ImuErrors(gyro_turn_on=3e-3, accel_turn_on=0.03)


@lru_cache(maxsize=64)
def simulated_walk(
    seed: int = 1, seconds: float = 20.0, rate: float = 100.0, errors: ImuErrors = NOISY, **style
) -> ImuSequence:
    style = {"carry": "handheld", "mount_rotvec": (0.4, -0.7, 1.1), **style}
    walk = generate_walk(seed, seconds, style=WalkStyle(**style))
    return simulate_imu(walk, rate, errors, seed, name=f"walk-{seed}")


@pytest.fixture(scope="session")
def make_walk():
    return simulated_walk


@pytest.fixture(scope="session")
def make_oracle():
    return Oracle


@pytest.fixture(scope="session")
def still_model():
    return Still()


@pytest.fixture(scope="session")
def walk():
    """Twenty seconds hand-held at 100 Hz, by an IMU with noise and biases."""
    return simulated_walk()


@pytest.fixture(scope="session")
def without():
    """Function that removes the marked samples of a recording; its ground truth is kept whole."""
    # The same object for the same samples, so that the tests of both back ends share its windows.
    kept = lru_cache(maxsize=16)(
        lambda sequence, gone: sequence.select(~np.frombuffer(gone, dtype=np.bool_))
    )
    return lambda sequence, gone: kept(sequence, gone.tobytes())


@pytest.fixture
def narrow_network(monkeypatch):
    """Train a small StarIO in place of the whole one."""
    narrow(monkeypatch)
