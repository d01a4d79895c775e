"""The recipe: its refusals, its learning rate over the steps, its loss."""

import json
import math

import numpy as np
import pytest
import torch

from stario.network.training.config import (
    TrainingConfig,
    learning_rate,
    loss_with_sigma,
    training_config,
)
from stario.sequences.errors import ConfigError


def test_the_learning_rate_warms_up_and_decays() -> None:
    config = TrainingConfig(epochs=100, epoch_windows=128, batch=16, warm_up=0.1, rate=1.0)
    rates = [learning_rate(config, step) for step in range(config.steps)]
    peak = int(np.argmax(rates))
    assert peak == pytest.approx(0.1 * config.steps, abs=1.0)
    assert max(rates) == pytest.approx(1.0)
    assert (np.diff(rates[: peak + 1]) >= 0.0).all()
    assert (np.diff(rates[peak:]) <= 0.0).all()
    assert 0.0 < rates[-1] < 0.02
    assert rates[0] > 0.0  # the first step learns, too


def test_the_loss_is_minimal_at_the_true_sigma() -> None:
    squared = torch.full((1, 3), 0.09)
    log_sigma = torch.full((1, 3), math.log(0.3), requires_grad=True)
    loss_with_sigma(squared, log_sigma).backward()
    torch.testing.assert_close(log_sigma.grad, torch.zeros(1, 3), atol=1e-6, rtol=0.0)


def test_sigma_does_not_affect_the_gradient_of_the_mean() -> None:
    """The mean's gradient is that of the squared error, whatever sigma is."""
    for sigma in (0.01, 1.0):
        squared = torch.full((1, 3), 0.04, requires_grad=True)
        loss_with_sigma(squared, torch.full((1, 3), math.log(sigma))).backward()
        assert squared.grad is not None
        torch.testing.assert_close(squared.grad, torch.ones(1, 3))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"epoch": 3}, "epoch"),
        ({"batch": 10, "successive": 3}, "batch"),
        ({"augmentation": {"tild": 0.1}}, "augmentation.tild"),
        ({"augmentation": 3}, "augmentation"),
        ({"epochs": 0}, "epochs"),
        ({"precision": "half"}, "precision"),
        ({"device": "tpu"}, "device"),
        ({"attitude": "guessed"}, "attitude"),
        ({"architecture": "Star"}, "architecture"),
        ({"seed": -1}, "seed"),
        ({"dropout": "no"}, "dropout"),
        ({"augmentation": {"speeds": 3}}, "augmentation.speeds"),
        *(
            ({"augmentation": {share: 1.1}}, f"augmentation.{share}")
            for share in ("replayed", "swung", "mirrored", "any_yaw")
        ),
        ({"shares": {"simulated": True}}, "shares, simulated"),
        ({"augmentation": {"speeds": [1]}}, "augmentation.speeds"),
        ({"augmentation": {"speeds": ["slow", "fast"]}}, "augmentation.speeds"),
    ],
)
def test_an_invalid_recipe_is_refused(values: dict[str, object], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        training_config(values)
    assert caught.value.field == field


def test_a_recipe_survives_a_round_trip_through_json() -> None:
    values = json.loads(json.dumps({"batch": 8, "augmentation": {"speeds": [0.7, 1.5]}}))
    config = training_config(values)
    assert config.batch == 8
    assert config.augmentation.speeds == (0.7, 1.5)
