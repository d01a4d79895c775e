"""Loss of a step: windows with full truth and stretches of weak truth, in one batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from stario.network.training.config import loss_with_sigma
from stario.network.training.weak_truth import LegBatch, leg_loss


def step_loss(
    answers: Callable[[Tensor], tuple[Tensor, Tensor]],
    windows: Tensor,
    target: Tensor,
    legs: Sequence[LegBatch],
    with_sigma: bool,
) -> tuple[Tensor, float]:
    """Return the loss of windows and legs, and the windows' mean squared error [m^2].

    All sources pass through the network in one batch, so that its normalisation covers them all.

    Args:
        answers: function from windows (B, 6, 200) to displacements and log sigmas (B, 3).
        windows: (..., 6, 200) with full truth.
        target: (..., 3) displacements of the windows [m].
        legs: stretches of weak truth.
        with_sigma: whether sigma is learned in this step.
    """
    parts = [windows.flatten(0, -3), *(part.windows.flatten(0, 1) for part in legs)]
    sizes = [len(part) for part in parts]
    mean, log_sigma = answers(torch.cat(parts))
    means, log_sigmas = torch.split(mean, sizes), torch.split(log_sigma, sizes)
    squared = (means[0] - target.flatten(0, -2)) ** 2
    loss = loss_with_sigma(squared, log_sigmas[0]) if with_sigma else squared.sum(1).mean()
    for part, predicted, sigma in zip(legs, means[1:], log_sigmas[1:], strict=True):
        shape = (len(part.known), -1, 3)
        loss = loss + leg_loss(predicted.view(shape), sigma.view(shape), part)[0]
    return loss, float(squared.detach().sum(1).mean())
