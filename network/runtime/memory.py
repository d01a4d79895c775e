"""Peak memory that a computation in PyTorch takes in addition to its inputs."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def peak_bytes(work: Callable[[], object]) -> int:
    """Return the peak memory [bytes] of operations' results, in addition to existing tensors.

    Memory that an operation takes and frees internally, such as a packed copy of its weights, is
    not counted.
    """
    watch = _Watch()
    with torch.no_grad(), watch:
        work()
    return watch.most


class _Watch(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counter of the bytes of all new tensors' storages that have not been freed."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.held: int = 0
        self.most: int = 0
        self._alive: set[int] = set()

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        for value in tree_leaves(result):
            if isinstance(value, torch.Tensor):
                self._see(value.untyped_storage())
        return result

    def _see(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key not in self._alive:
            self._alive.add(key)
            self.held += size
            self.most = max(self.most, self.held)
            weakref.finalize(storage, self._forget, key, size)

    def _forget(self, key: int, size: int) -> None:
        self._alive.discard(key)
        self.held -= size
