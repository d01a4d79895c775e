"""Health and `inspect` say when a recording moves as nothing that the weights were trained on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stario.fusion import Navigator
from stario.fusion.evaluation.familiarity import familiarity
from stario.network.known_motion import KnownMotion, known_motion
from stario.network.model import DisplacementModel, load_model
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import world_streams


def simulated(seconds: float = 30.0, sensor: int = 9) -> ImuSequence:
    """The first part of always the same walk; another sensor where asked."""
    style = WalkStyle(carry="handheld", preferred_speed=1.2)
    walk = simulate_imu(generate_walk(2, 60.0, style=style), 200.0, PHONE_IMU, sensor)
    return walk.slice(0.0, seconds)


@pytest.fixture(scope="module")
def model() -> DisplacementModel:
    known = known_motion([s for sensor in range(3) for s in world_streams(simulated(60.0, sensor))])
    assert known is not None
    return knowing(known)


def knowing(known: KnownMotion) -> DisplacementModel:
    plain = load_model("default")
    return DisplacementModel(plain._engine, replace(plain.card, known_motion=known))


def shaken(sequence: ImuSequence) -> ImuSequence:
    """The same walk on a machine that trembles at 30 Hz."""
    tremble = 4.0 * np.sin(2.0 * np.pi * 30.0 * sequence.time)
    return replace(sequence, accel=sequence.accel + tremble[:, None])


def test_a_walk_as_in_training_is_familiar_and_a_trembling_one_is_not(
    model: DisplacementModel,
) -> None:
    walk = simulated()
    usual = familiarity(model, walk)
    assert usual.outside is not None
    assert usual.outside < 0.3
    assert not usual.is_unfamiliar
    is_unfamiliar = familiarity(model, shaken(walk))
    assert is_unfamiliar.outside == pytest.approx(1.0, abs=0.05)
    assert is_unfamiliar.is_unfamiliar
    [line] = [line for line in is_unfamiliar.lines() if line.startswith("!")]
    assert "share of power above 10 Hz" in line
    assert is_unfamiliar.medians["step_rate"] == pytest.approx(usual.medians["step_rate"], abs=0.2)


class Backwards(DisplacementModel):
    """Weights that walk the other way."""

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        displacement, covariance = super().predict(windows)
        return -displacement, covariance


def test_weights_that_walk_backwards_are_told(model: DisplacementModel) -> None:
    walk = simulated(60.0)
    right = familiarity(model, walk)
    wrong = familiarity(Backwards(model._engine, model.card), walk)
    assert not [line for line in right.lines() if "direction differs" in line]
    [line] = [line for line in wrong.lines() if "direction differs" in line]
    assert line.startswith("!")
    turned = abs(wrong.direction.turn - right.direction.turn)
    assert turned == pytest.approx(np.pi)
    told = wrong.as_dict()["direction"]
    assert isinstance(told, dict)
    assert abs(told["turn_deg"]) > 120.0


def test_health_says_so_in_batch_and_stream(model: DisplacementModel) -> None:
    is_unfamiliar = shaken(simulated(12.0))
    whole = Navigator(model).run(is_unfamiliar).health
    assert whole is not None
    [note] = [note for note in whole.notes if "windows" in note]
    assert "sigma is widened" in note
    navigator = Navigator(model)
    for row in zip(is_unfamiliar.time, is_unfamiliar.gyro, is_unfamiliar.accel, strict=True):
        navigator.push(*row)
    assert note in navigator.health.notes
    resumed = Navigator(model)
    resumed.restore(navigator.snapshot())
    assert note in resumed.health.notes
    usual = Navigator(model).run(simulated(12.0)).health
    assert usual is not None
    assert not [note for note in usual.notes if "windows" in note]
