"""The range of real actions: inside the library they are in [-1, 1], a robot's own units are met at the borders.

    u = 2 (a - low) / (high - low) - 1,   a = (u + 1) / 2 (high - low) + low

Shapes: actions (..., A). The arithmetic is that of LeRobot's normaliser (MIN_MAX), operation by operation, so that an
exported policy gives what the run gave, to the last digit.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class ActionRange(nn.Module):
    """Lowest and highest action of each dimension, beside the network whose actions they bound.

    At first they are -1 and 1: nothing is computed then, and nothing stored with the weights. A dimension whose ends
    are equal never changes: it is -1 inside, and that constant outside.
    """

    low: Tensor
    high: Tensor

    def __init__(self, action_dim: int) -> None:
        super().__init__()
        self.unit = True
        self.register_buffer("low", -torch.ones(action_dim), persistent=False)
        self.register_buffer("high", torch.ones(action_dim), persistent=False)

    def take(self, low: Tensor, high: Tensor) -> None:
        """Take the ends (A,), finite and in order (else a ValueError); -1 and 1 in every dimension are what it began
        with.
        """
        if low.shape != self.low.shape or high.shape != self.low.shape or not bool((low <= high).all()):
            raise ValueError(
                f"action range: got {low.tolist()} to {high.tolist()}, expected {len(self.low)} finite ends in order"
            )
        self.expect(bool((low != -1).any() or (high != 1).any()))
        self.low.copy_(low)
        self.high.copy_(high)

    def expect(self, stored: bool) -> None:
        """Be stored with the weights, or go back to -1 and 1 and be not (`storage.tensors.load_modules`)."""
        self.unit = not stored
        if not stored:
            self.low.fill_(-1.0)
            self.high.fill_(1.0)
        for name in ("low", "high"):
            self.register_buffer(name, getattr(self, name), persistent=stored)

    def to_unit(self, actions: Tensor) -> Tensor:
        """Actions of the robot to [-1, 1], beyond it where they are beyond the range."""
        if self.unit:
            return actions
        low, high, constant = self._ends(actions)
        scaled = 2 * (actions - low) / torch.where(constant, 1.0, high - low) - 1
        return torch.where(constant, -1.0, scaled)

    def from_unit(self, actions: Tensor) -> Tensor:
        """Actions in [-1, 1] to those of the robot."""
        if self.unit:
            return actions
        low, high, constant = self._ends(actions)
        return torch.where(constant, low, (actions + 1) / 2 * (high - low) + low)

    def pinned(self, actions: Tensor) -> Tensor:
        """Actions in [-1, 1], with -1 for what never changes."""
        if self.unit:
            return actions
        return torch.where(self._ends(actions)[2], -1.0, actions)

    def _ends(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        low, high = self.low.to(actions.device), self.high.to(actions.device)
        return low, high, low == high


def range_of(network: nn.Module) -> ActionRange | None:
    """The range of the actions that a network gives; None for those of our simulators, which have none beside them."""
    return next((part for part in network.modules() if isinstance(part, ActionRange)), None)
