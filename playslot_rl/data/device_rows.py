"""Rows of a data set on the device that computes.

On a GPU all rows are put into its memory once, where they fill at most half of what is free; a batch is then a gather
there, and the host only draws the numbers of the rows. Otherwise the rows of a batch are gathered in pinned memory
while the GPU still computes what came before, and then copied: at `paper` 6 MB, a few milliseconds' gathering and a
fraction of one on the bus, of steps of a hundred, so that a thread or a stream of their own would save nothing.

Shapes: F rows, each (...).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import torch
from torch import Tensor

from playslot_rl.data.views import IntArray
from playslot_rl.runtime.devices import to_device

SHARE: Final = 0.5
"""Of the free memory that a table may take: networks and their activations need the rest."""
CHUNK: Final = 4096
"""Rows that are copied at a time."""


class DeviceRows:
    """Gives rows (..., *row) on a device, of rows numbered (...).

    Args:
        host: gives rows of numbers as a tensor on the CPU.
        count: F.
        resident: whether all may be kept on a GPU.
    """

    def __init__(
        self, host: Callable[[IntArray], Tensor], count: int, device: torch.device | str, resident: bool = True
    ) -> None:
        self.host, self.count, self.device = host, count, torch.device(device)
        self.table = self._table() if resident and self.device.type == "cuda" else None

    def __call__(self, rows: IntArray) -> Tensor:
        if self.table is None:
            return to_device(self.host(rows), self.device)
        return self.table[to_device(torch.from_numpy(rows), self.device)]

    def take(self, rows: Tensor) -> Tensor:
        """Rows of numbers on the CPU or on the device."""
        if self.table is None or rows.device.type == "cpu":
            return self(rows.cpu().numpy())
        return self.table[rows]

    def _table(self) -> Tensor | None:
        one = self.host(np.arange(1))
        free, _ = torch.cuda.mem_get_info(self.device)
        free += torch.cuda.memory_reserved(self.device) - torch.cuda.memory_allocated(self.device)  # torch's own cache
        if one.nbytes * self.count > SHARE * free:
            return None
        table = torch.empty(self.count, *one.shape[1:], dtype=one.dtype, device=self.device)
        for begin in range(0, self.count, CHUNK):
            rows = np.arange(begin, min(begin + CHUNK, self.count))
            table[begin : begin + len(rows)] = self.host(rows).to(self.device)
        return table
