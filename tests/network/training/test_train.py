import math
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from cut_windows import windows_of
from training_runs import HELD_OUT, STREAMS, TINY, VALIDATION, narrow, run, shallow, swaying

from stario.network.architectures import build_network
from stario.network.model import load_model
from stario.network.training.augment import Augmentation
from stario.network.training.config import training_config
from stario.network.training.data import TrainingData
from stario.network.training.history import EpochReport, History
from stario.network.training.train import CapturedStep, TrainingRun, train
from stario.network.training.validation import ValidationSet, calibrate
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray


def test_training_learns(finished):
    reports = finished[1]
    assert [r.epoch for r in reports] == [1, 2, 3, 4]
    assert reports[-1].training_error < 0.75 * reports[0].training_error
    # Far better than a prediction of no motion.
    displacement = windows_of(VALIDATION[0], 20)[1]
    assert reports[-1].validation_error < 0.5 * np.mean(np.sum(displacement**2, axis=1))
    assert list(reports[-1].validation_by_recording) == ["c", "d"]


def test_an_epoch_reports_its_speed(tmp_path, monkeypatch):
    clock = count()
    monkeypatch.setattr("stario.network.training.train.perf_counter", lambda: float(next(clock)))
    reports = []
    run(tmp_path, replace(TINY, epochs=1, epoch_windows=32), on_epoch=reports.append)
    assert reports[0].windows_per_second == TINY.batch / 2
    assert reports[0].drawing_share == 0.5


def test_the_model_reproduces_its_validation_error(finished):
    path, reports = finished
    model = load_model(path)
    assert model.card.trained_on == ["swings"]
    assert model.card.recipe["batch"] == TINY.batch
    for stream in VALIDATION:
        windows, truth = windows_of(stream, 20)
        error = np.mean(np.sum((model.predict(windows)[0] - truth) ** 2, axis=1))
        kept = model.card.figures["validation_mse_m2"][stream.name]
        assert error == pytest.approx(kept, rel=1e-3)
        # The best epoch trained with the likelihood is kept, not the last epoch.
        assert any(kept == r.validation_by_recording[stream.name] for r in reports[2:])


def test_sigma_matches_the_errors_in_validation(tmp_path):
    """Squared errors are limited to 25 variances, as in the calibration."""
    streams = [swaying("a", 0.3, 40.0), swaying("b", 1.2, 40.0)]
    other = swaying("c", 0.8, 30.0)
    other.imu_W[:, :3] = np.random.default_rng(0).standard_normal((6000, 3))
    path = train(replace(TINY, epochs=2), TrainingData(streams), TrainingData([other]), tmp_path)
    windows, truth = windows_of(other, 20)
    mean, covariance = load_model(path).predict(windows)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    normalised = np.minimum((mean - truth) ** 2 / variance, 25.0)
    assert normalised[:, :2].mean() == pytest.approx(1.0, abs=0.1)


def moments(model: Path) -> list[torch.Tensor]:
    """Return the optimiser's means of gradients, of the first parameter to the last bias."""
    path = model.parent / "checkpoint.safetensors"
    with safetensors.safe_open(path, framework="pt") as file:
        names = [name for name in file.keys() if name.endswith(".exp_avg")]  # noqa: SIM118
        return [file.get_tensor(name) for name in sorted(names, key=lambda n: int(n.split(".")[1]))]


def test_only_the_likelihood_trains_sigma(finished, tmp_path):
    """The squared error alone gives the weights of sigma no gradient."""
    assert (moments(finished[0])[-1][3:] != 0.0).all()
    early = moments(run(tmp_path, replace(TINY, epochs=1, likelihood_from=1.0)))[-1]
    assert (early[:3] != 0.0).all()
    assert (early[3:] == 0.0).all()


@pytest.mark.parametrize(
    ("errors", "best"),
    [((2.0, 1.0, 4.0, 3.0), 4), ((2.0, 1.0, 3.0, 4.0), 3), ((2.0, 1.0, math.nan, 4.0), 4),
     ((2.0, 1.0, 3.0, math.nan), 3), ((2.0, 1.0, 3.0, -math.inf), 3), ((2.0, 3.0), 1)],
)  # fmt: skip
def test_the_best_epoch_has_the_smallest_finite_error_of_those_that_train_sigma(errors, best):
    """The likelihood begins with the third of four epochs."""
    reports = [EpochReport(epoch, 0.0, error, {}) for epoch, error in enumerate(errors, 1)]
    assert History(TINY, reports).best().epoch == best


def test_training_stops_without_progress_of_epochs_that_train_sigma_even_in_part():
    """The likelihood begins with the third epoch, whatever came before."""
    config = replace(TINY, epochs=6, likelihood_from=1.0 / 3.0, patience=2)
    errors = (1.0, 2.0, 3.0, 4.0, 5.0)
    reports = [EpochReport(epoch, 0.0, error, {}) for epoch, error in enumerate(errors, 1)]
    stops = [History(config, reports[:count]).should_stop() for count in range(1, 6)]
    assert stops == [False, False, False, False, True]
    reports = [EpochReport(1, 0.0, 1.0, {}), EpochReport(2, 0.0, 2.0, {})]
    assert History(replace(TINY, epochs=2, likelihood_from=0.6), reports).best().epoch == 2


def test_gradients_are_clipped(tmp_path):
    """A first step keeps a tenth of them as the optimiser's mean."""
    learned = moments(run(tmp_path, replace(TINY, epochs=1, epoch_windows=16, clip=0.01)))
    assert float(torch.nn.utils.get_total_norm(learned)) == pytest.approx(0.001, rel=1e-3)


def test_weights_of_an_epoch_without_a_finite_error_are_not_kept(tmp_path, monkeypatch):
    """Neither epoch that trains sigma has one: the weights of the better earlier one are kept."""
    original, errors_of = ValidationSet.errors, iter((1.0, 2.0, math.nan, math.nan))

    def errors(self, *arguments):
        return original(self, *arguments) | {"c": next(errors_of, 0.0), "d": 0.0}

    first: dict[str, torch.Tensor] = {}
    candidate = TrainingRun._candidate

    def noted(self):
        network = candidate(self)
        if not first:
            first.update(network.network.state_dict())
        return network

    monkeypatch.setattr(ValidationSet, "errors", errors)
    monkeypatch.setattr(TrainingRun, "_candidate", noted)
    state = safetensors.torch.load_file(run(tmp_path, replace(TINY, epoch_windows=16)))
    assert all(torch.equal(first[name], value) for name, value in state.items())


def test_a_loss_that_is_not_finite_stops_before_it_corrupts_anything(tmp_path):
    corrupted = [replace(stream, imu_W=stream.imu_W.copy()) for stream in STREAMS]

    def corrupt(report):
        for stream in corrupted:
            stream.imu_W[:] = np.nan

    short = replace(TINY, epochs=2, epoch_windows=32)
    with pytest.raises(InputError, match=r"loss: found nan .* in step 3.*`rate` below 0\.001"):
        train(short, TrainingData(corrupted), HELD_OUT, tmp_path, on_epoch=corrupt)
    state = safetensors.torch.load_file(tmp_path / "checkpoint.safetensors")
    assert all(value.isfinite().all() for value in state.values() if value.is_floating_point())
    assert not (tmp_path / "model.safetensors").exists()
    reports = []
    run(tmp_path, short, on_epoch=reports.append)
    assert [r.epoch for r in reports] == [2]


def test_a_gradient_that_is_not_finite_stops_before_the_step(tmp_path, monkeypatch):
    """It is infinite a step before the loss is."""
    monkeypatch.setattr(
        torch.nn.utils, "clip_grad_norm_", lambda parameters, most: torch.tensor(torch.inf)
    )
    with pytest.raises(InputError, match="with a gradient of norm inf in step 1"):
        run(tmp_path, replace(TINY, epochs=1, epoch_windows=16))


def test_stretches_too_short_for_the_fastest_replay_are_skipped(tmp_path, caplog):
    fast = replace(TINY, epochs=1, epoch_windows=16, augmentation=Augmentation(speeds=(0.6, 1.8)))
    short = swaying("short", 0.3, 1.5)
    train(fast, TrainingData([*STREAMS, short]), HELD_OUT, tmp_path / "a")
    assert "skipping 1 of 3 stretches" in caplog.text
    for nothing in ([short], []):
        with pytest.raises(InputError, match="streams: found none"):
            train(fast, TrainingData(nothing), HELD_OUT, tmp_path / "b")


def test_a_recurrent_network_is_trained_on_successive_windows(tmp_path, monkeypatch):
    shallow(monkeypatch)
    values = {"architecture": "RNIN", "epochs": 1, "epoch_windows": 40, "batch": 20}
    config = training_config({**values, "device": "cpu", "likelihood_from": 0.0})
    assert config.successive == 10
    # A step changes the weights that act only on a nonzero state.
    path = run(tmp_path / "row", config)
    assert load_model(path).is_recurrent
    torch.manual_seed(config.seed)
    first = build_network("RNIN").state_dict()
    last = safetensors.torch.load_file(path)
    change = last["lstm.weight_hh_l0"] - first["lstm.weight_hh_l0"]
    assert float(change.abs().max()) > 0.0
    # Streams shorter than ten seconds hold no ten successive windows.
    short = TrainingData([swaying("short", 0.3, 5.0)])
    with pytest.raises(InputError, match="streams: found none with 3601 samples"):
        train(config, short, HELD_OUT, tmp_path / "short")


@pytest.mark.parametrize(("dense", "minutes"), [(500, 7), (200, 4), (140, 3)])
def test_long_validation_data_are_thinned_by_minutes_for_recurrent_networks(
    monkeypatch, dense, minutes
):
    """Of seven minutes in two recordings, the first of each and every n-th after it are used."""
    monkeypatch.setattr("stario.network.training.validation._DENSE_SAMPLES", 200 * dense)
    streams = [swaying("a", 0.3, 300.0), swaying("b", 0.3, 120.0)]
    held_out = ValidationSet(TrainingData(streams), TINY, is_recurrent=True)
    assert held_out.stride == 20
    seconds = sum(len(stream) for stream in held_out.streams) / 200
    assert seconds == 60 * minutes
    assert list(dict.fromkeys(held_out.names)) == ["a", "b"]
    others = ValidationSet(TrainingData(streams), TINY)
    assert others.streams is streams
    assert others.stride == 20 * max(1, 420 // dense)


TRUE_SCALE = np.array([1.7, 1.7, 0.4])


def errors_and_log_sigmas(count: int = 20_000) -> tuple[FloatArray, FloatArray]:
    """Gaussian errors whose deviation is TRUE_SCALE times the network's sigma."""
    rng = np.random.default_rng(0)
    log_sigma = rng.uniform(np.log(0.1), np.log(1.0), (count, 3))
    return TRUE_SCALE * np.exp(log_sigma) * rng.standard_normal((count, 3)), log_sigma


def test_a_known_scale_and_exponent_are_recovered_and_horizontal_axes_share_them():
    error, log_sigma = errors_and_log_sigmas()
    x, y, _ = calibrate(error * [3.0, 1.0, 1.0], log_sigma).scale
    assert x == y
    np.testing.assert_allclose(calibrate(*errors_and_log_sigmas()).scale, TRUE_SCALE, rtol=0.02)
    error, log_sigma = errors_and_log_sigmas()
    error[::200] *= 1000.0
    np.testing.assert_allclose(calibrate(error, log_sigma).scale, TRUE_SCALE, rtol=0.15)
    rng = np.random.default_rng(1)
    log_sigma = rng.uniform(np.log(0.1), np.log(0.5), (20_000, 3))
    error = np.exp(1.5 * log_sigma) * rng.standard_normal(log_sigma.shape)
    calibration = calibrate(error, log_sigma)
    np.testing.assert_allclose(calibration.exponent, 1.5, atol=0.05)
    np.testing.assert_allclose(calibration.scale, 1.0, rtol=0.08)


def test_a_sigma_that_is_wrong_way_round_is_ignored():
    """Its exponent would be negative: certain where errors are large."""
    error, log_sigma = errors_and_log_sigmas()
    found = calibrate(error, -log_sigma)
    np.testing.assert_allclose(found.exponent, 0.0, atol=1e-3)
    rms = np.sqrt(np.mean(np.minimum(error**2, 25.0 * np.square(found.scale)), axis=0))
    np.testing.assert_allclose(found.scale, rms, rtol=0.05)


@pytest.mark.parametrize(("capability", "equal"), [("AVX2", True), ("AVX512", False)])
def test_a_cpu_without_the_instructions_computes_in_float32(
    tmp_path, monkeypatch, capability, equal
):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    narrow(monkeypatch)
    errors: list[float] = []
    for precision in ("float32", "bfloat16"):
        config = replace(TINY, epochs=1, epoch_windows=32, precision=precision)
        reports: list[EpochReport] = []
        run(tmp_path / precision, config, on_epoch=reports.append)
        errors.append(reports[0].training_error)
    assert (errors[0] == errors[1]) == equal


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_recorded_step_learns_what_a_launched_one_does(tmp_path, monkeypatch):
    config = replace(TINY, device="cuda", dropout=0.0)
    recorded: list[EpochReport] = []
    launched: list[EpochReport] = []
    run(tmp_path / "recorded", config, on_epoch=recorded.append)
    monkeypatch.setattr(CapturedStep, "__call__", lambda self, *given: self._step(*given))
    run(tmp_path / "launched", config, on_epoch=launched.append)
    for one, other in zip(recorded, launched, strict=True):
        assert one.training_error == pytest.approx(other.training_error, rel=0.01)
