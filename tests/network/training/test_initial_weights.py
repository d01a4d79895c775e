import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded import DATA
from training_runs import HELD_OUT, STREAMS, TINY, VALIDATION, run

from stario.network.card import Calibration
from stario.network.model import load_model
from stario.network.training.config import TrainingConfig, learning_rate, training_config
from stario.network.training.data import TrainingData
from stario.network.training.losses import loss_with_sigma
from stario.network.training.splits import read_packaged_list, warn_of_learned
from stario.network.training.train import train
from stario.network.training.validation import ValidationSet
from stario.sequences.errors import ConfigError


def test_training_that_spoils_its_initial_weights_gives_a_warning(model, tmp_path, caplog):
    run(tmp_path / "spoilt", replace(TINY, epochs=1, rate=0.1), start_from=load_model(model))
    assert "times those of the initial weights" in caplog.text
    held_out = ValidationSet(HELD_OUT, TINY)
    assert not held_out.worse({"c": 1.0, "d": 1.0}, {"c": 0.5, "d": 1.5})
    words = held_out.worse({"c": 1.0, "d": 1.0}, {"c": 0.5, "d": 4.0})
    assert "1.41 times those of the initial weights (d: 4 instead of 1)" in words


def test_fine_tuned_weights_lie_between_the_initial_and_the_learned(model, tmp_path):
    first, once = load_model(model), replace(TINY, epochs=1, epoch_windows=16)
    tuned = [
        load_model(run(tmp_path / str(share), replace(once, learned=share), start_from=first))
        for share in (0.0, 0.5, 1.0)
    ]
    initial, none, half, all_learned = (
        dict(weights.training_form.named_parameters()) for weights in (first, *tuned)
    )
    for name, before in initial.items():
        torch.testing.assert_close(none[name], before, atol=0.0, rtol=0.0)
        torch.testing.assert_close(half[name], 0.5 * (before + all_learned[name]))
    assert any(not torch.equal(all_learned[name], before) for name, before in initial.items())


def test_a_last_stage_starts_from_weights_and_adopts_a_calibration(model, tmp_path):
    first = load_model(model)
    slow = replace(TINY, rate=1e-8, epochs=1, epoch_windows=16)
    other = Calibration((1.5, 1.5, 2.0), (0.9, 0.9, 1.1), (0.02, 0.02, 0.03))
    options = {"calibration": other, "words": ["walks"]}
    last = load_model(run(tmp_path / "last", slow, start_from=first, **options))
    assert last.card.calibration == other
    assert last.card.trained_on == ["walks", "initial weights, swings"]
    before = dict(first.training_form.named_parameters())
    for name, value in last.training_form.named_parameters():
        torch.testing.assert_close(value, before[name], atol=1e-4, rtol=0.0)
    again = load_model(run(tmp_path / "again", slow, start_from=last, words=["swings"]))
    inherited = ["initial weights, walks", "initial weights, swings"]
    assert again.card.trained_on == ["swings", *inherited]


def test_errors_on_recordings_that_were_learned_are_named_so(tmp_path):
    """A last stage trains on the validation recordings, too."""
    everything = TrainingData([*STREAMS, *VALIDATION])
    once = replace(TINY, epochs=1, epoch_windows=16)
    path = train(once, everything, HELD_OUT, tmp_path)
    assert list(load_model(path).card.figures) == ["validation_mse_m2_after_it_was_learned"]


def test_the_recipes_dropout_replaces_the_networks_own(tmp_path):
    once = replace(TINY, epochs=1, epoch_windows=16)
    none, most = (
        load_model(run(tmp_path / str(share), replace(once, dropout=share))).training_form
        for share in (0.0, 0.9)
    )
    pairs = zip(none.parameters(), most.parameters(), strict=True)
    assert not all(torch.equal(one, other) for one, other in pairs)


def test_averaged_weights_of_a_short_run_are_not_the_initial_ones(model, tmp_path):
    """The first steps are averaged over fewer than the recipe's number."""
    first, short = load_model(model), replace(TINY, epochs=1, epoch_windows=64)
    initial = torch.nn.utils.parameters_to_vector(first.training_form.parameters())
    moved = []
    for average in (0.0, 0.9999):
        path = run(tmp_path / str(average), replace(short, average=average), start_from=first)
        learned = torch.nn.utils.parameters_to_vector(load_model(path).training_form.parameters())
        moved.append(float((learned - initial).detach().norm()))
    assert moved[1] > 0.5 * moved[0]


needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the development recordings")


@needs_data
def test_weights_judged_by_what_they_learned_are_named(caplog):
    held_out = [entry.path for entry in read_packaged_list("holdout", DATA)]
    warn_of_learned(["default", "first-stage", "open", "other.safetensors"], held_out, DATA)
    [record] = caplog.records
    count = len(held_out)
    assert record.getMessage().startswith(f"default: trained on {count} of the {count} recordings")
    caplog.clear()
    test = [entry.path for entry in read_packaged_list("test", DATA)]
    warn_of_learned(["default", "walks-36min"], test, DATA)
    warn_of_learned(["default"], [DATA.parent / "walk.csv"], DATA.parent)  # none of those listed
    assert not caplog.records


def test_the_learning_rate_warms_up_and_decays():
    config = TrainingConfig(epochs=100, epoch_windows=128, batch=16, warm_up=0.1, rate=1.0)
    rates = [learning_rate(config, step) for step in range(config.steps)]
    peak = int(np.argmax(rates))
    assert peak == pytest.approx(0.1 * config.steps, abs=1.0)
    assert max(rates) == pytest.approx(1.0)
    assert (np.diff(rates[: peak + 1]) >= 0.0).all()
    assert (np.diff(rates[peak:]) <= 0.0).all()
    assert 0.0 < rates[-1] < 0.02
    assert rates[0] > 0.0  # the first step learns, too


def test_the_loss_is_minimal_at_the_true_sigma_which_does_not_affect_the_mean():
    """The mean's gradient is that of the squared error, whatever sigma is."""
    log_sigma = torch.full((1, 3), math.log(0.3), requires_grad=True)
    loss_with_sigma(torch.full((1, 3), 0.09), log_sigma).backward()
    torch.testing.assert_close(log_sigma.grad, torch.zeros(1, 3), atol=1e-6, rtol=0.0)
    for sigma in (0.01, 1.0):
        squared = torch.full((1, 3), 0.04, requires_grad=True)
        loss_with_sigma(squared, torch.full((1, 3), math.log(sigma))).backward()
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
        ({"seed": 2**70}, "seed"),
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
def test_an_invalid_recipe_is_refused(values, field):
    with pytest.raises(ConfigError) as caught:
        training_config(values)
    assert caught.value.field == field
