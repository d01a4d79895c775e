"""Training in several processes, as started by torch's launcher.

`torchrun --nproc-per-node 2 --no-python stario train ...` starts the command twice and numbers the
processes in their environment. Every process draws the same windows and takes its share of them,
and of the stretches of weak truth where they divide evenly. Gradients are averaged, so that a step
equals that of one process with the whole batch, except for batch norms, which cover one share,
and for legs, which are averaged within each process.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed

from stario.sequences.errors import ConfigError


@dataclass(frozen=True)
class Workers:
    """The processes of a run, as seen by one of them.

    Attributes:
        rank: number of this process; number 0 writes and reports.
        count: number of processes.
        device: device of this process.
    """

    rank: int
    count: int
    device: torch.device

    @property
    def is_leader(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.rank == 0

    def share(self, drawn: Sequence[Tensor]) -> list[Tensor]:
        """Return this process's rows of tensors that all have drawn, on its device.

        All rows, if their number cannot be divided evenly.
        """
        rows = slice(None) if len(drawn[0]) % self.count else slice(self.rank, None, self.count)
        return [part[rows].to(self.device) for part in drawn]

    def total(self, value: float) -> float:
        """Return the sum of the processes' numbers, in all of them."""
        if self.count == 1:
            return value
        tensor = torch.tensor(value, dtype=torch.float64, device=self.device)
        distributed.all_reduce(tensor)
        return float(tensor)


def is_leader() -> bool:
    """Return whether this process is the only one or the launcher's first one."""
    # Job schedulers set such variables, too, for processes that do not belong together.
    return not distributed.is_torchelastic_launched() or os.environ["RANK"] == "0"


@contextmanager
def workers(device: str, batch: int) -> Iterator[Workers]:
    """Connect the processes that the launcher started; without a launcher, use this one alone.

    Args:
        device: "auto", "cpu" or "cuda"; each process uses its own GPU.
        batch: rows to divide evenly among the processes.

    Raises:
        ConfigError: no GPU is available for "cuda", or the batch cannot be divided evenly.
    """
    has_gpu = torch.cuda.is_available()
    if device == "cuda" and not has_gpu:
        raise ConfigError("device", "cuda, but no GPU is available", "cpu or auto")
    chosen = torch.device("cpu")
    if has_gpu and device != "cpu":
        chosen = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    if not distributed.is_torchelastic_launched() or os.environ["WORLD_SIZE"] == "1":
        yield Workers(0, 1, chosen)
        return
    count = int(os.environ["WORLD_SIZE"])
    if batch % count:
        raise ConfigError("batch", f"{batch} for {count} processes", "a multiple of their number")
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Workers(distributed.get_rank(), count, chosen)
        distributed.barrier()
    finally:
        distributed.destroy_process_group()
