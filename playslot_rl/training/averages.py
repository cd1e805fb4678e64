"""A moving average of the weights, which is validated and kept in place of the last ones.

    a <- d a + (1 - d) w   after each step,   d = min(decay, (1 + t) / (10 + t)),   t steps from 1

The smaller d of the first steps forgets where the weights began. Buffers (codebooks, BatchNorm) are averages already.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn


class WeightAverage:
    """The average (`tensors`) of parameters, by name; at first they are the average. The decay is in (0, 1)."""

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.parameters, self.decay = parameters, decay
        self.tensors: dict[str, Tensor] = {}
        self.restart()

    def restart(self) -> None:
        """Begin again from the parameters as they are."""
        self.tensors = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the parameters after `step` steps, from 1."""
        kept = min(self.decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(list(self.tensors.values()), list(self.parameters.values()), 1 - kept)

    @contextlib.contextmanager
    def shown(self) -> Iterator[None]:
        """Inside the block the parameters are the average."""
        last = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}
        self._put(self.tensors)
        try:
            yield
        finally:
            self._put(last)

    def settle(self) -> None:
        """Make the parameters the average, for good."""
        self._put(self.tensors)

    @torch.no_grad()
    def _put(self, tensors: Mapping[str, Tensor]) -> None:
        for name, parameter in self.parameters.items():
            parameter.copy_(tensors[name])
