"""A training run: network, optimiser, averaged weights, history and checkpoint.

The running average of the weights is what is evaluated and saved.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from stario.network.architectures import architecture, build_network
from stario.network.displacement import DisplacementNetwork
from stario.network.model import DisplacementModel
from stario.network.training.augment import WindowSampler
from stario.network.training.captured import CapturedStep
from stario.network.training.checkpoint import damaged, read_checkpoint, write_checkpoint
from stario.network.training.config import TrainingConfig, learning_rate, loss_with_sigma
from stario.network.training.data import TrainingData
from stario.network.training.history import EpochReport, History
from stario.network.training.legs import LegBatch, leg_samplers
from stario.network.training.parallel import Workers
from stario.network.training.validation import ValidationSet
from stario.network.training.weak_truth import leg_loss
from stario.sequences.errors import ConfigError, InputError
from stario.sequences.files import write_json

log = logging.getLogger(__name__)


class TrainingRun:
    """State of a training run.

    Args:
        config: the recipe.
        data: what is learned from.
        material: digest of the recordings and initial weights, for the checkpoint.
        folder: existing folder for checkpoint, model and log.
        workers: the processes that share the run.

    Attributes:
        history: reports of the epochs so far.
    """

    def __init__(
        self,
        config: TrainingConfig,
        data: TrainingData,
        material: str,
        folder: Path,
        workers: Workers,
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self._material = config, material
        self.workers, self.device = workers, workers.device
        self.sampler = WindowSampler(
            data.streams,
            data.weights,
            config.augmentation,
            config.seed,
            config.successive,
            self.device,
        )
        self.legs = leg_samplers(config, data.legs, self.sampler.generator)
        self.network = DisplacementNetwork(build_network(config.architecture)).to(self.device)
        self._checkpoint, self._log = folder / "checkpoint.safetensors", folder / "log.json"
        if config.dropout is not None:
            for module in self.network.modules():
                if isinstance(module, nn.Dropout):
                    module.p = config.dropout
        self.averaged = DisplacementNetwork(build_network(config.architecture)).to(self.device)
        self.averaged.load_state_dict(self.network.state_dict())
        self._moving, self._counts = _pairs(self.averaged, self.network)
        self._initial: dict[str, Tensor] | None = None
        self._keep(self.averaged)
        # Recording is untried with cuDNN's recurrent layers and with several processes.
        is_recurrent = any(isinstance(part, nn.RNNBase) for part in self.network.modules())
        self._is_captured = self.device.type == "cuda" and workers.count == 1 and not is_recurrent
        # A recorded step reads its rate from the GPU.
        rate = torch.tensor(config.rate, device=self.device) if self._is_captured else config.rate
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(),
            rate,
            weight_decay=config.weight_decay,
            capturable=self._is_captured,
        )
        self._captured = CapturedStep(self._update)
        idle = architecture(config.architecture).heads > 1
        shared = workers.wrapped(self.network, idle=idle)
        self._shared: Any = torch.compile(shared) if config.compiled else shared
        if not workers.is_leader:
            torch.manual_seed(config.seed + workers.rank)  # independent dropout
        self.step = 0
        self._windows, self._drawing_s, self._learning_s = 0, 0.0, 0.0
        self.history = History(config)

    def start_from(self, model: DisplacementModel) -> None:
        """Start from a model's weights.

        Raises:
            ConfigError: the model has another architecture.
        """
        if model.card.architecture != self.config.architecture:
            raise ConfigError(
                "architecture", model.card.architecture, f"{self.config.architecture}, the recipe's"
            )
        state = model.training_form.state_dict()
        self.network.load_state_dict(state)
        self.averaged.load_state_dict(state)
        self._keep(self.averaged)
        self._initial = self.best

    def _keep(self, network: DisplacementNetwork) -> None:
        self.best = {k: v.clone() for k, v in network.state_dict().items()}

    def _candidate(self) -> DisplacementNetwork:
        """Return the network with averaged weights, mixed with the initial ones."""
        if self._initial is None or self.config.learned == 1.0:
            return self.averaged
        mixed = copy.deepcopy(self.averaged)
        for name, value in mixed.state_dict().items():
            if value.is_floating_point():
                value.lerp_(self._initial[name], 1.0 - self.config.learned)
        return mixed

    def epoch(self, on_step: Callable[[int, float], None]) -> float:
        """Train for one epoch; return the mean squared error on its (augmented) windows."""
        self.network.train()
        self._windows, self._drawing_s, self._learning_s = 0, 0.0, 0.0
        errors = []
        for _ in range(self.config.steps_per_epoch):
            errors.append(self._one_step())
            on_step(self.step, errors[-1])
        return self.workers.mean(float(np.mean(errors)))

    def _one_step(self) -> float:
        self._set_rate(learning_rate(self.config, self.step))
        begin = perf_counter()
        drawn = self.sampler.batch(self.config.batch // self.config.successive)
        windows, target = (self.workers.share(part).to(self.device) for part in drawn)
        legs = [s.batch(n).shared(self.workers).to(self.device) for s, n in self.legs]
        ready = perf_counter()
        inputs = [windows, target, *(value for part in legs for value in vars(part).values())]
        if self._is_captured:
            result = self._captured(inputs, self._learns_sigma)
        else:
            result = self._update(inputs)
        loss, error, norm = result.tolist()
        self._check_finite(loss, norm)
        self.step += 1
        self._average()
        self._drawing_s += ready - begin
        self._learning_s += perf_counter() - ready
        parts = [windows, *(part.windows for part in legs)]
        self._windows += sum(part[..., 0, 0].numel() for part in parts)
        return float(error)

    def _set_rate(self, rate: float) -> None:
        for group in self.optimiser.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    @property
    def _learns_sigma(self) -> bool:
        return self.step >= self.config.likelihood_from * self.config.steps

    def _update(self, inputs: list[Tensor]) -> Tensor:
        """Change the weights once; return loss, mean squared error and norm of the gradient (3,).

        Args:
            inputs: windows, their displacements, and the values of each `LegBatch`.
        """
        windows, target, *values = inputs
        count = len(fields(LegBatch))
        legs = [LegBatch(*values[i : i + count]) for i in range(0, len(values), count)]
        loss, error = self._loss(windows, target, legs)
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        self.optimiser.step()
        return torch.stack([loss.detach(), error, norm])

    def _loss(self, windows: Tensor, target: Tensor, legs: list[LegBatch]) -> tuple[Tensor, Tensor]:
        """Return the loss of windows and legs, and the windows' mean squared error [m^2].

        All pass through the network in one batch, so that its normalisation covers them all.

        Args:
            windows: (..., 6, 200) with full truth.
            target: (..., 3) displacements of the windows [m].
            legs: stretches of weak truth.
        """
        parts = [windows.flatten(0, -3), *(part.windows.flatten(0, 1) for part in legs)]
        sizes = [len(part) for part in parts]
        mean, log_sigma = self._predict(torch.cat(parts))
        means, log_sigmas = torch.split(mean, sizes), torch.split(log_sigma, sizes)
        squared = (means[0] - target.flatten(0, -2)) ** 2
        learns_sigma = self._learns_sigma
        loss = loss_with_sigma(squared, log_sigmas[0]) if learns_sigma else squared.sum(1).mean()
        for part, predicted, sigma in zip(legs, means[1:], log_sigmas[1:], strict=True):
            shape = (len(part.known), -1, 3)
            loss = loss + leg_loss(predicted.view(shape), sigma.view(shape), part)[0]
        return loss, squared.detach().sum(1).mean()

    def _predict(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Return displacements and log sigmas (B, 3) of windows (B, 6, 200).

        A recurrent network receives them as rows of `config.successive` windows.
        """
        successive = self.config.successive
        if self.network.is_recurrent:
            windows = windows.view(-1, successive, *windows.shape[1:])
        mixed = self.config.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=mixed):
            mean, log_sigma, *_ = self._shared(windows)
        return mean.view(-1, 3), log_sigma.view(-1, 3)

    def _check_finite(self, loss: float, norm: float) -> None:
        """Stop after a step that has corrupted every weight, before any of it is kept.

        The gradient's norm is checked as well: it is infinite one step before the loss is, and all
        processes have the same norm, so that all of them stop.
        """
        if math.isfinite(loss) and math.isfinite(norm):
            return
        raise InputError(
            "loss",
            f"{loss:g} with a gradient of norm {norm:g} in step {self.step + 1}",
            "finite numbers",
            f"train in another folder with a `rate` below {self.config.rate:g}",
        )

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.average, (1 + self.step) / (10 + self.step))
        # One kernel instead of one for each tensor.
        torch._foreach_lerp_(self._moving[0], self._moving[1], 1.0 - decay)
        if self._counts[0]:  # those of batch norms
            torch._foreach_copy_(self._counts[0], self._counts[1])

    def validate(self, training_error: float, held_out: ValidationSet) -> EpochReport:
        """Validate an epoch in the leading process, which shares the error with the others.

        The weights are kept if they are the best so far; checkpoint and log are written.
        """
        candidate = self._candidate()
        errors = held_out.errors(candidate) if self.workers.is_leader else {}
        report = EpochReport(
            epoch=self.step // self.config.steps_per_epoch,
            training_error=training_error,
            validation_error=self.workers.broadcast(held_out.selection_error(errors)),
            validation_by_recording=errors,
            windows_per_second=self._windows / (self._drawing_s + self._learning_s),
            drawing_share=self._drawing_s / (self._drawing_s + self._learning_s),
        )
        self.history.reports.append(report)
        if self.history.epochs_since_best() == 0 and math.isfinite(report.validation_error):
            self._keep(candidate)
        if self.workers.is_leader:
            given = self.history, self._material, self.step, self._tensors()
            write_checkpoint(self._checkpoint, *given)
            write_json(self._log, self.history.reports)
        return report

    def _tensors(self) -> dict[str, Tensor]:
        """Return the tensors of a checkpoint, from which `_restore` continues."""
        random = {"sampler": self.sampler.generator.get_state(), "torch": torch.get_rng_state()}
        if self.device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        parts = {
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "best": self.best,
            "random": random,
        }
        for index, state in self.optimiser.state_dict()["state"].items():
            parts[f"optimiser.{index}"] = state
        return {f"{name}.{k}": v for name, part in parts.items() for k, v in part.items()}

    def resume(self) -> None:
        """Continue from the folder's checkpoint, if there is one.

        Raises:
            ConfigError: the checkpoint belongs to another recipe, or to other recordings or initial
                weights.
            ReadError: the checkpoint cannot be read.
        """
        if not self._checkpoint.exists():
            return
        found = read_checkpoint(self._checkpoint, self.config, self._material)
        self.step, self.history.reports, tensors = found
        try:
            self._restore(tensors)
        except (RuntimeError, KeyError, TypeError, ValueError) as error:
            raise damaged(self._checkpoint, error) from error
        if self.workers.is_leader:
            write_json(self._log, self.history.reports)  # which may have been lost
        log.info("resumed %s at step %d", self._checkpoint, self.step)

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
        if self.workers.is_leader:
            torch.set_rng_state(tensors["random.torch"])
            if self.device.type == "cuda" and "random.cuda" in tensors:  # not in older ones
                torch.cuda.set_rng_state(tensors["random.cuda"], self.device)
        else:
            torch.manual_seed(self.config.seed + self.workers.rank + self.step)

    def best_network(self) -> DisplacementNetwork:
        """Return the network with the best weights so far."""
        self.averaged.load_state_dict(self.best)
        return self.averaged


def _pairs(*networks: nn.Module) -> list[tuple[list[Tensor], ...]]:
    """Return the tensors of networks of one kind, real numbers and counts apart."""
    states = [list(network.state_dict().values()) for network in networks]
    return [
        tuple([v for v in state if v.is_floating_point() == real] for state in states)
        for real in (True, False)
    ]
