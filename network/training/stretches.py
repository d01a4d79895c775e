"""Stretches gathered from many streams: read from their files, or kept on a GPU as a whole.

On a CPU, streams may be memory-mapped: a batch reads what it is cut from and nothing is kept. On a
GPU all streams together (50 hours take 1.5 GB) are copied once, and a batch never leaves the
device: drawing on the CPU would take several times as long as the network.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Stretches:
    """One array of every stream, from which stretches of one length are gathered.

    Args:
        arrays: (N_i, K) float32, one of each stream.
        device: device of what is gathered.
    """

    def __init__(self, arrays: Sequence[NDArray[np.float32]], device: torch.device) -> None:
        self._arrays, self._whole = list(arrays), torch.empty(0)
        self._is_resident = device.type == "cuda"
        if self._is_resident:
            lengths = [len(array) for array in self._arrays]
            self._first = torch.tensor(np.cumsum([0, *lengths[:-1]]), device=device)
            self._whole = torch.from_numpy(np.concatenate(self._arrays)).to(device)

    def gathered(self, stream: Tensor, start: Tensor, length: int) -> Tensor:
        """Return samples [start, start + length) of the numbered streams, (B, length, K)."""
        if self._is_resident:
            rows = (self._first[stream] + start)[:, None] + torch.arange(
                length, device=start.device
            )
            return self._whole[rows]
        found = np.empty((len(stream), length, self._arrays[0].shape[1]), dtype=np.float32)
        for row, (index, first) in enumerate(zip(stream.tolist(), start.tolist(), strict=True)):
            found[row] = self._arrays[index][first : first + length]
        return torch.from_numpy(found)
