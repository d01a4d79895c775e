"""Health and `inspect` report a recording whose motion differs from the training data."""

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
    """The start of one fixed walk, measured by the sensor with seed `sensor`."""
    style = WalkStyle(carry="handheld", preferred_speed=1.2)
    walk = simulate_imu(generate_walk(2, 60.0, style=style), 200.0, PHONE_IMU, sensor)
    return walk.slice(0.0, seconds)


@pytest.fixture(scope="module")
def model() -> DisplacementModel:
    known = known_motion([s for sensor in range(3) for s in world_streams(simulated(60.0, sensor))])
    assert known is not None
    return model_with(known)


def model_with(known: KnownMotion) -> DisplacementModel:
    plain = load_model("default")
    return DisplacementModel(plain.engine, replace(plain.card, known_motion=known))


def with_vibration(sequence: ImuSequence) -> ImuSequence:
    """The same walk with a vibration of 30 Hz added to the specific force."""
    vibration = 4.0 * np.sin(2.0 * np.pi * 30.0 * sequence.time)
    return replace(sequence, accel=sequence.accel + vibration[:, None])


def test_a_walk_like_the_training_data_is_familiar_and_a_vibrating_one_is_not(
    model: DisplacementModel,
) -> None:
    walk = simulated()
    usual = familiarity(model, walk)
    assert usual.outside is not None
    assert usual.outside < 0.3
    assert not usual.is_unfamiliar
    unfamiliar = familiarity(model, with_vibration(walk))
    assert unfamiliar.outside == pytest.approx(1.0, abs=0.05)
    assert unfamiliar.is_unfamiliar
    [line] = [line for line in unfamiliar.lines() if line.startswith("!")]
    assert "share of power above 10 Hz" in line
    [shown] = [line for line in usual.lines() if "step rate" in line]
    assert shown.split() == ["step", "rate", f"{usual.medians['step_rate']:.2f}", "Hz"]
    mixed = replace(unfamiliar, ranges={})
    assert any("but not their combination" in line for line in mixed.lines())
    assert unfamiliar.medians["step_rate"] == pytest.approx(usual.medians["step_rate"], abs=0.2)


def test_a_jolt_does_not_change_what_a_walk_is_like(model: DisplacementModel) -> None:
    walk = simulated()
    jolt = np.where((walk.time > 10.0) & (walk.time < 11.0), 40.0, 0.0)
    jolted = replace(walk, accel=walk.accel + np.outer(jolt, [0.0, 0.0, 1.0]))
    usual, shaken = (familiarity(model, each).medians["acceleration"] for each in (walk, jolted))
    assert shaken == pytest.approx(usual, rel=0.1)


class ReversedModel(DisplacementModel):
    """A model that reverses every displacement."""

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        displacement, covariance = super().predict(windows)
        return -displacement, covariance


def test_a_model_with_reversed_displacements_is_reported(model: DisplacementModel) -> None:
    walk = simulated(60.0)
    normal = familiarity(model, walk)
    opposite = familiarity(ReversedModel(model.engine, model.card), walk)
    assert not [line for line in normal.lines() if "direction differs" in line]
    [line] = [line for line in opposite.lines() if "direction differs" in line]
    assert line.startswith("!")
    turned = abs(opposite.direction.turn - normal.direction.turn)
    assert turned == pytest.approx(np.pi)
    reported = opposite.as_dict()["direction"]
    assert isinstance(reported, dict)
    assert abs(reported["turn_deg"]) > 120.0


def test_health_reports_unfamiliar_motion_in_batch_and_stream(model: DisplacementModel) -> None:
    unfamiliar = with_vibration(simulated(12.0))
    whole = Navigator(model).run(unfamiliar).health
    assert whole is not None
    [note] = [note for note in whole.notes if "windows" in note]
    assert "sigma is widened" in note
    navigator = Navigator(model)
    for row in zip(unfamiliar.time, unfamiliar.gyro, unfamiliar.accel, strict=True):
        navigator.push(*row)
    assert note in navigator.health.notes
    resumed = Navigator(model)
    resumed.restore(navigator.snapshot())
    assert note in resumed.health.notes
    usual = Navigator(model).run(simulated(12.0)).health
    assert usual is not None
    assert not [note for note in usual.notes if "windows" in note]
