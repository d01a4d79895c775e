"""Training: one recipe for every network, on CPU or GPU, resumable from its checkpoint.

The mean is learned by squared error from first to last. Sigma joins later, by the Gaussian
likelihood e^2 / (2 sigma^2) + log sigma of the mean's error as it stands (detached): the joint
likelihood, also weighted by sigma (Seitzer et al. 2022), starves the mean of gradient wherever
sigma is large, and it is the large errors that a track is made of.

The rate warms up and falls along a cosine as a function of the step alone, so a run that is killed
and resumed follows the same schedule. What is evaluated and saved is the running average of the
weights.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from stario.network.architectures import build_network
from stario.network.augment import Augmentation, WindowSampler
from stario.network.calibrate import calibrate
from stario.network.card import Calibration, Card
from stario.network.model import DisplacementModel, DisplacementNetwork, save_model
from stario.sequences.errors import ConfigError, InputError, ReadError
from stario.sequences.files import atomic_write
from stario.sequences.windows import WorldStream, window_starts, windows_at

log = logging.getLogger(__name__)

VALIDATION_STRIDE = 20

SIGMA_WEIGHT = 0.05
"""Of the likelihood beside the squared error [m^2]: as large as a good error's square."""

_RANGES = (
    ("rate", 1e-8, 1.0),
    ("warm_up", 0.0, 1.0),
    ("weight_decay", 0.0, 1.0),
    ("likelihood_from", 0.0, 1.0),
    ("clip", 1e-6, 1e6),
    ("average", 0.0, 1.0),
)
_CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe.

    Attributes:
        architecture: name of the network.
        epochs: passes of `epoch_windows` windows.
        epoch_windows: windows drawn between two validations.
        batch: windows per step.
        rate: peak learning rate (Adam with decoupled weight decay).
        warm_up: share of the steps with a rising rate.
        weight_decay: decoupled.
        dropout: share of the head's features that is silenced; None leaves it to the network.
        likelihood_from: share of the steps after which sigma is learned too.
        clip: largest norm of the gradient.
        average: decay of the running average of the weights per step.
        patience: epochs without a better validation error after which training stops.
        precision: "float32" or "bfloat16" (mixed; nearly twice as fast where there is support).
        device: "auto", "cpu" or "cuda".
        seed: of initial weights, draws and dropout.
        augmentation: how windows are varied.

    Raises:
        ConfigError: a value is out of range.
    """

    architecture: str = "StarIO"
    epochs: int = 60
    epoch_windows: int = 43_008
    batch: int = 256
    rate: float = 1e-3
    warm_up: float = 0.05
    weight_decay: float = 1e-4
    dropout: float | None = None
    likelihood_from: float = 0.6
    clip: float = 1.0
    average: float = 0.998
    patience: int = 20
    precision: str = "float32"
    device: str = "auto"
    seed: int = 0
    augmentation: Augmentation = field(default_factory=Augmentation)

    def __post_init__(self) -> None:
        for name in ("epochs", "epoch_windows", "batch", "patience"):
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= 1):
                raise ConfigError(name, repr(value), "a count of at least 1")
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if not (isinstance(value, int | float) and low <= value <= high):
                raise ConfigError(name, repr(value), f"a number from {low} to {high}")
        if self.dropout is not None and not 0.0 <= self.dropout < 1.0:
            raise ConfigError("dropout", repr(self.dropout), "a share from 0 to below 1, or none")
        if self.precision not in ("float32", "bfloat16"):
            raise ConfigError("precision", repr(self.precision), "float32 or bfloat16")
        if self.device not in ("auto", "cpu", "cuda"):
            raise ConfigError("device", repr(self.device), "auto, cpu or cuda")

    @property
    def steps_per_epoch(self) -> int:
        """Steps between two validations."""
        return max(1, self.epoch_windows // self.batch)

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.epochs * self.steps_per_epoch


@dataclass(frozen=True)
class EpochReport:
    """What one epoch ended with; errors are mean squared displacement errors [m^2]."""

    epoch: int
    training_error: float
    validation_error: float
    validation_by_recording: dict[str, float]


def train(
    config: TrainingConfig,
    streams: Sequence[WorldStream],
    weights: Sequence[float],
    validation: Sequence[WorldStream],
    folder: Path,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
    on_epoch: Callable[[EpochReport], None] = lambda report: None,
    trained_on: Sequence[str] = (),
    start_from: DisplacementModel | None = None,
    keep_calibration: bool = False,
) -> Path:
    """Train a network, continuing from the folder's checkpoint where there is one.

    Args:
        config: the recipe; a checkpoint made with another one is refused.
        streams: training stretches.
        weights: relative frequency of each stretch per second of it.
        validation: stretches that choose the weights and calibrate the covariance.
        folder: receives `checkpoint.safetensors`, `model.safetensors`, its card and `log.json`.
        on_step: called after each step with the step and its loss, for a progress bar.
        on_epoch: called after each validation.
        trained_on: words for the card.
        start_from: a model whose weights are the first ones.
        keep_calibration: keep that model's calibration, for a last stage that learns from the
            validation recordings as well: their errors then say nothing any more.

    Returns:
        Path of the model's weights.

    Raises:
        InputError: no stretch to learn from or to validate on.
        ConfigError: the checkpoint belongs to another recipe.
    """
    if not streams or not validation:
        raise InputError("streams", "none", "stretches of at least 2 s with truth")
    run = _Run(config, WindowSampler(streams, weights, config.augmentation, config.seed), folder)
    if start_from is not None:
        run.start_from(start_from)
    run.resume()
    held_out = _ValidationSet(validation, run.device)
    while run.step < config.steps and run.epochs_since_best() < config.patience:
        error = run.epoch(on_step)
        by_recording = held_out.errors(run.averaged)
        report = EpochReport(
            epoch=run.step // config.steps_per_epoch,
            training_error=error,
            validation_error=float(np.mean(list(by_recording.values()))),
            validation_by_recording=by_recording,
        )
        run.record(report)
        on_epoch(report)
    calibration = start_from.card.calibration if start_from and keep_calibration else None
    return run.finish(held_out, list(trained_on), calibration)


class _Run:
    """State of a training run: network, optimiser, averaged weights, history."""

    def __init__(self, config: TrainingConfig, sampler: WindowSampler, folder: Path) -> None:
        torch.manual_seed(config.seed)
        self.config, self.sampler, self.folder = config, sampler, folder
        self.device = _device(config.device)
        self.network = DisplacementNetwork(build_network(config.architecture)).to(self.device)
        if config.dropout is not None:
            _set_dropout(self.network, config.dropout)
        self.averaged = DisplacementNetwork(build_network(config.architecture)).to(self.device)
        self.averaged.load_state_dict(self.network.state_dict())
        self.best = {k: v.clone() for k, v in self.averaged.state_dict().items()}
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), config.rate, weight_decay=config.weight_decay
        )
        self.step = 0
        self.history: list[EpochReport] = []
        folder.mkdir(parents=True, exist_ok=True)

    def start_from(self, model: DisplacementModel) -> None:
        """Begin with a model's weights.

        Raises:
            ConfigError: it is of another architecture.
        """
        if model.card.architecture != self.config.architecture:
            raise ConfigError(
                "architecture", model.card.architecture, f"{self.config.architecture} as trained"
            )
        state = model.training_form.state_dict()
        self.network.load_state_dict(state)
        self.averaged.load_state_dict(state)
        self.best = {k: v.clone() for k, v in self.averaged.state_dict().items()}

    def epoch(self, on_step: Callable[[int, float], None]) -> float:
        """One epoch; returns the mean squared error on its (augmented) windows."""
        self.network.train()
        errors = []
        for _ in range(self.config.steps_per_epoch):
            errors.append(self._one_step())
            on_step(self.step, errors[-1])
        return float(np.mean(errors))

    def _one_step(self) -> float:
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.config, self.step)
        windows, target = self.sampler.batch(self.config.batch)
        windows, target = windows.to(self.device), target.to(self.device)
        mixed = self.config.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=mixed):
            mean, log_sigma = self.network(windows)
        squared = (mean - target) ** 2
        likelihood = self.step >= self.config.likelihood_from * self.config.steps
        loss = loss_with_sigma(squared, log_sigma) if likelihood else squared.sum(1).mean()
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        self.optimiser.step()
        self.step += 1
        self._average()
        return float(squared.detach().sum(1).mean())

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.average, (1 + self.step) / (10 + self.step))
        current = self.network.state_dict()
        for name, value in self.averaged.state_dict().items():
            if value.is_floating_point():
                value.lerp_(current[name], 1.0 - decay)
            else:
                value.copy_(current[name])

    def epochs_since_best(self) -> int:
        """Epochs since the smallest validation error.

        Before the likelihood has begun sigma means nothing: once it has, only epochs that learned
        with it count.
        """
        first = math.ceil(self.config.likelihood_from * self.config.epochs) + 1
        errors = [r.validation_error for r in self.history]
        if len(errors) >= first:
            errors = errors[first - 1 :]
        return len(errors) - 1 - int(np.argmin(errors)) if errors else 0

    def record(self, report: EpochReport) -> None:
        """Keep the best weights and write checkpoint and log."""
        self.history.append(report)
        if self.epochs_since_best() == 0:
            self.best = {k: v.clone() for k, v in self.averaged.state_dict().items()}
        self._write_checkpoint()
        with atomic_write(self.folder / "log.json") as file:
            file.write(json.dumps([asdict(r) for r in self.history], indent=1))

    def _write_checkpoint(self) -> None:
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        tensors |= {f"averaged.{k}": v for k, v in self.averaged.state_dict().items()}
        tensors |= {f"best.{k}": v for k, v in self.best.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{k}": v for k, v in state.items()}
        tensors["random.sampler"] = self.sampler.generator.get_state()
        tensors["random.torch"] = torch.get_rng_state()
        metadata = {
            "config": json.dumps(asdict(self.config)),
            "step": str(self.step),
            "history": json.dumps([asdict(r) for r in self.history]),
        }
        whole = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
        with atomic_write(self.folder / _CHECKPOINT, "wb") as file:
            file.write(safetensors.torch.save(whole, metadata=metadata))

    def resume(self) -> None:
        """Continue from the folder's checkpoint, if there is one.

        Raises:
            ConfigError: it was written by another recipe.
            ReadError: it cannot be read.
        """
        path = self.folder / _CHECKPOINT
        if not path.exists():
            return
        try:
            with safetensors.safe_open(path, framework="pt") as file:
                metadata = file.metadata()
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        except safetensors.SafetensorError as error:
            raise ReadError(path, "checkpoint", str(error), "a whole checkpoint") from error
        if not metadata or "config" not in metadata:
            raise ReadError(path, "checkpoint", "no recipe in it", "a checkpoint of this command")
        config = json.loads(json.dumps(asdict(self.config)))
        found = json.loads(metadata["config"])
        for name in config:
            if found.get(name) != config[name]:
                raise ConfigError(
                    f"{path}: {name}",
                    repr(found.get(name)),
                    f"{config[name]!r} as in this run",
                    "resume with the same settings or train into another folder",
                )
        self._restore(tensors)
        self.step = int(metadata["step"])
        self.history = [EpochReport(**r) for r in json.loads(metadata["history"])]
        log.info("resumed %s at step %d", path, self.step)

    def _restore(self, tensors: dict[str, Tensor]) -> None:
        def part(prefix: str) -> dict[str, Tensor]:
            return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}

        self.network.load_state_dict(part("network."))
        self.averaged.load_state_dict(part("averaged."))
        self.best = {k: v.to(self.device) for k, v in part("best.").items()}
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in part("optimiser.").items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = value
        whole = self.optimiser.state_dict()
        self.optimiser.load_state_dict({**whole, "state": state})
        self.sampler.generator.set_state(tensors["random.sampler"])
        torch.set_rng_state(tensors["random.torch"])

    def finish(
        self, held_out: _ValidationSet, trained_on: list[str], kept: Calibration | None
    ) -> Path:
        """Calibrate the best weights, unless a calibration is to be kept, and write the model."""
        self.averaged.load_state_dict(self.best)
        card = Card(
            architecture=self.config.architecture,
            calibration=kept or calibrate(*held_out.residuals(self.averaged)),
            trained_on=trained_on,
            recipe=json.loads(json.dumps(asdict(self.config))),
            figures={"validation_mse_m2": held_out.errors(self.averaged)},
        )
        path = self.folder / "model.safetensors"
        save_model(path, self.averaged, card)
        return path


class _ValidationSet:
    """Windows kept from training, cut anew each time: all at once would fill the memory."""

    def __init__(self, streams: Sequence[WorldStream], device: torch.device) -> None:
        self.streams, self.device = streams, device
        counts = [len(window_starts(stream, VALIDATION_STRIDE)) for stream in streams]
        if not sum(counts):
            raise InputError("validation", "no window", "stretches longer than a second")
        self.names = np.repeat([stream.name for stream in streams], counts)

    def _batches(self) -> Iterator[tuple[Tensor, Tensor]]:
        for stream in self.streams:
            starts = window_starts(stream, VALIDATION_STRIDE)
            for first in range(0, len(starts), 256):
                windows, target = windows_at(stream, starts[first : first + 256])
                yield torch.from_numpy(windows), torch.from_numpy(target)

    @torch.inference_mode()
    def residuals(self, network: nn.Module) -> tuple[np.ndarray, np.ndarray]:
        """Errors (M, 3) [m] and log sigmas (M, 3)."""
        network.eval()
        errors, log_sigmas = [], []
        for windows, target in self._batches():
            mean, log_sigma = network(windows.to(self.device))
            errors.append(mean.cpu() - target)
            log_sigmas.append(log_sigma.cpu())
        return torch.cat(errors).double().numpy(), torch.cat(log_sigmas).double().numpy()

    def errors(self, network: nn.Module) -> dict[str, float]:
        """Mean squared error by recording [m^2]."""
        squared = (self.residuals(network)[0] ** 2).sum(axis=1)
        return {str(n): float(squared[self.names == n].mean()) for n in dict.fromkeys(self.names)}


def _set_dropout(network: nn.Module, share: float) -> None:
    for module in network.modules():
        if isinstance(module, nn.Dropout):
            module.p = share


def loss_with_sigma(squared: Tensor, log_sigma: Tensor) -> Tensor:
    """Squared errors (B, 3) [m^2] and the likelihood of sigma given them, side by side."""
    likelihood = 0.5 * squared.detach() * torch.exp(-2.0 * log_sigma) + log_sigma
    return (squared + SIGMA_WEIGHT * likelihood).sum(1).mean()


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Linear warm-up, then a cosine down to a hundredth of the peak."""
    warm = config.warm_up * config.steps
    if step < warm:
        return config.rate * (step + 1) / max(warm, 1.0)
    progress = (step - warm) / max(config.steps - warm, 1.0)
    return config.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * progress)))


def training_config(values: dict[str, object]) -> TrainingConfig:
    """A recipe from plain values (a parsed JSON file), unknown keys refused.

    Raises:
        ConfigError: a key is unknown or a value out of range.
    """
    known = {f.name for f in fields(TrainingConfig)}
    for name in values:
        if name not in known:
            raise ConfigError(name, "unknown key", f"one of {', '.join(sorted(known))}")
    values = dict(values)
    augmentation = values.pop("augmentation", {})
    if not isinstance(augmentation, dict):
        raise ConfigError("augmentation", repr(augmentation), "a table of values")
    allowed = {f.name for f in fields(Augmentation)}
    for name in augmentation:
        if name not in allowed:
            raise ConfigError(f"augmentation.{name}", "unknown key", f"one of {sorted(allowed)}")
    if "speeds" in augmentation:
        augmentation = {**augmentation, "speeds": tuple(augmentation["speeds"])}
    return TrainingConfig(augmentation=Augmentation(**augmentation), **values)  # type: ignore[arg-type]


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device", "cuda, but torch sees no GPU", "cpu or auto")
    return torch.device(name)
