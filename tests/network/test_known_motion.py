"""The known motion of weights: familiar gait lies inside it, another gait or sensor outside."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.network.card import Card, dump_card, parse_card
from stario.network.known_motion import (
    FEATURES,
    OUTSIDE_VARIANCE,
    KnownMotion,
    features,
    known_motion,
    known_motion_from_dict,
    step_rates,
)
from stario.network.model import DisplacementModel, load_model
from stario.sequences.errors import WeightsError
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WINDOW_RATE, WorldStream


def walking_stream(
    seed: int, rate: float = 1.8, size: float = 1.0, seconds: float = 40.0
) -> WorldStream:
    """A device that bobs at a step rate [Hz] by `size` [m/s^2], with a little motion otherwise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1.0 / WINDOW_RATE)
    imu = 0.1 * rng.standard_normal((len(time), 6))
    imu[:, 5] += STANDARD_GRAVITY + size * np.sin(2.0 * np.pi * rate * time)
    imu[:, 3] += 0.4 * size * np.sin(np.pi * rate * time + 1.0)
    imu[:, 2] += 0.5 * np.sin(0.4 * time)
    position = np.stack([1.2 * time, 0.0 * time, 0.0 * time], axis=1)
    facing = np.tile(np.array([1.0, 0.0], np.float32), (len(time), 1))
    return WorldStream("walk", imu.astype(np.float32), position.astype(np.float32), facing)


def windows(stream: WorldStream) -> np.ndarray:
    count = len(stream) // 200
    return stream.imu_W[: 200 * count].reshape(count, 200, 6).transpose(0, 2, 1)


def known_motion_of(*streams: WorldStream) -> KnownMotion:
    known = known_motion(streams)
    assert known is not None
    return known


@pytest.fixture(scope="module")
def known() -> KnownMotion:
    return known_motion_of(*(walking_stream(seed, rate=1.6 + 0.1 * seed) for seed in range(5)))


def test_a_short_walk_defines_its_known_motion_and_a_shorter_one_does_not() -> None:
    """With one centre per window, all other windows were unfamiliar, even of the same walk."""
    walk = walking_stream(0, seconds=140.0)
    known = known_motion_of(walk.part(0, 70 * 200))
    assert len(known.centres) == 3
    assert np.mean(known.novelty(windows(walk.part(70 * 200, len(walk)))) > 1.0) < 0.2
    assert np.mean(known.novelty(windows(walking_stream(1, size=4.0))) > 1.0) > 0.9
    assert known_motion([walk.part(0, 50 * 200)]) is None


def test_few_windows_of_familiar_motion_lie_outside(known: KnownMotion) -> None:
    novelty = known.novelty(windows(walking_stream(99, rate=1.8)))
    assert np.mean(novelty > 1.0) < 0.25
    assert known.variance_factor(windows(walking_stream(99))).mean() < 1.2


@pytest.mark.parametrize("other", [{"size": 4.0}, {"size": 0.1}, {"rate": 5.0}])
def test_another_gait_lies_outside_and_widens_the_variance(
    known: KnownMotion, other: dict[str, float]
) -> None:
    unfamiliar = windows(walking_stream(1, **other))
    assert np.mean(known.novelty(unfamiliar) > 1.0) > 0.9
    factors = known.variance_factor(unfamiliar)
    assert factors.mean() > 0.75 * OUTSIDE_VARIANCE
    assert factors.max() <= OUTSIDE_VARIANCE


def test_weights_that_keep_an_earlier_motion_know_both() -> None:
    slow, fast = walking_stream(1, seconds=80.0), walking_stream(2, 2.6, 3.0, seconds=80.0)
    both = known_motion_of(slow).extended(known_motion_of(fast))
    assert both.limit == known_motion_of(slow).limit
    for stream in (slow, fast):
        assert both.is_unfamiliar(windows(stream)).mean() < 0.2
    assert known_motion_of(slow).is_unfamiliar(windows(fast)).mean() > 0.8
    low, high = both.ranges["step_rate"]
    assert low < 1.9
    assert high > 2.5


def test_novelty_does_not_depend_on_the_yaw_of_windows(known: KnownMotion) -> None:
    original = windows(walking_stream(3, size=1.5))
    yaw = 1.1
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    rotated = np.concatenate([rotation @ original[:, :3], rotation @ original[:, 3:]], axis=1)
    np.testing.assert_allclose(features(rotated), features(original), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(known.novelty(rotated), known.novelty(original), rtol=1e-3)


@pytest.mark.parametrize(("hertz", "fast", "middle"), [(2.0, 0, 0), (6.0, 0, 1), (15.0, 1, 0)])
def test_shares_of_power_are_those_of_the_frequency_of_a_vibration(
    hertz: float, fast: int, middle: int
) -> None:
    imu = np.zeros((1, 6, 200), np.float32)
    imu[:, 5] = STANDARD_GRAVITY + np.sin(2.0 * np.pi * hertz * np.arange(200) / 200.0)
    found = dict(zip(FEATURES, features(imu)[0], strict=True))
    shares = [found[name] for name in ("fast", "middle", "vertical")]
    assert shares == pytest.approx([fast, middle, 1.0], abs=0.01)
    assert found["acceleration"] == pytest.approx(0.5**0.5, rel=0.01)


@pytest.mark.parametrize("rate", [1.5, 2.3])
def test_the_step_rate_is_the_rate_of_bobbing(rate: float) -> None:
    np.testing.assert_allclose(step_rates(walking_stream(0, rate=rate).imu_W), rate, atol=0.06)
    assert len(step_rates(walking_stream(0, size=0.0).imu_W)) == 0


def test_ranges_hold_speed_and_step_rate(known: KnownMotion) -> None:
    assert known.ranges["speed"] == pytest.approx((1.2, 1.2), abs=0.01)
    low, high = known.ranges["step_rate"]
    assert low == pytest.approx(1.6, abs=0.1)
    assert high == pytest.approx(2.0, abs=0.1)


def test_known_motion_is_stored_on_the_card(known: KnownMotion) -> None:
    card = Card("R-ResNet", sha256="0", known_motion=known)
    assert parse_card(dump_card(card), Path("a.json")).known_motion == known
    assert parse_card(dump_card(replace(card, known_motion=None)), Path("a.json")) == replace(
        card, known_motion=None
    )
    content = json.loads(dump_card(card))
    content["known_motion"]["centres"][0] = "1 2"
    with pytest.raises(WeightsError, match="known_motion"):
        parse_card(json.dumps(content), Path("a.json"))
    with pytest.raises(KeyError):
        known_motion_from_dict({})


def test_a_model_widens_its_covariance_for_unfamiliar_motion(known: KnownMotion) -> None:
    plain = load_model("default")
    plain = DisplacementModel(plain.engine, replace(plain.card, known_motion=None))
    aware = DisplacementModel(plain.engine, replace(plain.card, known_motion=known))
    unfamiliar = windows(walking_stream(1, size=4.0))
    mean, covariance = plain.predict(unfamiliar)
    same, wider = aware.predict(unfamiliar)
    np.testing.assert_array_equal(mean, same)
    factors = known.variance_factor(unfamiliar)
    np.testing.assert_allclose(wider, factors[:, None, None] * covariance)


def test_a_stationary_device_is_unlike_the_training_but_not_unfamiliar(known: KnownMotion) -> None:
    rng = np.random.default_rng(0)
    stationary = 0.01 * rng.standard_normal((8, 6, 200)).astype(np.float32)
    stationary[:, 5] += STANDARD_GRAVITY
    running = windows(walking_stream(9, rate=3.5, size=15.0))
    assert (known.novelty(stationary) > 1.0).all()
    assert not known.is_unfamiliar(stationary).any()
    assert known.is_unfamiliar(running).all()
