import json
import math
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from cut_windows import windows_of

from stario.network.architectures import build_network
from stario.network.card import Calibration, card_path
from stario.network.displacement import DisplacementNetwork
from stario.network.known_motion import OUTSIDE_VARIANCE, KnownMotion
from stario.network.model import load_model
from stario.network.training.augment import Augmentation
from stario.network.training.config import (
    TrainingConfig,
    training_config,
)
from stario.network.training.history import EpochReport
from stario.network.training.train import train
from stario.network.training.validation import ValidationSet
from stario.sequences.errors import ConfigError, InputError, ReadError
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WorldStream

TINY = TrainingConfig(
    epochs=4,
    epoch_windows=128,
    batch=16,
    rate=1e-3,
    likelihood_from=0.5,
    average=0.9,
    device="cpu",
    augmentation=Augmentation(
        speeds=(1.0, 1.0), swung=0.0, any_yaw=1.0, tilt=0.02, gyro_bias=0.01, accel_bias=0.05
    ),
)


def swaying(name: str, phase: float, seconds: float = 20.0) -> WorldStream:
    """A device on a swing of period 2 s, whose acceleration determines its displacement."""
    t = np.arange(round(200 * seconds)) / 200.0
    position = np.stack([np.sin(np.pi * t + phase), 0.5 * np.sin(np.pi * t), 0.0 * t], axis=1)
    imu_W = np.zeros((len(t), 6), np.float32)
    imu_W[:, 3:] = -(np.pi**2) * position + [0.0, 0.0, STANDARD_GRAVITY]
    facing_W = np.tile(np.float32([1.0, 0.0]), (len(t), 1))
    return WorldStream(name, imu_W, position.astype(np.float32), facing_W)


STREAMS = [swaying("a", 0.3), swaying("b", 1.2)]
VALIDATION = [swaying("c", 0.8, 6.0), swaying("d", 2.0, 6.0)]


def run(folder: Path, config: TrainingConfig = TINY, **options: Any) -> Path:
    return train(config, STREAMS, [1.0, 1.0], VALIDATION, folder, **options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[EpochReport]]:
    """A run without interruption: the model's path and the reports of its epochs."""
    reports: list[EpochReport] = []
    folder = tmp_path_factory.mktemp("finished")
    return run(folder, on_epoch=reports.append, trained_on=["swings"]), reports


@pytest.fixture
def model(finished: tuple[Path, list[EpochReport]], tmp_path: Path) -> Path:
    """A copy of the trained model and its card."""
    path = tmp_path / "model.safetensors"
    path.write_bytes(finished[0].read_bytes())
    card_path(path).write_bytes(card_path(finished[0]).read_bytes())
    return path


def test_training_learns(finished: tuple[Path, list[EpochReport]]) -> None:
    reports = finished[1]
    assert [r.epoch for r in reports] == [1, 2, 3, 4]
    assert reports[-1].training_error < 0.75 * reports[0].training_error
    # Far better than a prediction of no motion.
    displacement = windows_of(VALIDATION[0], 20)[1]
    assert reports[-1].validation_error < 0.5 * np.mean(np.sum(displacement**2, axis=1))
    assert list(reports[-1].validation_by_recording) == ["c", "d"]


def test_an_epoch_reports_its_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock that advances by a second on every reading."""
    clock = count()
    monkeypatch.setattr("stario.network.training.run.perf_counter", lambda: float(next(clock)))
    reports: list[EpochReport] = []
    run(tmp_path, replace(TINY, epochs=1), on_epoch=reports.append)
    assert reports[0].windows_per_second == TINY.batch / 2
    assert reports[0].drawing_share == 0.5


def test_the_model_reproduces_its_validation_error(
    finished: tuple[Path, list[EpochReport]],
) -> None:
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


def test_sigma_is_calibrated_with_the_widening_for_unfamiliar_motion(tmp_path: Path) -> None:
    """On unfamiliar validation data, covariances are widened and still match the errors.

    Squared errors are limited to 25 variances, as in the calibration.
    """
    streams = [swaying("a", 0.3, 40.0), swaying("b", 1.2, 40.0)]
    unfamiliar = swaying("c", 0.8, 30.0)
    unfamiliar.imu_W[:, :3] = np.random.default_rng(0).standard_normal((6000, 3))
    path = train(replace(TINY, epochs=2), streams, [1.0, 1.0], [unfamiliar], tmp_path)
    model = load_model(path)
    assert model.card.known_motion is not None
    windows, truth = windows_of(unfamiliar, 20)
    assert model.card.known_motion.variance_factor(windows).min() == OUTSIDE_VARIANCE
    mean, covariance = model.predict(windows)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    normalised = np.minimum((mean - truth) ** 2 / variance, 25.0)
    assert normalised[:, :2].mean() == pytest.approx(1.0, abs=0.1)


def test_only_the_likelihood_trains_sigma(finished: tuple[Path, list[EpochReport]]) -> None:
    """The squared error alone gives the weights of sigma no gradient."""
    path, _ = finished
    with safetensors.safe_open(path.parent / "checkpoint.safetensors", framework="pt") as file:
        moment = file.get_tensor(f"optimiser.{_index_of_last_bias(file)}.exp_avg")
    assert (moment[3:] != 0.0).all()
    early = run(path.parent.parent / "early", replace(TINY, epochs=1, likelihood_from=1.0))
    with safetensors.safe_open(early.parent / "checkpoint.safetensors", framework="pt") as file:
        moment = file.get_tensor(f"optimiser.{_index_of_last_bias(file)}.exp_avg")
    assert (moment[:3] != 0.0).all()
    assert (moment[3:] == 0.0).all()


def _index_of_last_bias(file: Any) -> int:
    names = list(file.keys())
    return max(int(key.split(".")[1]) for key in names if key.startswith("optimiser."))


def test_a_killed_and_resumed_run_gives_the_same_weights(
    finished: tuple[Path, list[EpochReport]], tmp_path: Path
) -> None:
    def kill(step: int, loss: float) -> None:
        if step == 21:  # in the third epoch of eight steps
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, on_step=kill)
    assert not (tmp_path / "model.safetensors").exists()
    reports: list[EpochReport] = []
    resumed = safetensors.torch.load_file(run(tmp_path, on_epoch=reports.append))
    expected = safetensors.torch.load_file(finished[0])
    assert [r.epoch for r in reports] == [3, 4]
    assert resumed.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(resumed[name], value), name


@pytest.mark.parametrize(("without_error", "kept"), [({3}, {4}), ({4}, {3}), ({3, 4}, {1, 2})])
def test_an_epoch_without_a_finite_error_is_never_the_best(
    finished: tuple[Path, list[EpochReport]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    without_error: set[int],
    kept: set[int],
) -> None:
    """The likelihood begins with epoch 3; an earlier epoch is kept if it has no finite error."""
    original, epoch = ValidationSet.errors, count(1)

    def errors(self: ValidationSet, *arguments: Any) -> dict[str, float]:
        found = original(self, *arguments)
        return found | {"c": math.nan} if next(epoch) in without_error else found

    monkeypatch.setattr(ValidationSet, "errors", errors)
    model = load_model(run(tmp_path))
    choice = [r.validation_by_recording for r in finished[1] if r.epoch in kept]
    assert model.card.figures["validation_mse_m2"] in choice


def test_a_short_run_keeps_the_epoch_that_trained_sigma(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training of sigma begins within the second of two epochs, which has the larger error here."""
    original, epoch = ValidationSet.errors, count(1)

    def errors(self: ValidationSet, *arguments: Any) -> dict[str, float]:
        return original(self, *arguments) | {"c": float(next(epoch))}

    monkeypatch.setattr(ValidationSet, "errors", errors)
    path = run(tmp_path, replace(TINY, epochs=2, epoch_windows=32, likelihood_from=0.6))
    state = safetensors.torch.load_file(tmp_path / "checkpoint.safetensors")
    kept = safetensors.torch.load_file(path)
    assert all(torch.equal(state[f"averaged.network.{k}"], v) for k, v in kept.items())


def test_a_loss_that_is_not_finite_stops_before_it_corrupts_anything(tmp_path: Path) -> None:
    corrupted = [replace(stream, imu_W=stream.imu_W.copy()) for stream in STREAMS]

    def corrupt(report: EpochReport) -> None:
        for stream in corrupted:
            stream.imu_W[:] = np.nan

    with pytest.raises(InputError, match=r"loss: found nan .* in step 9.*`rate` below 0\.001"):
        train(TINY, corrupted, [1.0, 1.0], VALIDATION, tmp_path, on_epoch=corrupt)
    state = safetensors.torch.load_file(tmp_path / "checkpoint.safetensors")
    assert all(value.isfinite().all() for value in state.values() if value.is_floating_point())
    assert not (tmp_path / "model.safetensors").exists()
    reports: list[EpochReport] = []
    run(tmp_path, on_epoch=reports.append)
    assert [r.epoch for r in reports] == [2, 3, 4]


def test_a_finished_run_is_not_trained_further(
    finished: tuple[Path, list[EpochReport]], tmp_path: Path
) -> None:
    checkpoint = tmp_path / "checkpoint.safetensors"
    checkpoint.write_bytes((finished[0].parent / checkpoint.name).read_bytes())
    steps: list[int] = []
    path = run(tmp_path, on_step=lambda step, loss: steps.append(step), trained_on=["swings"])
    assert steps == []
    assert path.read_bytes() == finished[0].read_bytes()


def test_a_finished_run_logs_that_all_epochs_are_done(
    finished: tuple[Path, list[EpochReport]], caplog: pytest.LogCaptureFixture
) -> None:
    run(finished[0].parent, trained_on=["swings"])
    assert "all 4 epochs are done" in caplog.text


def test_a_checkpoint_of_other_recordings_is_refused(
    finished: tuple[Path, list[EpochReport]],
) -> None:
    folder = finished[0].parent
    more = [*STREAMS, swaying("e", 0.1)]
    with pytest.raises(ConfigError, match="other recordings"):
        train(TINY, more, [1.0, 1.0, 1.0], VALIDATION, folder)
    with pytest.raises(ConfigError, match="other recordings"):
        train(TINY, STREAMS, [1.0, 2.0], VALIDATION, folder)
    with pytest.raises(ConfigError, match="initial weights"):
        run(folder, start_from=load_model(finished[0]))


def test_a_checkpoint_of_recordings_that_were_corrected_since_is_refused(
    finished: tuple[Path, list[EpochReport]],
) -> None:
    """Their names and lengths are the same; ground truth or samples are not."""
    folder, position_W = finished[0].parent, STREAMS[0].position_W
    swapped = replace(STREAMS[0], position_W=position_W[:, [1, 0, 2]])
    other_sign = replace(STREAMS[0], imu_W=STREAMS[0].imu_W * np.float32([1, 1, 1, -1, 1, 1]))
    for corrected in (swapped, replace(STREAMS[0], position_W=1.01 * position_W), other_sign):
        with pytest.raises(ConfigError, match="other recordings"):
            train(TINY, [corrected, STREAMS[1]], [1.0, 1.0], VALIDATION, folder)


def test_the_log_holds_every_epoch(finished: tuple[Path, list[EpochReport]]) -> None:
    log = json.loads((finished[0].parent / "log.json").read_text(encoding="utf-8"))
    assert [entry["epoch"] for entry in log] == [1, 2, 3, 4]


def test_a_checkpoint_of_another_recipe_is_refused(
    finished: tuple[Path, list[EpochReport]],
) -> None:
    with pytest.raises(ConfigError, match=r"rate: found 0\.001, expected 0\.01"):
        run(finished[0].parent, replace(TINY, rate=0.01))
    harder = replace(TINY, augmentation=replace(TINY.augmentation, tilt=0.3))
    with pytest.raises(ConfigError, match="augmentation"):
        run(finished[0].parent, harder)


@pytest.mark.parametrize("length", [0, 5, 1000, 100_000])
def test_a_truncated_checkpoint_is_named(
    finished: tuple[Path, list[EpochReport]], tmp_path: Path, length: int
) -> None:
    whole = (finished[0].parent / "checkpoint.safetensors").read_bytes()
    (tmp_path / "checkpoint.safetensors").write_bytes(whole[:length])
    with pytest.raises(ReadError, match=r"checkpoint.safetensors: checkpoint: found .*complete"):
        run(tmp_path)


def test_nothing_to_learn_from_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="streams"):
        train(TINY, [], [], VALIDATION, tmp_path)


def test_stretches_too_short_for_the_fastest_replay_are_skipped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fast = replace(TINY, epochs=1, epoch_windows=16, augmentation=Augmentation(speeds=(0.6, 1.8)))
    short = swaying("short", 0.3, 1.5)
    train(fast, [*STREAMS, short], [1.0] * 3, VALIDATION, tmp_path / "a")
    assert "skipping 1 of 3 stretches" in caplog.text
    with pytest.raises(InputError, match="streams: found none with 361 samples"):
        train(fast, [short], [1.0], VALIDATION, tmp_path / "b")


def test_a_checkpoint_without_the_setting_successive_is_resumed(
    finished: tuple[Path, list[EpochReport]], tmp_path: Path
) -> None:
    path = finished[0].parent / "checkpoint.safetensors"
    with safetensors.safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    config = json.loads(metadata["config"])
    del config["successive"]
    content = safetensors.torch.load_file(path)
    safetensors.torch.save_file(
        content,
        tmp_path / path.name,
        metadata={**metadata, "config": json.dumps(config)},
    )
    assert run(tmp_path, trained_on=["swings"]).read_bytes() == finished[0].read_bytes()


def test_a_recurrent_network_is_trained_on_successive_windows(tmp_path: Path) -> None:
    values = {"architecture": "RNIN", "epochs": 1, "epoch_windows": 40, "batch": 20}
    config = training_config({**values, "device": "cpu", "likelihood_from": 0.0})
    assert config.successive == 10
    # A step changes the weights that act only on a nonzero state.
    path = run(tmp_path / "row", config)
    assert load_model(path).stateful_inference(2) is not None
    first = DisplacementNetwork(build_network_of(config)).state_dict()
    last = safetensors.torch.load_file(path)
    change = last["lstm.weight_hh_l0"] - first["network.lstm.weight_hh_l0"]
    assert float(change.abs().max()) > 0.0
    # Streams shorter than ten seconds hold no ten successive windows.
    with pytest.raises(InputError, match="streams: found none with 3601 samples"):
        train(config, [swaying("short", 0.3, 5.0)], [1.0], VALIDATION, tmp_path / "short")


@pytest.mark.parametrize(("dense", "stride", "minutes"), [(200, 40, 7), (140, 50, 7), (15, 200, 4)])
def test_long_validation_data_are_thinned_by_minutes_for_recurrent_networks(
    monkeypatch: pytest.MonkeyPatch, dense: int, stride: int, minutes: int
) -> None:
    """Of seven minutes in two recordings, the first of each and every n-th after it are used."""
    monkeypatch.setattr("stario.network.training.validation._DENSE_SAMPLES", 200 * dense)
    streams = [swaying("a", 0.3, 300.0), swaying("b", 0.3, 120.0)]
    cpu = torch.device("cpu")
    held_out = ValidationSet(streams, cpu, TINY, is_recurrent=True)
    assert held_out.stride == stride
    seconds = sum(len(stream) for stream in held_out.streams) / 200
    assert seconds == 60 * minutes
    assert list(dict.fromkeys(held_out.names)) == ["a", "b"]
    others = ValidationSet(streams, cpu, TINY)
    assert others.streams is streams
    assert others.stride == 20 * max(1, 420 // dense)


def build_network_of(config: TrainingConfig) -> torch.nn.Module:
    torch.manual_seed(config.seed)
    return build_network(config.architecture)


def test_training_that_spoils_its_initial_weights_gives_a_warning(
    model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run(tmp_path / "spoilt", replace(TINY, epochs=1, rate=0.1), start_from=load_model(model))
    assert "times those of the initial weights" in caplog.text
    held_out = ValidationSet(VALIDATION, torch.device("cpu"), TINY)
    assert not held_out.worse({"c": 1.0, "d": 1.0}, {"c": 0.5, "d": 1.5})
    assert "(d: 4 instead of 1)" in held_out.worse({"c": 1.0, "d": 1.0}, {"c": 0.5, "d": 4.0})


def test_fine_tuned_weights_lie_between_the_initial_and_the_learned(
    model: Path, tmp_path: Path
) -> None:
    first, once = load_model(model), replace(TINY, epochs=1)
    initial, none, half, all_learned = (
        dict(weights.training_form.named_parameters())
        for weights in (
            first,
            *(
                load_model(
                    run(tmp_path / str(share), replace(once, learned=share), start_from=first)
                )
                for share in (0.0, 0.5, 1.0)
            ),
        )
    )
    for name, before in initial.items():
        torch.testing.assert_close(none[name], before, atol=0.0, rtol=0.0)
        torch.testing.assert_close(half[name], 0.5 * (before + all_learned[name]))
    assert any(not torch.equal(all_learned[name], before) for name, before in initial.items())


def test_fine_tuned_weights_still_know_the_motion_of_the_initial_ones(
    model: Path, tmp_path: Path
) -> None:
    """Weights of which none remain know that of their own training only: here, too little."""
    first = load_model(model)
    first.card = replace(first.card, known_motion=KnownMotion(((0.0,) * 5,), 1.0, {}))
    for learned, known in ((0.3, first.card.known_motion), (1.0, None)):
        config = replace(TINY, epochs=1, epoch_windows=16, learned=learned)
        path = run(tmp_path / str(learned), config, start_from=first)
        assert load_model(path).card.known_motion == known


def test_a_last_stage_starts_from_weights_and_adopts_a_calibration(
    model: Path, tmp_path: Path
) -> None:
    first = load_model(model)
    slow = replace(TINY, rate=1e-8, epochs=1)
    other = Calibration((1.5, 1.5, 2.0), (0.9, 0.9, 1.1), (0.02, 0.02, 0.03))
    options = {"calibration": other, "trained_on": ["walks"]}
    last = load_model(run(tmp_path / "last", slow, start_from=first, **options))
    assert last.card.calibration == other
    assert last.card.trained_on == ["walks", "initial weights, swings"]
    before = dict(first.training_form.named_parameters())
    for name, value in last.training_form.named_parameters():
        torch.testing.assert_close(value, before[name], atol=1e-4, rtol=0.0)
    again = load_model(run(tmp_path / "again", slow, start_from=last, trained_on=["swings"]))
    inherited = ["initial weights, walks", "initial weights, swings"]
    assert again.card.trained_on == ["swings", *inherited]


def test_errors_on_recordings_that_were_learned_are_named_so(tmp_path: Path) -> None:
    """A last stage trains on the validation recordings, too."""
    everything = [*STREAMS, *VALIDATION]
    path = train(replace(TINY, epochs=1), everything, [1.0] * 4, VALIDATION, tmp_path)
    assert list(load_model(path).card.figures) == ["validation_mse_m2_after_it_was_learned"]
