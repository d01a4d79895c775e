"""The network's scale error: part of the covariances, and of nothing else."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stario.fusion import Navigator, NavigatorConfig, Track
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.map_frame import MapFrame
from stario.fusion.fixes import position_fix
from stario.fusion.imu.preintegration import preintegrate
from stario.fusion.state import NavState
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence

SIGMA = 0.05
SETTINGS = {"adaptive": False, "covariance_scale": 1.0, "update_rate": 2}

Make = Callable[..., Any]


def config(scale_sigma: float) -> NavigatorConfig:
    default = NavigatorConfig()
    settings = replace(default.filter, network_scale_sigma=scale_sigma, **SETTINGS)
    return replace(default, filter=settings)


class Scaled:
    """A network whose displacements over the floor are longer by a factor."""

    def __init__(self, network: Any, factor: float) -> None:
        self._network, self._factor = network, np.array([factor, factor, 1.0])

    def predict(self, windows):
        mean, covariance = self._network.predict(windows)
        return mean * self._factor, covariance


@pytest.fixture(scope="module")
def walk(make_walk: Make) -> ImuSequence:
    return make_walk(3, 40.0)


@pytest.fixture(scope="module")
def oracle(walk: ImuSequence, make_oracle: Make) -> Any:
    return make_oracle(walk, walk.truth, config(0.0), sigma=0.05)


def covariance_by_scale(network: Any, walk: ImuSequence, backend: Any, **kwargs: Any) -> Any:
    """Return the tracks without and with a scale error, and its part of the covariances."""
    without, with_scale = (
        Navigator(network, config(sigma), backend=backend).run(walk, **kwargs)
        for sigma in (0.0, SIGMA)
    )
    return without, with_scale, with_scale.covariance - without.covariance


def sensitivity(network: Any, walk: ImuSequence, backend: Any, **kwargs: Any) -> np.ndarray:
    """Return the change (N, 9) of v_W, p_W and b_a with the network's scale, by differences."""

    def values(track: Track) -> np.ndarray:
        trajectory = track.trajectory
        return np.hstack([trajectory.velocity_W, trajectory.position_W, track.b_a])

    step = 1e-4
    more, less = (
        values(
            Navigator(Scaled(network, 1.0 + change), config(0.0), backend=backend).run(
                walk, **kwargs
            )
        )
        for change in (step, -step)
    )
    return (more - less) / (2.0 * step)


@pytest.mark.parametrize(("backend", "tolerance"), [("ekf", 2e-3), ("graph", 0.1)])
def test_its_part_of_the_covariance_is_what_a_scaled_network_does_to_the_track(
    walk: ImuSequence, oracle: Any, backend: str, tolerance: float
) -> None:
    _, _, part = covariance_by_scale(oracle, walk, backend)
    change = SIGMA * sensitivity(oracle, walk, backend)
    expected = change[:, :, None] * change[:, None, :]
    rows = [*range(3, 9), *range(12, 15)]
    found = part[:, rows][:, :, rows]
    scale = np.abs(expected).max(axis=0)
    assert scale[3:6, 3:6].max() > 1e-3  # the walk leads somewhere
    np.testing.assert_allclose(found, expected, atol=tolerance * scale.max(), rtol=tolerance)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_the_track_does_not_depend_on_it(walk: ImuSequence, oracle: Any, backend: str) -> None:
    without, with_scale, _ = covariance_by_scale(oracle, walk, backend)
    np.testing.assert_array_equal(without.trajectory.position_W, with_scale.trajectory.position_W)


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_stream_gives_the_covariances_of_its_filter(
    walk: ImuSequence, oracle: Any, backend: str
) -> None:
    recording = Navigator(oracle, config(SIGMA)).run(walk)
    navigator = Navigator(oracle, config(SIGMA), backend=backend)
    samples = zip(walk.time, walk.gyro, walk.accel, strict=True)
    states = [state for sample in samples if (state := navigator.push(*sample)) is not None]
    for state in states[20::20]:
        k = int(np.argmin(np.abs(recording.time - state.time)))
        expected = np.sqrt(np.diag(recording.covariance[k])[6:8])
        np.testing.assert_allclose(
            np.sqrt(np.diag(state.position_covariance)[:2]), expected, rtol=0.15
        )


def test_a_position_fix_removes_it(walk: ImuSequence, oracle: Any) -> None:
    truth = walk.truth.at(np.array([2.0, 20.0, 30.0]))
    fixes = [
        position_fix(t, p, 1e-4 * np.eye(3))
        for t, p in zip(truth.time, truth.position_W, strict=True)
    ]
    _, track, part = covariance_by_scale(oracle, walk, "ekf", fixes=fixes)
    variance = np.trace(part[:, 6:8, 6:8], axis1=1, axis2=2)
    before, after = np.searchsorted(track.time, (29.85, 30.05))
    assert variance[before] > 0.01
    assert variance[after] < 0.05 * variance[before]


def test_a_straight_walk_is_uncertain_along_itself(make_walk: Make, make_oracle: Make) -> None:
    walk = make_walk(3, 40.0)
    network = make_oracle(walk, walk.truth, config(0.0), sigma=0.05)
    track = Navigator(network, config(SIGMA)).run(walk)
    away = track.trajectory.position_W - track.trajectory.position_W[0]
    distance = np.linalg.norm(away[:, :2], axis=1)
    far = int(np.argmax(distance))
    along = away[far, :2] / distance[far]
    sigma = np.sqrt(along @ track.covariance[far, 6:8, 6:8] @ along)
    assert sigma > SIGMA * distance[far]


def test_the_first_fix_after_a_straight_walk_is_believed() -> None:
    """A scale error moves the end of a straight walk by many of the sigmas that the noise gives."""
    ekf = StateCloningEkf(slots=2)
    zero = np.zeros(3)
    P = np.diag(np.repeat([1e-4, 1e-2, 1e-4, 1e-8, 1e-4], 3))
    ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, P))
    rng, length, scale = np.random.default_rng(0), 1.2, 1.07
    time = np.arange(0.0, 1.0 + 1e-9, 0.1)
    accel = np.tile([0.0, 0.0, STANDARD_GRAVITY], (len(time), 1))
    frame = MapFrame(PriorPose(np.eye(3), zero, zero), 0.997, 0.0, SIGMA)
    slot = ekf.clone()
    for second in range(200):
        begin = float(second)
        noise = ImuNoise(gyro_noise=1e-3, accel_noise=0.1)
        ekf.propagate(
            preintegrate(
                begin + time, np.zeros_like(accel), accel, zero, zero, noise, STANDARD_GRAVITY
            )
        )
        d_W = np.array([scale * length, 0.0, 0.0]) + rng.normal(0.0, 0.05, 3)
        ekf.update_displacement(slot, None, d_W, 0.05**2 * np.eye(3), gate=14.0)
        slot = ekf.clone(instead_of=slot)
    truth = np.array([200.0 * length, 0.0, 0.0])
    assert ekf.state.p_W[0] - truth[0] > 10.0
    result = frame.update(ekf, position_fix(200.0, truth, np.eye(3)))
    assert result.accepted
    assert result.scale == 1.0
    assert np.linalg.norm(ekf.state.p_W - truth) < 1.0
