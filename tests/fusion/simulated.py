from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.imu.front_end import FrontEnd
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.recording import cut_recording
from stario.fusion.values.config import NavigatorConfig
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.sequence import BoolArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import ImuErrors, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_SECONDS, rotated_windows


@lru_cache(maxsize=24)
def _cut(
    sequence: ImuSequence, gravity: float, **used: float
) -> tuple[list[ImuInterval], FrontEnd]:
    # No others: a front end that asked for one would fail, and not be given another test's cut.
    settings: Any = SimpleNamespace(gravity=gravity, filter=SimpleNamespace(**used))
    return cut_recording(sequence, settings)


def cut_once(sequence: ImuSequence, config: NavigatorConfig) -> tuple[list[ImuInterval], FrontEnd]:
    """`cut_recording`, once for all settings that it does not use; its results are not changed."""
    names = ("output_rate", "intervals_per_update", "magnetometer")
    return _cut(sequence, config.gravity, **{name: getattr(config.filter, name) for name in names})


@lru_cache(maxsize=16)
def windows_of(sequence: ImuSequence, config: NavigatorConfig) -> SimpleNamespace:
    """Windows into which a navigator cuts a recording, as a network receives them.

    Ends [s], levelled attitudes at the starts, headings of the device in N [rad], and samples in
    axes without that heading, as bytes.
    """
    intervals, _ = cut_once(sequence, config)
    complete = [e for e in intervals if e.window is not None]
    heading = np.array([e.window.heading for e in complete])
    windows = rotated_windows(np.stack([e.window.imu_N for e in complete]), -heading)
    return SimpleNamespace(
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
    """Predicts one displacement for every window, by default none with a sigma of 1 m per axis."""

    def __init__(self, mean=(0.0, 0.0, 0.0), variance=(1.0, 1.0, 1.0)):
        self.mean, self.covariance = np.array(mean), np.diag(variance)

    def predict(self, windows):
        return np.tile(self.mean, (len(windows), 1)), np.tile(self.covariance, (len(windows), 1, 1))


NOISY = ImuErrors(gyro_turn_on=3e-3, accel_turn_on=0.03)


@lru_cache(maxsize=64)
def simulated_walk(seed=1, seconds=20.0, rate=100.0, errors=NOISY, **style) -> ImuSequence:
    style = {"carry": "handheld", "mount_rotvec": (0.4, -0.7, 1.1), **style}
    walk = generate_walk(seed, seconds, style=WalkStyle(**style))
    return simulate_imu(walk, rate, errors, seed, name=f"walk-{seed}")


@lru_cache(maxsize=16)
def _kept(sequence: ImuSequence, gone: bytes) -> ImuSequence:
    return sequence.select(~np.frombuffer(gone, dtype=np.bool_))


def without(sequence: ImuSequence, gone: BoolArray) -> ImuSequence:
    """Remove the marked samples of a recording; its ground truth is kept whole.

    The same object for the same samples, so that the tests of both back ends share its windows.
    """
    return _kept(sequence, gone.tobytes())


def measured(
    seed: int,
    seconds: float,
    config: NavigatorConfig,
    gap: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.03,
    **style: object,
) -> tuple[ImuSequence, ImuSequence, Oracle]:
    """Return a walk at 50 Hz, the same without samples in a gap, and an oracle of the latter."""
    walk = simulated_walk(seed, seconds, 50.0, **style)
    holed = without(walk, (walk.time > gap[0]) & (walk.time < gap[1])) if any(gap) else walk
    return walk, holed, Oracle(holed, walk.truth, config, noise=noise, sigma=noise)
